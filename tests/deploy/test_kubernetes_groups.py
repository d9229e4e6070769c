"""deploy/kubernetes-groups: what Kustomize makes of it, against schemas and its parts.

Kustomize is imitated as far as the example goes: patches, a label in selectors, a prefix of names.
"""

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
import yaml

from deploy.test_kubernetes import VERSIONS, documents
from envoy_config import check_config
from lab.servers.envoy import EnvoySetup, envoy_binary
from rfcore.wire.conventions import TILE
from rfedge.certs import Members, certify, write_certificates

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "deploy/kubernetes-groups"
GROUPS = ("west", "east")
LABEL = "rfedge-group"
Resource = dict[str, Any]


def kustomization(name: str) -> Resource:
    read: Resource = yaml.safe_load((FOLDER / name / "kustomization.yaml").read_text())
    return read


def made(group: str) -> dict[tuple[str, str], Resource]:
    """Return the resources of a group by kind and name; Envoy's ConfigMap is no resource yet."""
    read = {(d["kind"], d["metadata"]["name"]): d for d in documents()}
    overlay = kustomization(group)
    assert overlay["resources"] == ["../../kubernetes"]
    for patch in overlay["patches"]:
        key = (patch["target"]["kind"], patch["target"]["name"])
        content = yaml.safe_load(patch["patch"])
        if isinstance(content, list):
            for operation in content:
                change(read[key], operation)
        elif key != ("ConfigMap", "envoy"):
            assert content == identity(read.pop(key)) | {"$patch": "delete"}
    for labels in overlay.get("labels", ()):
        for resource in read.values():
            label(resource, labels["pairs"])
    for resource in read.values():
        prefix(resource, overlay.get("namePrefix", ""))
    return {(d["kind"], d["metadata"]["name"]): d for d in read.values()}


def identity(resource: Resource) -> Resource:
    name = {"name": resource["metadata"]["name"]}
    return {
        "apiVersion": resource["apiVersion"], "kind": resource["kind"], "metadata": name,
    }  # fmt: skip


def change(resource: Resource, operation: Resource) -> None:
    """Apply a JSON patch that adds or replaces a key of an object."""
    *way, last = operation["path"].lstrip("/").split("/")
    place: Any = resource
    for step in way:
        place = place[int(step) if isinstance(place, list) else step]
    assert (last in place) == (operation["op"] == "replace")
    place[last] = operation["value"]


def label(resource: Resource, pairs: dict[str, str]) -> None:
    """Add a label to the selectors and pods of a resource (``includeSelectors``)."""
    spec = resource["spec"]
    if resource["kind"] == "Service":
        spec["selector"] |= pairs
    elif "selector" in spec:
        spec["selector"]["matchLabels"] |= pairs
    if "template" in spec:
        spec["template"]["metadata"]["labels"] |= pairs
        for spread in spec["template"]["spec"].get("topologySpreadConstraints", ()):
            spread["labelSelector"]["matchLabels"] |= pairs


def prefix(resource: Resource, text: str) -> None:
    """Put a prefix before the resource's name and the names of others that it refers to."""
    resource["metadata"]["name"] = text + resource["metadata"]["name"]
    spec = resource["spec"]
    if "serviceName" in spec:
        spec["serviceName"] = text + spec["serviceName"]
    if "scaleTargetRef" in spec:
        spec["scaleTargetRef"]["name"] = text + spec["scaleTargetRef"]["name"]


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("group", ["any", *GROUPS])
def test_every_resource_is_valid_to_the_letter(group, version):
    from kubernetes_validate import validate

    resources = made(group)
    assert resources
    for resource in resources.values():
        validate(resource, version, strict=True)


def test_no_two_groups_have_a_name_or_a_pod_in_common():
    every = [key for group in ("any", *GROUPS) for key in made(group)]
    assert len(every) == len(set(every))
    for group in ("any", *GROUPS):
        servers = {key[0]: found for key, found in made(group).items() if "mec-server" in key[1]}
        wanted = {"app": "mec-server", LABEL: group}
        stateful = servers["StatefulSet"]["spec"]
        assert servers["Service"]["spec"]["selector"] == wanted
        assert servers["PodDisruptionBudget"]["spec"]["selector"]["matchLabels"] == wanted
        assert stateful["selector"]["matchLabels"] == wanted
        assert stateful["template"]["metadata"]["labels"] == wanted
        (spread,) = stateful["template"]["spec"]["topologySpreadConstraints"]
        assert spread["labelSelector"]["matchLabels"] == wanted
        claim = stateful["template"]["spec"]["volumes"][0]["persistentVolumeClaim"]["claimName"]
        assert claim == ("fields" if group == "any" else f"fields-{group}")


def test_policies_are_those_of_every_group_and_go_by_the_label_app():
    policies = {key: found for key, found in made("any").items() if key[0] == "NetworkPolicy"}
    base = {(d["kind"], d["metadata"]["name"]): d for d in documents()}
    assert policies
    assert all(base[key] == found for key, found in policies.items())
    assert not any(kind == "NetworkPolicy" for group in GROUPS for kind, _ in made(group))


def test_the_kustomization_lists_every_file_and_replaces_envoys_configuration():
    top = kustomization(".")
    assert top["resources"] == ["any", *GROUPS]
    (generated,) = top["configMapGenerator"]
    assert generated == {"name": "envoy", "behavior": "replace", "files": ["envoy.yaml"]}
    files = {path.name for path in FOLDER.iterdir()}
    assert files == {"kustomization.yaml", "envoy.yaml", *top["resources"]}


def test_envoy_has_a_route_and_a_cluster_for_each_group_and_nothing_else_is_another():
    one, groups = (
        yaml.safe_load((folder / "envoy.yaml").read_text())
        for folder in (ROOT / "deploy/kubernetes", FOLDER)
    )
    (default,), clusters = (
        one["static_resources"]["clusters"], groups["static_resources"].pop("clusters"),
    )  # fmt: skip
    assert clusters.pop(0) == default
    for name, cluster in zip(GROUPS, clusters, strict=True):
        load = cluster.pop("load_assignment")
        (endpoint,) = load["endpoints"][0]["lb_endpoints"]
        where = endpoint["endpoint"]["address"]["socket_address"]
        (port,) = made(name)["Service", where["address"]]["spec"]["ports"]
        assert (load["cluster_name"], where["port_value"]) == (name, port["port"])
        assert cluster == {k: v for k, v in default.items() if k != "load_assignment"} | {
            "name": name
        }
    (route,), routes = routes_of(one), routes_of(groups)
    for name, own in zip(GROUPS, routes[:-1], strict=True):
        header = {"name": TILE, "string_match": {"exact": name}}
        assert own["match"] == route["match"] | {"headers": [header]}
        assert own["route"] == route["route"] | {"cluster": name}
    del one["static_resources"]["clusters"], routes[:-1]
    assert groups == one


def routes_of(config: Resource) -> list[Resource]:
    (listener,) = config["static_resources"]["listeners"]
    (chain,) = listener["filter_chains"]
    (host,) = chain["filters"][0]["typed_config"]["route_config"]["virtual_hosts"]
    routes: list[Resource] = host["routes"]
    return routes


def test_envoy_accepts_the_configuration(tmp_path):
    members = Members((), proxies=("edge-proxy",))
    write_certificates(tmp_path / "certs", certify(members, datetime.now(UTC), days=30))
    check_config(EnvoySetup(envoy_binary(), FOLDER / "envoy.yaml", tmp_path))
