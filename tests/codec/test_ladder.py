"""The ladder's file and front: what is read back, what beats what, what is refused by name."""

import json
from pathlib import Path
from typing import Any

import pytest

from rfcore.codec.h264.config import Coder
from rfcore.codec.sender.ladder import MeasuredRung, Rung, TrackingEffort, front, read_ladder
from rfcore.errors import InvalidData, InvalidInput
from rfcore.field import Quality


def row(ms: float, rate: float, crf: float = 28.0, **knobs: Any) -> dict[str, Any]:
    settings = {
        "kind": "splats", "detail": 1.0, "sh_degree": None, "samples_per_ray": None, "scale": 1.0,
        "references": 3, "photometric": True, "effort": "default", "crf": crf, **knobs,
    }  # fmt: skip
    return {"settings": settings, "sender_ms": ms, "receiver_ms": 10.0, "rate_percent": rate}


def write(
    path: Path,
    *rows: dict[str, Any],
    kind: str = "ladder",
    tracking: tuple[dict[str, Any], ...] = (),
) -> Path:
    path.write_text(json.dumps({"kind": kind, "rows": rows, "tracking": tracking}))
    return path


def track(effort: str, ms: float | None, rate: float | None, **knobs: Any) -> dict[str, Any]:
    settings = row(1, 0, **knobs)["settings"]
    kept = {
        key: settings[key] for key in ("kind", "detail", "sh_degree", "samples_per_ray", "scale")
    }
    return {"settings": kept, "tracking": effort, "track_ms": ms, "rate_percent": rate}


def test_a_rung_is_named_by_what_distinguishes_it():
    assert Rung().name == "100% 3ref default"
    low = Rung(Quality(0.25, 0, 16, 0.5), 0, photometric=False, effort="fast")
    assert low.name == "25% sh0 16samples half-size render-only no-light fast"
    assert Rung(tracking=TrackingEffort.HALF).name == "100% 3ref default track-half"


def test_a_ladder_has_rungs_of_one_coder(tmp_path):
    path = write(tmp_path / "ladder.json", row(40, 0), row(80, 0, effort="x264-medium"))
    assert [r.rung.effort for r in read_ladder(path, "splats", 28)] == ["default"]
    (kept,) = read_ladder(path, "splats", 28, Coder.X264)
    assert (kept.rung.effort, kept.sender_ms) == ("x264-medium", 80)
    other = write(tmp_path / "other.json", row(80, 0, effort="x264-medium"))
    with pytest.raises(InvalidData, match="no rungs for splats with the coder own"):
        read_ladder(other, "splats", 28)


def test_the_front_is_faster_step_by_step_and_never_worse_than_what_it_leaves_out():
    rungs = [
        MeasuredRung(Rung(), ms, 1.0, rate)
        for ms, rate in [(80, 0), (90, 0), (60, 5), (70, 5), (60, 9), (20, 40), (30, 39), (25, 41)]
    ]
    kept = front(rungs)
    assert [(r.sender_ms, r.rate_percent) for r in kept] == [(80, 0), (60, 5), (30, 39), (20, 40)]
    for left_out in set(rungs) - set(kept):
        assert any(
            k.sender_ms <= left_out.sender_ms and k.rate_percent <= left_out.rate_percent
            for k in kept
        )


def test_a_ladder_is_read_for_its_kind_and_the_nearest_crf(tmp_path):
    path = write(
        tmp_path / "ladder.json",
        row(80, 0),
        row(50, 9, detail=0.5, sh_degree=1, references=1, photometric=False, effort="fast"),
        row(70, 0, crf=35.0),
        row(9, 0, kind="ngp"),
    )
    rungs = read_ladder(path, "splats", 23.0)
    assert [r.sender_ms for r in rungs] == [80, 50]
    assert rungs[1].rung == Rung(Quality(0.5, 1), 1, photometric=False, effort="fast")
    assert [r.sender_ms for r in read_ladder(path, "splats", 50.0)] == [70]


def test_a_sender_that_localises_plans_with_the_time_and_rate_of_tracking(tmp_path):
    """Each rung with each effort at its quality; the efforts that lost the drive are left out."""
    tracks = (
        track("full", 20, 1.0),
        track("once", 12, 2.0),
        track("half", 6, 10.0),
        track("full", 9, 50.0, detail=0.5),
        track("once", None, None, detail=0.5),
        track("half", 1, 0.0, kind="ngp"),
    )
    rows = row(40, 0), row(30, 20, effort="fast"), row(20, 50, detail=0.5), row(5, 99, detail=0.1)
    path = write(tmp_path / "ladder.json", *rows, tracking=tracks)
    assert [r.sender_ms for r in read_ladder(path, "splats", 28)] == [40, 30, 20, 5]
    planned = read_ladder(path, "splats", 28, tracking=True)
    assert [(r.rung.tracking, r.sender_ms) for r in planned] == [
        ("full", 60),
        ("once", 52),
        ("half", 46),
        ("once", 42),
        ("half", 36),
        ("full", 29),
    ]
    rates = [r.rate_percent for r in planned]
    assert rates == pytest.approx([1.0, 2.0, 10.0, 22.4, 32.0, 125.0])


def test_a_ladder_without_times_of_tracking_is_none_for_a_sender_that_localises(tmp_path):
    path = write(tmp_path / "ladder.json", row(40, 0))
    assert read_ladder(path, "splats", 28)
    with pytest.raises(InvalidData, match=r"ladder\.json.*no times of tracking.*eval ladder"):
        read_ladder(path, "splats", 28, tracking=True)
    write(path, row(40, 0), tracking=(track("full", -1, 0),))
    with pytest.raises(InvalidData, match=r"track_ms.*above 0"):
        read_ladder(path, "splats", 28, tracking=True)


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ("", "not a usable ladder"),
        ("[]", "not a usable ladder"),
        (json.dumps({"kind": "compare", "rows": []}), "another kind"),
        (json.dumps({"kind": "ladder", "rows": []}), "no rungs for splats"),
        (json.dumps({"kind": "ladder", "rows": [row(0, 0)]}), "must be above 0 ms"),
        (json.dumps({"kind": "ladder", "rows": [row(9, 0, detail=0.3)]}), "quality.detail"),
    ],
)
def test_a_file_that_is_no_ladder_is_refused_by_name(tmp_path, content, named):
    path = tmp_path / "ladder.json"
    path.write_text(content)
    with pytest.raises(InvalidData, match=rf"ladder\.json.*{named}.*rfedge eval ladder"):
        read_ladder(path, "splats", 23.0)
    with pytest.raises(InvalidData, match="nowhere"):
        read_ladder(tmp_path / "nowhere.json", "splats", 23.0)


@pytest.mark.parametrize("knob", [{"references": 5}, {"references": -1}, {"effort": "placebo"}])
def test_a_rung_that_is_none_is_refused(knob):
    with pytest.raises(InvalidInput, match=f"rung.{next(iter(knob))}"):
        Rung(**knob)
