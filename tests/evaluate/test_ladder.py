"""``rfedge eval ladder``: rates at equal quality, the front, and a run from files to a ladder."""

import json
from pathlib import Path

import pytest
from rich.console import Console

from rfcore.codec.references import RENDER_ONLY
from rfcore.codec.sender.ladder import Rung, read_ladder
from rfcore.errors import InvalidInput
from rfcore.field import Quality, load_field
from rfedge.evaluate.clips import read_drive
from rfedge.evaluate.field_coder import FieldCoder, render_clip
from rfedge.evaluate.ladder import EvalLadder, run
from rfedge.evaluate.ladder.measure import measure_rung, time_renders
from rfedge.evaluate.ladder.run import fronts, rate_percents, run_ladder, rungs_for

SAMPLES = Path(__file__).parents[2] / "samples"
ROW_KEYS = {
    "rung",
    "sender_ms",
    "receiver_ms",
    "bits_per_frame",
    "psnr_db",
    "ssim",
    "on_front",
    "rate_percent",
}


def curve(name: str, factor: float, shift_db: float = 0.0) -> list[dict]:
    """Bits double every 3 dB, times ``factor``; measured at qualities moved by ``shift_db``."""
    qualities = [30 + shift_db, 33 + shift_db, 36 + shift_db]
    return [
        {"rung": name, "psnr_db": db, "bits_per_frame": factor * 1000 * 2 ** ((db - 30) / 3)}
        for db in qualities
    ]


def test_the_rate_is_that_at_equal_quality_wherever_it_was_measured():
    curves = [curve("a", 1), curve("b", 1.3), curve("c", 1.3, 1.7), curve("d", 0.5, -2)]
    assert rate_percents(curves) == pytest.approx([0, 30, 30, -50])


def test_rungs_that_share_no_quality_cannot_be_compared():
    with pytest.raises(InvalidInput, match=r"b reaches 40\.0\.\.46\.0 dB, the first"):
        rate_percents([curve("a", 1), curve("b", 1, 10)])


def test_a_row_is_on_the_front_unless_one_of_its_crf_beats_it():
    def row(ms, rate, crf=28.0):
        return {"sender_ms": ms, "rate_percent": rate, "settings": {"crf": crf}}

    rows = [row(80, 0), row(60, 5), row(70, 5), row(90, 0), row(20, 40), row(1, -9, 33.0)]
    assert fronts(rows) == [True, True, False, False, True, True]


@pytest.mark.parametrize("kind", ["splats", "ngp"])
@pytest.mark.parametrize("quick", [True, False])
def test_every_rung_is_measured_once_and_the_full_one_first(kind, quick):
    rungs = rungs_for(kind, quick=quick)
    assert len(set(rungs)) == len({rung.name for rung in rungs}) == len(rungs)
    assert rungs[0].quality == Quality(scale=0.5 if (kind, quick) == ("ngp", True) else 1.0)
    with pytest.raises(InvalidInput, match="'mesh' has no ladder"):
        rungs_for("mesh", quick=quick)


@pytest.mark.sample
def test_a_ladder_is_measured_written_drawn_and_read_by_an_agent(tmp_path, monkeypatch):
    rungs = [Rung(effort="fast"), Rung(Quality(0.1), 0, effort="fast")]
    monkeypatch.setattr(run, "rungs_for", lambda _kind, **_: rungs)
    job = EvalLadder(
        drive=SAMPLES / "street/transforms_drive_empty.json",
        out=tmp_path / "ladder.json",
        cells=tmp_path / "cells",
        frames=3,
    )
    console = Console(record=True)
    result = run_ladder(job, console)
    assert "6 rungs to measure, 6 of them left" in console.export_text()
    assert json.loads(job.out.read_text()) == result
    first, low = result["rows"][:3], result["rows"][3:]
    for row in result["rows"]:
        assert row.keys() >= ROW_KEYS
        assert sum(row["sender_stage_ms"].values()) == pytest.approx(row["sender_ms"])
    assert [row["rate_percent"] for row in first] == [0, 0, 0]
    for full, cheap in zip(first, low, strict=True):
        assert cheap["bits_per_frame"] > full["bits_per_frame"]
        assert cheap["sender_stage_ms"]["render"] < full["sender_stage_ms"]["render"]
    assert low[0]["rate_percent"] > 30
    assert [r.rung for r in read_ladder(job.out, "splats", 28)] == rungs
    efforts = [(row["settings"]["detail"], row["tracking"]) for row in result["tracking"]]
    assert efforts == [(d, e) for d in (1.0, 0.1) for e in ("full", "once", "half")]
    planned = read_ladder(job.out, "splats", 28, tracking=True)
    assert {r.rung.quality for r in planned} <= {rung.quality for rung in rungs}
    assert all(r.sender_ms > min(row["sender_ms"] for row in result["rows"]) for r in planned)
    monkeypatch.setattr(run, "measure_rung", lambda *_: pytest.fail("measured again"))
    assert run_ladder(job, Console(quiet=True)) == result


@pytest.fixture(scope="module")
def measured(thumbnail):
    """Two rungs on the thumbnail at CRF 28: all there is, and the render alone."""
    drive, field = read_drive(thumbnail.drive), load_field(thumbnail.field)
    seen = time_renders(field, drive, Quality())
    return {
        references: measure_rung(drive, seen, Rung(references=references, effort="fast"), 28.0)
        for references in (3, 0)
    }


def test_a_rungs_time_is_the_sum_of_its_stages_at_both_ends(measured):
    for row in measured.values():
        assert row["sender_ms"] == pytest.approx(sum(row["sender_stage_ms"].values()))
        assert row["receiver_ms"] == pytest.approx(sum(row["receiver_stage_ms"].values()))
        assert list(row["sender_stage_ms"]) == [
            "convert",
            "render",
            "references",
            "encode",
            "closed_loop",
        ]
        assert list(row["receiver_stage_ms"]) == ["render", "references", "splice", "decode"]
        assert row["sender_stage_ms"]["render"] == row["receiver_stage_ms"]["render"]


def test_references_are_counted_over_all_frames_but_the_first(measured):
    assert measured[0]["references_used"] == {"render": 4}
    assert sum(measured[3]["references_used"].values()) == 4
    assert set(measured[3]["references_used"]) != {"render"}


def test_bits_of_a_rung_are_those_of_whole_messages_in_the_steady_state(measured, thumbnail):
    """The same as the coder of clips says, which codes in another order."""
    drive, field = read_drive(thumbnail.drive), load_field(thumbnail.field)
    coder = FieldCoder(
        render_clip(field, drive.cameras),
        "ours",
        "test",
        effort="fast",
        references=RENDER_ONLY,
    )
    clip = coder.code(drive.frames, 10, 28.0)
    alone = measured[0]
    assert alone["psnr_db"] == pytest.approx(clip.psnr_db())
    # A rung without photometric search says nothing of light; the coder may.
    assert alone["bits_per_frame"] == pytest.approx(8 * clip.bytes_per_frame(), rel=0.2)


@pytest.mark.parametrize(
    ("change", "named"),
    [({"fields": ()}, "fields"), ({"out": Path("x")}, "out"), ({"frames": 2}, "frames")],
)
def test_a_job_that_cannot_be_done_is_refused_by_name(change, named):
    with pytest.raises(InvalidInput, match=named):
        EvalLadder(**change)
