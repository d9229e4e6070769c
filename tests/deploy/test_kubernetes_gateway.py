"""deploy/kubernetes-gateway against the schemas of Gateway API and Envoy Gateway, and its parts."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml
from jsonschema import Draft202012Validator, ValidationError

from rfcore.wire.conventions import TILE, VEHICLE

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "deploy/kubernetes-gateway"
KINDS = {
    "BackendTLSPolicy",
    "BackendTrafficPolicy",
    "ClientTrafficPolicy",
    "GRPCRoute",
    "Gateway",
}


def kustomization() -> dict[str, Any]:
    read: dict[str, Any] = yaml.safe_load((FOLDER / "kustomization.yaml").read_text())
    return read


def resources(folder: Path) -> dict[tuple[str, str], dict[str, Any]]:
    """Return the resources in the files that a kustomization lists, by kind and name."""
    listed = yaml.safe_load((folder / "kustomization.yaml").read_text())["resources"]
    texts = [(folder / name).read_text() for name in listed if name.endswith(".yaml")]
    read = [document for text in texts for document in yaml.safe_load_all(text)]
    return {(d["kind"], d["metadata"]["name"]): d for d in read}


OWN = resources(FOLDER)
BASE = resources(ROOT / "deploy/kubernetes")


def validate(resource: Mapping[str, Any]) -> None:
    schema = json.loads((FOLDER / "schemas" / f"{resource['kind']}.json").read_text())
    Draft202012Validator.check_schema(schema)
    Draft202012Validator(schema).validate(resource)


@pytest.mark.parametrize("key", OWN)
def test_every_resource_is_valid_to_the_letter(key):
    validate(OWN[key])


def test_there_is_a_schema_for_every_kind_and_for_no_other():
    assert {kind for kind, _ in OWN} == KINDS
    assert {path.stem for path in (FOLDER / "schemas").glob("*.json")} == KINDS
    readme = (FOLDER / "schemas/README.md").read_text()
    assert all(f"`{kind}`" in readme for kind in KINDS)


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_the_schemas_refuse_what_is_misspelt(kind):
    (resource,) = (found for (its, _), found in OWN.items() if its == kind)
    with pytest.raises(ValidationError, match="'targetRef5' was unexpected"):
        validate(resource | {"spec": resource["spec"] | {"targetRef5": []}})


def test_the_kustomization_lists_every_file():
    own = {name for name in kustomization()["resources"] if name.endswith(".yaml")}
    assert own | {"kustomization.yaml"} == {path.name for path in FOLDER.glob("*.yaml")}
    assert kustomization()["namespace"] == "rfedge"


def test_streams_are_placed_by_the_metadata_that_vehicles_send():
    policy = OWN["BackendTrafficPolicy", "edge"]["spec"]["loadBalancer"]
    hashed = [header["name"] for header in policy["consistentHash"]["headers"]]
    assert hashed == [TILE, VEHICLE]
    named, anything = OWN["GRPCRoute", "edge"]["spec"]["rules"]
    assert [header["name"] for header in named["matches"][0]["headers"]] == [TILE]
    assert "matches" not in anything


def test_references_find_what_they_name():
    route, gateway = OWN["GRPCRoute", "edge"]["spec"], OWN["Gateway", "edge"]["spec"]
    (parent,) = route["parentRefs"]
    assert parent["sectionName"] in {listener["name"] for listener in gateway["listeners"]}
    for rule in route["rules"]:
        (backend,) = rule["backendRefs"]
        (port,) = BASE["Service", backend["name"]]["spec"]["ports"]
        assert port["port"] == backend["port"]
    for policy in (each for (kind, _), each in OWN.items() if kind.endswith("Policy")):
        (target,) = policy["spec"]["targetRefs"]
        assert (target["kind"], target["name"]) in OWN | BASE


def test_patches_take_envoy_out_and_nothing_else():
    removed, changed = set(), set()
    for patch in kustomization()["patches"]:
        content, target = yaml.safe_load(patch["patch"]), patch["target"]
        key = (target["kind"], target["name"])
        assert key in BASE
        (changed if isinstance(content, list) else removed).add(key)
        if isinstance(content, dict):
            assert content.pop("$patch") == "delete"
            base = BASE[key]
            assert content == {
                "apiVersion": base["apiVersion"],
                "kind": key[0],
                "metadata": {"name": key[1]},
            }
    assert removed == {key for key in BASE if key[1] in ("edge", "envoy", "proxy")}
    assert changed == {("NetworkPolicy", "servers")}


def test_the_pods_of_the_gateway_are_who_reaches_the_servers():
    (patch,) = (p for p in kustomization()["patches"] if p["target"]["name"] == "servers")
    (operation,) = yaml.safe_load(patch["patch"])
    assert (operation["op"], operation["path"]) == ("replace", "/spec/ingress/0/from")
    rule = BASE["NetworkPolicy", "servers"]["spec"]["ingress"][0]
    assert rule["from"] == [{"podSelector": {"matchLabels": {"app": "envoy"}}}]
    (allowed,) = operation["value"]
    assert allowed["podSelector"]["matchLabels"] == {
        "gateway.envoyproxy.io/owning-gateway-namespace": kustomization()["namespace"],
        "gateway.envoyproxy.io/owning-gateway-name": "edge",
    }


def test_policies_say_what_the_configuration_that_is_run_says():
    config = yaml.safe_load((ROOT / "deploy/envoy/envoy-mtls.yaml").read_text())
    (cluster,) = config["static_resources"]["clusters"]
    (check,) = cluster["health_checks"]
    health = OWN["BackendTrafficPolicy", "edge"]["spec"]["healthCheck"]
    assert health["active"]["grpc"]["service"] == check["grpc_health_check"]["service_name"]
    assert health["active"]["unhealthyThreshold"] == check["unhealthy_threshold"]
    assert (
        health["passive"]["maxEjectionPercent"]
        == (cluster["outlier_detection"]["max_ejection_percent"])
    )
    context = cluster["transport_socket"]["typed_config"]["common_tls_context"]
    (name,) = context["validation_context"]["match_typed_subject_alt_names"]
    (given,) = OWN["BackendTLSPolicy", "mec-servers"]["spec"]["validation"]["subjectAltNames"]
    assert given == {"type": name["san_type"], "uri": name["matcher"]["exact"]}
