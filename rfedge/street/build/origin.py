"""What a dataset was built from: enough to tell whether a build can go on in its folder."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import rfedge.street
from rfcore.errors import InvalidInput
from rfcore.files import write_whole
from rfedge.street.build.studio import Order
from rfedge.street.scene_file import Scene

__all__ = ["ORIGIN_NAME", "claim_folder", "origin_of"]

ORIGIN_NAME = "build.json"
STREET = Path(rfedge.street.__file__).parent


def origin_of(order: Order) -> dict[str, Any]:
    """Return scene, settings, versions and the digest of the generator's own code.

    The code of effects that the scene does not declare is no part of it.
    """
    return {
        "scene": asdict(order.scene),
        "size_px": order.size_px,
        "samples": order.quality.samples,
        "seed": order.quality.seed,
        "renderer": order.backend.variant,
        "versions": {name: version(name) for name in ("rfedge", "mitsuba", "pyoidn")},
        "generator_sha256": _code_digest(order.scene),
    }


def claim_folder(order: Order) -> None:
    """Make the dataset's folder, or check that it holds the same build.

    Raises ``InvalidInput`` for a folder of another build, or of something else.
    """
    origin = json.loads(json.dumps(origin_of(order)))
    file = order.folder / ORIGIN_NAME
    if not order.folder.exists() or not any(order.folder.iterdir()):
        order.folder.mkdir(parents=True, exist_ok=True)
        write_whole(file, json.dumps(origin, indent=1) + "\n")
        return
    try:
        found = json.loads(file.read_text())
    except (OSError, ValueError) as error:
        raise InvalidInput("out", f"{order.folder} holds no build of a scene") from error
    differing = [key for key in origin if found.get(key) != origin[key]]
    if differing:
        raise InvalidInput(
            "out",
            f"{order.folder} holds another build (differs in {', '.join(differing)}); remove it or "
            "name another folder",
        )


def _code_digest(scene: Scene) -> str:
    digest = hashlib.sha256()
    for path in sorted(STREET.rglob("*.py")):
        if path.parent.name == "effects" and path.stem not in {"__init__", *scene.effects}:
            continue
        digest.update(path.relative_to(STREET).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()
