"""What is written about the demo says what Prometheus said, and nothing that was not asked."""

import importlib.util
import json
import sys
from pathlib import Path
from typing import Any

import pytest

from rfcore.errors import RfedgeError

ROOT = Path(__file__).parents[2]


def loaded() -> Any:
    spec = importlib.util.spec_from_file_location("compose_show", ROOT / "deploy/compose/show.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


show = loaded()
MEASURED = json.loads((ROOT / "deploy/compose/measured.json").read_text())


def test_the_page_is_what_the_measured_run_makes() -> None:
    page = (ROOT / "docs/operations.md").read_text()
    made = page.partition(show.BEGIN)[2].partition(show.END)[0].strip("\n")
    assert made == show.section(MEASURED)


def test_the_recorded_demo_kept_its_deadline() -> None:
    """Four vehicles, 320x180 at 5 Hz or more; 99 % of all captured pictures within 150 ms."""
    assert len(MEASURED["vehicles"]) == 4
    width_px, height_px = map(int, MEASURED["settings"]["PICTURE_SIZE"].split("x"))
    assert width_px >= 320
    assert height_px >= 180
    for row in MEASURED["vehicles"]:
        assert row["captured_per_s"] >= 4.9
        assert row["in_time"] >= 0.99
        assert row["p99_ms"] <= 150
    assert set(MEASURED["targets"].values()) == {"up"}


def test_every_dashboard_has_its_figure() -> None:
    for dashboard in show.DASHBOARDS:
        assert (ROOT / f"docs/figures/{dashboard.uid}.svg").is_file()


def test_curves_of_one_panel_have_names_of_their_own() -> None:
    for name, panel in MEASURED["panels"].items():
        shown_as_lines = not name.endswith(("What is running", "Fields in use"))
        assert len(panel["newest"]) == panel["series"] or not shown_as_lines, name


def test_a_legend_holds_its_labels_values() -> None:
    labels = {"instance": "rsu-a:9100", "vehicle": "cav-1"}
    assert show.legend_text("{{instance}} {{vehicle}} p99", labels) == "rsu-a:9100 cav-1 p99"
    assert show.legend_text("{{instance}} {{missing}}", labels) == "rsu-a:9100"


def test_grafanas_variables_are_filled_in() -> None:
    asked = show.filled("increase(x{instance=~'$instance'}[$__range]) + rate(y[$__rate_interval])")
    assert asked == "increase(x{instance=~'.*'}[300s]) + rate(y[1m])"


def test_without_prometheus_the_error_says_what_to_start(
    monkeypatch: pytest.MonkeyPatch, free_port: int
) -> None:
    monkeypatch.setattr(show, "PROMETHEUS", f"http://127.0.0.1:{free_port}")
    with pytest.raises(RfedgeError, match="run `make up` first"):
        show.ask("query", query="up")


def test_a_vehicles_share_counts_what_was_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    """In time are Acks within 150 ms, of all pictures that were captured."""
    asked = []

    def ask(_path: str, **parameters: str) -> Any:
        asked.append(parameters["query"])
        value = {"metric": {"instance": "cav-3:9100"}, "value": [0, "0.5"]}
        return {"result": [value]}

    monkeypatch.setattr(show, "ask", ask)
    (row,) = show.vehicles()
    assert row["vehicle"] == "cav-3"
    assert row["in_time"] == 0.5
    share = asked[-1]
    assert 'capture_to_ack_seconds_bucket{le="0.15"}' in share
    assert share.endswith("increase(rfedge_agent_frames_total[300s]))")
