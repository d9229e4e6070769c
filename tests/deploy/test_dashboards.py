"""Dashboards are what their description makes, complete, and ask only for what exists."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

from lab.pages.metrics import families
from rfcore.errors import InvalidInput
from rfedge.dashboards.__main__ import write_dashboards
from rfedge.dashboards.catalogue import DASHBOARDS
from rfedge.dashboards.grafana import DATASOURCE, Panel, Query, Unit

DEPLOY = Path(__file__).parents[2] / "deploy"
FILES = sorted((DEPLOY / "grafana/dashboards").glob("*.json"))
RECORDED = set(re.findall(r"- record: (\S+)", (DEPLOY / "prometheus/rules.yml").read_text()))


def served() -> set[str]:
    names = {"up"}
    for listed in families().values():
        for family in listed:
            parts = ("_bucket", "_count", "_sum") if family.kind == "histogram" else ("",)
            names |= {family.name + part for part in parts}
    return names


def panels() -> list[Any]:
    return [
        pytest.param(panel, id=f"{path.stem}-{panel['title']}")
        for path in FILES
        for panel in json.loads(path.read_text())["panels"]
    ]


def test_the_files_are_what_the_description_makes(tmp_path: Path) -> None:
    write_dashboards(tmp_path)
    made = {path.name: path.read_text() for path in tmp_path.iterdir()}
    assert {path.name: path.read_text() for path in FILES} == made, "run `make figures`"


def test_there_are_the_five_dashboards_an_operator_needs() -> None:
    names = {dashboard.uid.removeprefix("rfedge-") for dashboard in DASHBOARDS}
    assert names == {"fleet", "vehicle", "capacity", "link", "codec"}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_dashboard_is_one_that_grafana_takes(path: Path) -> None:
    dashboard = json.loads(path.read_text())
    assert dashboard["uid"] == path.stem
    assert len(dashboard["uid"]) <= 40, "Grafana's limit"
    assert dashboard["schemaVersion"] == 39
    assert dashboard["title"]
    assert dashboard["description"]
    ids = [panel["id"] for panel in dashboard["panels"]]
    assert ids == sorted(set(ids))
    taken = [tuple(panel["gridPos"].values()) for panel in dashboard["panels"]]
    assert len(set(taken)) == len(taken), "no panel lies on another"
    assert all(x + w <= 24 for x, _, w, _ in taken)


@pytest.mark.parametrize("panel", panels())
def test_a_panel_has_a_unit_a_description_and_asks_for_what_exists(panel: dict[str, Any]) -> None:
    assert panel["title"]
    assert panel["description"].endswith(".")
    assert panel["fieldConfig"]["defaults"]["unit"] in set(Unit)
    assert panel["datasource"] == DATASOURCE
    assert panel["targets"]
    for target in panel["targets"]:
        asked = re.findall(r"(?:instance:)?(?:rfedge|process)_\w+(?::\w+)?", target["expr"])
        assert asked
        assert set(asked) <= served() | RECORDED, target["expr"]


def test_the_data_source_is_the_one_that_is_provisioned() -> None:
    provisioned = (DEPLOY / "grafana/provisioning/datasources/prometheus.yaml").read_text()
    assert f"uid: {DATASOURCE['uid']}\n" in provisioned
    assert f"type: {DATASOURCE['type']}\n" in provisioned


def test_a_panel_without_a_description_is_refused() -> None:
    with pytest.raises(InvalidInput, match="needs a description"):
        Panel("Bytes", "", Unit.BYTES, (Query("up"),))


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


@pytest.mark.parametrize("panel", panels())
def test_a_legend_tells_the_series_of_its_panel_apart(panel: dict[str, Any]) -> None:
    """Two lines of one name cannot be read: a server's age of the twin is one line a vehicle."""
    if panel["type"] == "table":
        return
    legends = [target["legendFormat"] for target in panel["targets"]]
    assert len(set(legends)) == len(legends)
    for target, legend in zip(panel["targets"], legends, strict=True):
        assert labels_of(target["expr"]) <= set(re.findall(r"\{\{(\w+)\}\}", legend))


def test_the_labels_of_an_expression_are_found() -> None:
    assert labels_of("rfedge_twin_age_seconds{instance=~'$instance'}") == {"instance", "vehicle"}
    assert labels_of("rate(rfedge_link_bytes_total[1m])") == {"instance", "direction"}
    assert labels_of("histogram_quantile(0.5, sum by (instance, le) (rate(x[1m])))") == {"instance"}
    assert labels_of("8 * sum(rate(rfedge_link_bytes_total[1m]))") == set()
