"""Dashboards are what their description makes, complete, and ask only for what exists."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

from rfcore.errors import InvalidInput
from rfedge.dashboards.__main__ import write_dashboards
from rfedge.dashboards.catalogue import DASHBOARDS
from rfedge.dashboards.grafana import DATASOURCE, Panel, Query, Unit
from rfedge.pages.metrics import families

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
