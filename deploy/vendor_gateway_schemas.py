"""Write JSON schemas of Gateway API's and Envoy Gateway's resources from their definitions (CRDs).

``python deploy/vendor_gateway_schemas.py DEFINITION.yaml... deploy/kubernetes-gateway/schemas``.
Descriptions, status and CEL rules (``x-kubernetes-validations``) are left out; objects take no
names that their schema does not have, as a server with strict validation does.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import yaml

LEFT_OUT = ("description", "x-kubernetes-validations")
ANY_NAMES = ("additionalProperties", "x-kubernetes-preserve-unknown-fields")


def strict(schema: Any) -> Any:
    """Return a schema without what is left out; objects with named properties take no others.

    Only where it says what type a value has: alternatives (``oneOf``) name some properties each.
    """
    if isinstance(schema, list):
        return [strict(each) for each in schema]
    if not isinstance(schema, dict):
        return schema
    kept = {key: strict(value) for key, value in schema.items() if key not in LEFT_OUT}
    if isinstance(schema.get("properties"), dict):
        kept["properties"] = {name: strict(value) for name, value in schema["properties"].items()}
        if schema.get("type") == "object" and not any(name in schema for name in ANY_NAMES):
            kept["additionalProperties"] = False
    return kept


def resource_schema(definition: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Return the file name, and the schema of the version that is stored."""
    spec = definition["spec"]
    (version,) = (each for each in spec["versions"] if each["storage"])
    properties = version["schema"]["openAPIV3Schema"]["properties"]
    schema = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "type": "object",
        "required": ["apiVersion", "kind", "metadata", "spec"],
        "additionalProperties": False,
        "properties": {
            "apiVersion": {"const": f"{spec['group']}/{version['name']}"},
            "kind": {"const": spec["names"]["kind"]},
            "metadata": {"type": "object", "required": ["name"]},
            "spec": strict(properties["spec"]),
        },
    }
    return f"{spec['names']['kind']}.json", schema


def main(definitions: list[Path], folder: Path) -> None:
    """Write the schema of each definition into the folder."""
    for path in definitions:
        name, schema = resource_schema(yaml.safe_load(path.read_text()))
        text = json.dumps(schema, sort_keys=True, separators=(",", ":"))
        (folder / name).write_text(text + "\n")


if __name__ == "__main__":
    *given, out = map(Path, sys.argv[1:])
    main(given, out)
