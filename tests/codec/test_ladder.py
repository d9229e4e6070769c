"""The ladder's file and front: what is read back, what beats what, what is refused by name."""

import json
from pathlib import Path
from typing import Any

import pytest

from rfcore.codec.sender.ladder import MeasuredRung, Rung, front, read_ladder
from rfcore.errors import InvalidData, InvalidInput
from rfcore.field import Quality


def row(ms: float, rate: float, crf: float = 28.0, **knobs: Any) -> dict[str, Any]:
    settings = {
        "kind": "splats", "detail": 1.0, "sh_degree": None, "samples_per_ray": None, "scale": 1.0,
        "references": 3, "photometric": True, "preset": "medium", "crf": crf, **knobs,
    }  # fmt: skip
    return {"settings": settings, "sender_ms": ms, "receiver_ms": 10.0, "rate_percent": rate}


def write(path: Path, *rows: dict[str, Any], kind: str = "ladder") -> Path:
    path.write_text(json.dumps({"kind": kind, "rows": rows}))
    return path


def test_a_rung_is_named_by_what_distinguishes_it() -> None:
    assert Rung().name == "100% 3ref medium"
    low = Rung(Quality(0.25, 0, 16, 0.5), 0, photometric=False, preset="ultrafast")
    assert low.name == "25% sh0 16samples half-size render-only no-light ultrafast"
    assert Rung(references=2, fast_unsent=True).name == "100% 2ref rough medium"


def test_a_ladder_measured_before_references_could_be_rough_has_none_that_are(
    tmp_path: Path,
) -> None:
    path = write(tmp_path / "ladder.json", row(80, 0), row(60, 3, rough=True))
    assert [r.rung.fast_unsent for r in read_ladder(path, "splats", 28)] == [False, True]


def test_the_front_is_faster_step_by_step_and_never_worse_than_what_it_leaves_out() -> None:
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


def test_a_ladder_is_read_for_its_kind_and_the_nearest_crf(tmp_path: Path) -> None:
    path = write(
        tmp_path / "ladder.json",
        row(80, 0),
        row(50, 9, detail=0.5, sh_degree=1, references=1, photometric=False, preset="veryfast"),
        row(70, 0, crf=35.0),
        row(9, 0, kind="ngp"),
    )
    rungs = read_ladder(path, "splats", 23.0)
    assert [r.sender_ms for r in rungs] == [80, 50]
    assert rungs[1].rung == Rung(Quality(0.5, 1), 1, photometric=False, preset="veryfast")
    assert [r.sender_ms for r in read_ladder(path, "splats", 50.0)] == [70]


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
def test_a_file_that_is_no_ladder_is_refused_by_name(
    tmp_path: Path, content: str, named: str
) -> None:
    path = tmp_path / "ladder.json"
    path.write_text(content)
    with pytest.raises(InvalidData, match=rf"ladder\.json.*{named}.*rfedge eval ladder"):
        read_ladder(path, "splats", 23.0)
    with pytest.raises(InvalidData, match="nowhere"):
        read_ladder(tmp_path / "nowhere.json", "splats", 23.0)


@pytest.mark.parametrize("knob", [{"references": 4}, {"references": -1}, {"preset": "placebo"}])
def test_a_rung_that_is_none_is_refused(knob: dict[str, Any]) -> None:
    with pytest.raises(InvalidInput, match=f"rung.{next(iter(knob))}"):
        Rung(**knob)
