"""The committed page of metrics is what the processes declare."""

from pathlib import Path

from lab.pages.metrics import _row, families, metrics_page
from rfcore.wire.instruments import Family

ROOT = Path(__file__).parents[2]


def test_the_page_is_generated_from_the_declarations() -> None:
    page = (ROOT / "docs/metrics.md").read_text()
    assert page == metrics_page(), "run `make figures`"


def test_every_declared_metric_has_its_line_under_its_command() -> None:
    sections = metrics_page().split("## `")[1:]
    declared = families()
    assert [section.split("`")[0] for section in sections] == list(declared)
    for section, metrics in zip(sections, declared.values(), strict=True):
        lines = [line for line in section.splitlines() if line.startswith("| `")]
        names = [line.split("`")[1] for line in lines]
        assert names == sorted(metric.name for metric in metrics)


def test_a_label_that_a_flag_adds_is_a_mark_and_no_label() -> None:
    family = Family("rfedge_server_frames_total", "counter", "Frames.", ("vehicle", "result"))
    assert _row(family) == "| `rfedge_server_frames_total` * | counter | result | Frames. |\n"
    plain = Family("rfedge_agent_info", "gauge", "Which it is.", ("vehicle", "camera"))
    assert _row(plain) == "| `rfedge_agent_info` | gauge | vehicle, camera | Which it is. |\n"
