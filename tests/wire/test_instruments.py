"""Metrics follow the conventions, and the document lists exactly what exists."""

import re
from pathlib import Path

import pytest
from prometheus_client import CollectorRegistry, generate_latest

from rfcore.errors import InvalidInput
from rfcore.wire.conventions import FRAME_BUDGET_BUCKETS_S
from rfcore.wire.instruments import Instruments
from rfedge.pages.metrics import families, metrics_page

ROOT = Path(__file__).parents[2]
DECLARED = {family.name: family for listed in families().values() for family in listed}


def test_the_document_is_what_the_code_declares() -> None:
    written = (ROOT / "docs/metrics.md").read_text()
    assert written == metrics_page(), "run `make figures`"


def test_every_metric_is_in_the_document_and_the_reverse() -> None:
    written = set(re.findall(r"^\| `(\w+)`", (ROOT / "docs/metrics.md").read_text(), re.M))
    assert written == set(DECLARED)


@pytest.mark.parametrize("name", sorted(DECLARED))
def test_a_name_says_its_unit_and_kind(name: str) -> None:
    family = DECLARED[name]
    assert name.endswith("_total") == (family.kind == "counter")
    assert name.endswith("_info") == ("1; " in family.text or "1 for each" in family.text)
    assert not re.search(r"_(ms|ns|milliseconds|kb|mb|bits)(_|$)", name)


def test_what_is_declared_is_what_is_served() -> None:
    """Declared names are ours; served ones are the client library's: its endings included."""
    registry = CollectorRegistry()
    make = Instruments(registry)
    make.process()
    make.counter("rfedge_x_bytes", "Bytes.").inc(3)
    make.gauge("rfedge_y", "Things.").set(2)
    make.seconds("rfedge_z_seconds", "Time.").observe(0.004)
    served = generate_latest(registry).decode()
    helped = set(re.findall(r"^# HELP (\w+)", served, re.M))
    assert {family.name for family in make.families} == {
        name for name in helped if not name.endswith("_created")
    }
    assert "rfedge_x_bytes_total 3.0" in served
    assert 'rfedge_z_seconds_bucket{le="0.005"} 1.0' in served


def test_buckets_hold_the_frame_budgets() -> None:
    for rate_hz in (200, 100, 60, 30, 20, 10, 5):
        nearest = min(FRAME_BUDGET_BUCKETS_S, key=lambda b: abs(b - 1 / rate_hz))
        assert nearest == pytest.approx(1 / rate_hz, rel=0.01)


@pytest.mark.parametrize(
    ("name", "text", "problem"),
    [
        ("other_seconds", "Time.", "must begin with rfedge_"),
        ("rfedge_x_seconds", "Time", "must be a sentence"),
        ("rfedge_x_ms", "Time.", "end it in _seconds"),
    ],
)
def test_a_name_against_the_conventions_is_refused(name: str, text: str, problem: str) -> None:
    with pytest.raises(InvalidInput, match=problem):
        Instruments(CollectorRegistry()).seconds(name, text)
