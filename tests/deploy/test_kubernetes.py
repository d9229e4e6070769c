"""deploy/kubernetes against the schemas of Kubernetes, and its parts against each other."""

import re
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
import yaml

from lab.pages.metrics import families

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "deploy/kubernetes"
VERSIONS = ("1.32", "1.37")
NOW = datetime(2030, 1, 2, tzinfo=UTC)


def documents() -> list[dict[str, Any]]:
    """Every resource that the kustomization lists."""
    listed = yaml.safe_load((FOLDER / "kustomization.yaml").read_text())["resources"]
    texts = [(FOLDER / name).read_text() for name in listed]
    return [document for text in texts for document in yaml.safe_load_all(text)]


def the(kind: str, name: str) -> dict[str, Any]:
    (found,) = (d for d in documents() if (d["kind"], d["metadata"]["name"]) == (kind, name))
    return found


def pods() -> dict[str, dict[str, Any]]:
    """The pod templates, by the label app."""
    made = [d["spec"]["template"] for d in documents() if "template" in d["spec"]]
    return {template["metadata"]["labels"]["app"]: template["spec"] for template in made}


@pytest.mark.parametrize("version", VERSIONS)
def test_every_resource_is_valid_to_the_letter(version):
    from kubernetes_validate import validate

    resources = documents()
    assert resources
    for document in resources:
        validate(document, version, strict=True)


def test_the_schemas_refuse_what_is_misspelt():
    from kubernetes_validate import ValidationError, validate

    broken = the("StatefulSet", "mec-server")
    broken["spec"]["replica"] = 3
    with pytest.raises(ValidationError, match="replica"):
        validate(broken, VERSIONS[0], strict=True)


def test_the_kustomization_lists_every_file():
    listed = yaml.safe_load((FOLDER / "kustomization.yaml").read_text())
    (generated,) = listed["configMapGenerator"]
    named = {"kustomization.yaml", *listed["resources"], *generated["files"]}
    assert named == {path.name for path in FOLDER.iterdir()}


def test_selectors_find_pods_and_names_what_they_name():
    labels = set(pods())
    for document in documents():
        text = yaml.safe_dump(document["spec"])
        assert set(re.findall(r"\bapp: (\S+)", text)) <= labels, document["kind"]
    for kind, spec in ((d["kind"], d["spec"]) for d in documents()):
        if kind == "HorizontalPodAutoscaler":
            target = spec["scaleTargetRef"]
            the(target["kind"], target["name"])
            (metric,) = spec["metrics"]
            name = metric["pods"]["metric"]["name"]
            assert name in {f.name for f in families()["mec-server"] if f.kind == "gauge"}
        if kind == "StatefulSet":
            the("Service", spec["serviceName"])
    for app in labels:
        (container,) = pods()[app]["containers"]
        volumes = {volume["name"] for volume in pods()[app]["volumes"]}
        assert {mount["name"] for mount in container["volumeMounts"]} == volumes
        ports = {port["name"] for port in container["ports"]}
        probes = (value for key, value in container.items() if key.endswith("Probe"))
        assert {p.get("httpGet", p.get("tcpSocket"))["port"] for p in probes} <= ports


def test_the_adapter_offers_the_metric_that_servers_are_scaled_by():
    (rule,) = yaml.safe_load((ROOT / "deploy/prometheus/adapter.yaml").read_text())["rules"]
    (metric,) = the("HorizontalPodAutoscaler", "mec-server")["spec"]["metrics"]
    name = metric["pods"]["metric"]["name"]
    assert rule["name"]["as"] == name
    assert rule["seriesQuery"].partition("{")[0] == name


def test_servers_may_reach_nats_and_names_and_nothing_else():
    egress = the("NetworkPolicy", "servers")["spec"]["egress"]
    reached = {
        (to["namespaceSelector"]["matchLabels"]["kubernetes.io/metadata.name"], port["port"])
        for rule in egress
        for to in rule["to"]
        for port in rule["ports"]
    }
    assert reached == {("nats", 4222), ("kube-system", 53)}


def test_servers_are_started_with_options_that_there_are(tmp_path):
    from mec_server.config import ServerConfig
    from rfcore.program import parse_options
    from rfedge.certs import Members, certify, write_certificates

    (container,) = pods()["mec-server"]["containers"]
    certs = tmp_path / "certs"
    write_certificates(certs, certify(Members(()), NOW, 10))
    (tmp_path / "fields").mkdir()
    given = [re.sub(r"=/(certs|fields)", f"={tmp_path}/\\1", arg) for arg in container["args"]]
    config = parse_options(ServerConfig, "mec-server", given)
    assert config.proxy_identity == ("edge-proxy",)
    grace_s = pods()["mec-server"]["terminationGracePeriodSeconds"]
    assert grace_s >= 2 * (config.drain_hold_s + config.drain_s)


def test_envoy_differs_from_the_one_that_is_run_in_where_it_listens_and_finds_servers():
    here, run = (
        yaml.safe_load(path.read_text())["static_resources"]
        for path in (FOLDER / "envoy.yaml", ROOT / "deploy/envoy/envoy-mtls.yaml")
    )
    for config, only in (
        (here, ("load_assignment", "dns_refresh_rate")),
        (run, ("eds_cluster_config",)),
    ):
        (listener,), (cluster,) = config["listeners"], config["clusters"]
        assert listener["address"]["socket_address"].pop("address")
        for key in ("type", *only):
            assert cluster.pop(key)
    assert here == run
    headless = yaml.safe_load((FOLDER / "envoy.yaml").read_text())
    (cluster,) = headless["static_resources"]["clusters"]
    (endpoint,) = cluster["load_assignment"]["endpoints"][0]["lb_endpoints"]
    where = endpoint["endpoint"]["address"]["socket_address"]
    (port,) = the("Service", where["address"])["spec"]["ports"]
    assert port["port"] == where["port_value"]
