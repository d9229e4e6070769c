"""Grafana takes the dashboards, and they ask only for metrics that exist."""

import json
import re
from pathlib import Path

import pytest

from lab.pages.metrics import families

DEPLOY = Path(__file__).parents[2] / "deploy"
FILES = sorted((DEPLOY / "grafana/dashboards").glob("*.json"))
RECORDED = set(re.findall(r"- record: (\S+)", (DEPLOY / "prometheus/rules.yml").read_text()))
UNITS = {"bps", "bytes", "short", "hertz", "s", "percentunit"}
"""Those of Grafana's names of units that our metrics need."""
DATASOURCE = {"type": "prometheus", "uid": "prometheus"}
PANELS = [
    pytest.param(panel, id=f"{path.stem}-{panel['title']}")
    for path in FILES
    for panel in json.loads(path.read_text())["panels"]
]


def served() -> set[str]:
    names = {"up"}
    for listed in families().values():
        for family in listed:
            parts = ("_bucket", "_count", "_sum") if family.kind == "histogram" else ("",)
            names |= {family.name + part for part in parts}
    return names


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_dashboard_is_one_that_grafana_takes(path):
    dashboard = json.loads(path.read_text())
    assert dashboard["uid"] == path.stem
    assert len(dashboard["uid"]) <= 40, "Grafana's limit"
    assert dashboard["schemaVersion"] == 39
    assert dashboard["title"]
    ids = [panel["id"] for panel in dashboard["panels"]]
    assert len(set(ids)) == len(ids) > 0
    taken = [tuple(panel["gridPos"].values()) for panel in dashboard["panels"]]
    assert len(set(taken)) == len(taken), "no panel lies on another"
    assert all(x + w <= 24 for x, _, w, _ in taken)


@pytest.mark.parametrize("panel", PANELS)
def test_a_panel_has_a_unit_a_description_and_asks_for_what_exists(panel):
    assert panel["title"]
    assert panel["description"].endswith(".")
    assert panel["fieldConfig"]["defaults"]["unit"] in UNITS
    assert panel["datasource"] == DATASOURCE
    assert panel["targets"]
    for target in panel["targets"]:
        asked = re.findall(r"(?:instance:)?(?:rfedge|process)_\w+(?::\w+)?", target["expr"])
        assert asked
        assert set(asked) <= served() | RECORDED, target["expr"]


def test_the_data_source_is_the_one_that_is_provisioned():
    provisioned = (DEPLOY / "grafana/provisioning/datasources/prometheus.yaml").read_text()
    assert f"uid: {DATASOURCE['uid']}\n" in provisioned
    assert f"type: {DATASOURCE['type']}\n" in provisioned


def labels_of(expr: str) -> set[str]:
    """Return what tells the series of an expression apart."""
    if grouped := re.search(r"(?:sum|count) by \(([^)]*)\)", expr):
        return {label.strip() for label in grouped[1].split(",")} - {"le"}
    if re.match(r"(8 \* )?sum\(", expr):
        return set()
    labels = {"instance"}
    for listed in families().values():
        for family in listed:
            if re.search(rf"\b{family.name}(_bucket|_sum|_count)?\b", expr):
                labels |= set(family.labels)
    return labels


@pytest.mark.parametrize("panel", PANELS)
def test_a_legend_tells_the_series_of_its_panel_apart(panel):
    """Two lines of one name cannot be read: a server's age of the twin is one line a vehicle."""
    if panel["type"] == "table":
        return
    legends = [target["legendFormat"] for target in panel["targets"]]
    assert len(set(legends)) == len(legends)
    for target, legend in zip(panel["targets"], legends, strict=True):
        assert labels_of(target["expr"]) <= set(re.findall(r"\{\{(\w+)\}\}", legend))


def test_the_labels_of_an_expression_are_found():
    assert labels_of("rfedge_twin_age_seconds{instance=~'$instance'}") == {"instance", "vehicle"}
    assert labels_of("rate(rfedge_link_bytes_total[1m])") == {"instance", "direction"}
    assert labels_of("histogram_quantile(0.5, sum by (instance, le) (rate(x[1m])))") == {"instance"}
    assert labels_of("8 * sum(rate(rfedge_link_bytes_total[1m]))") == set()
