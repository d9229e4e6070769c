"""The adaptation table: shares of a loss, cases as text, and a run that goes on from its cells."""

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from lab.adapt import EvalAdapt
from lab.adapt.measure import (
    FIRST,
    AdaptCase,
    AdaptRow,
    drives_to_break_even,
    kbit_at,
    messages_differ,
    most_kbit,
    recovered_percent,
    run_adapt,
    second_vehicle_percent,
    tool_ms,
)
from rfcore.errors import InvalidInput
from rfcore.field import load_field
from rfcore.image import I420
from rfedge.evaluate.clips import CodedClip, read_drive
from rfedge.evaluate.field_coder import FieldCoder, render_clip
from rfedge.evaluate.performance import Performance
from rfedge.samples import sample_path


def test_what_is_recovered_is_a_share_of_the_loss():
    assert recovered_percent(75.0, 25.0, 75.0) == 0.0
    assert recovered_percent(75.0, 25.0, 50.0) == 50.0
    assert recovered_percent(75.0, 25.0, 20.0) == pytest.approx(110.0)
    assert recovered_percent(75.0, 25.0, 80.0) == pytest.approx(-10.0)


def test_without_a_loss_nothing_is_recovered():
    assert recovered_percent(75.0, None, 50.0) is None
    assert recovered_percent(75.0, 25.0, None) is None
    assert recovered_percent(None, 25.0, 20.0) is None
    assert recovered_percent(25.0, 25.0, 20.0) is None


def test_a_loss_of_less_than_a_tenth_is_not_shared_out():
    """Dusk at 36 dB costs 2 % more than noon: what a field wins beside would be 4,000 % of that."""
    assert recovered_percent(27.4, 25.0, 5.0) is None
    assert recovered_percent(27.6, 25.0, 25.0) == pytest.approx(100.0)


def test_a_second_vehicle_pays_for_what_is_new_as_the_first_one_or_not_at_all():
    assert second_vehicle_percent(60.0, 20.0, 60.0) == 100.0
    assert second_vehicle_percent(60.0, 20.0, 40.0) == 50.0
    assert second_vehicle_percent(60.0, 20.0, 20.0) == 0.0
    assert second_vehicle_percent(60.0, None, 20.0) is None
    assert second_vehicle_percent(60.0, 20.0, None) is None


def coded_at(*points: tuple[float, int]) -> Performance:
    """Two frames at so many luma decibels and bytes a frame."""
    clips = tuple(
        CodedClip(
            float(point),
            np.array([9999, size]),
            np.full(2, 255.0**2 / 10 ** (db / 10)),
            np.full(2, 0.9),
            cpu_ms=2.0,
        )
        for point, (db, size) in enumerate(points)
    )
    return Performance("ours", clips, 1.0)


def test_bits_at_a_quality_are_those_of_the_curve_and_none_are_made_up_outside_it():
    done = coded_at(*((40.0 - 2 * n, 1000 - 100 * n) for n in range(6)))
    assert kbit_at(36.0, done) == pytest.approx(8 * 0.8)
    assert kbit_at(30.0, done) == pytest.approx(8 * 0.5)
    assert kbit_at(29.9, done) is None
    assert kbit_at(40.1, done) is None


def test_the_first_frame_has_a_curve_of_its_own():
    done = coded_at(*((40.0 - 2 * n, 1000 - 100 * n) for n in range(6)))
    for clip in done.clips:
        clip.frame_bytes[0] = 5 * clip.frame_bytes[1]
    assert kbit_at(36.0, done, FIRST) == pytest.approx(5 * 8 * 0.8)
    assert kbit_at(40.1, done, FIRST) is None


def test_above_33_db_the_fewest_bits_are_an_upper_bound():
    good = coded_at(*((44.0 - 2 * n, 1000 - 100 * n) for n in range(6)))
    assert kbit_at(33.0, good) is None
    assert most_kbit(good) == pytest.approx(8 * 0.5)
    assert most_kbit(coded_at(*((40.0 - 2 * n, 1000 - 100 * n) for n in range(6)))) is None


def test_a_field_is_paid_for_after_so_many_drives_or_never():
    assert drives_to_break_even(100_000, 50.0, 10.0, 20) == pytest.approx(1.0)
    assert drives_to_break_even(100_000, 10.0, 10.0, 20) is None
    assert drives_to_break_even(0, 50.0, 10.0, 20) is None
    assert drives_to_break_even(100_000, None, 10.0, 20) is None


def test_messages_are_compared_one_by_one():
    def sent(*messages: tuple[str, str]) -> Performance:
        clips = tuple(
            replace(clip, notes={"message": named})
            for clip, named in zip(coded_at((40, 9), (30, 8)).clips, messages, strict=True)
        )
        return Performance("ours", clips, 1.0)

    off = sent(("a", "b"), ("c", "d"))
    assert messages_differ(off, off) == 0
    assert messages_differ(off, sent(("a", "x"), ("d", "c"))) == 3


def test_a_tools_time_is_its_own(flat_frames):
    spent = tool_ms(flat_frames, flat_frames)
    assert spent["off"] == 0
    assert spent["auto"] > 0
    assert spent["matrix"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["empty", "vehicles"])
def test_in_the_fields_own_light_no_message_differs_from_off(name):
    """Vehicles, which the field has not seen, move block means by up to 2.5 levels."""
    drive = read_drive(f"noon@10={sample_path(f'street/transforms_drive_{name}.json')}")
    rendered = render_clip(load_field(sample_path("fields/street.rff")), drive.cameras)
    auto, off = (
        FieldCoder(rendered, "ours", "now", effort="fast", photometric=light, relight=relit)
        for light, relit in ((None, None), ((), False))
    )
    for crf in (20.0, 30.0):
        messages = [coder.code(drive.frames, 10.0, crf).notes["message"] for coder in (auto, off)]
        assert messages[0] == messages[1]


@pytest.fixture
def flat_frames() -> list[I420]:
    planes = (np.full((64, 96), 90, np.uint8), *np.full((2, 32, 48), 128, np.uint8))
    return [I420(*planes)] * 3


def test_a_case_names_its_drive_fields_and_variants():
    case = AdaptCase.parse("dusk@10=d.json,field=f.rff,noon=n.json,learnt=g.rff,layer=l.rff")
    assert (case.drive.scene, case.drive.rate_hz, case.drive.dataset) == (
        "dusk",
        10,
        Path("d.json"),
    )
    assert (case.own, case.noon) == (Path("f.rff"), Path("n.json"))
    assert case.variants == {"learnt": Path("g.rff"), "layer": Path("l.rff")}
    assert AdaptCase.parse("a@5=d,field=f").noon is None
    taught = AdaptCase.parse("a@5=d,field=f,learnt:3=g.rff,layer=l.rff")
    fleet = AdaptCase.parse("a@5=d,field=f,learnt:3/2=g.rff")
    assert (fleet.passes, fleet.identities) == ({"learnt": 3}, {"learnt": 2})
    assert taught.passes == {"learnt": 3}
    assert list(taught.variants) == ["learnt", "layer"]
    assert AdaptCase.parse("a@5=d,field=f,empty=e.json").empty == Path("e.json")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("dusk@10=d.json", "names no field="),
        ("dusk=d.json,field=f.rff", "is not NAME@HZ=DATASET"),
        ("dusk@10=d.json,field", "'field' is not KEY=PATH"),
        ("dusk@10=d.json,field=f,noon=", "'noon=' is not KEY=PATH"),
        ("dusk@10=d.json,field=f,field=g", "'field=g' is not KEY=PATH"),
        ("dusk@10=d.json,field=f,off=g", "'off=g' is not KEY=PATH"),
        ("dusk@10=d.json,field=f,learnt:0=g", "'learnt:0=g' is not KEY=PATH"),
        ("dusk@10=d.json,field=f,learnt:2/3=g", "passes of more vehicles than passes"),
        ("dusk@10=d.json,field=f,noon:2=g", "'noon' is not learnt from passes"),
    ],
)
def test_a_case_of_another_form_is_refused(text, said):
    with pytest.raises(InvalidInput, match=said):
        AdaptCase.parse(text)


def test_a_job_without_cases_is_refused():
    with pytest.raises(InvalidInput, match="cases"):
        EvalAdapt(cases=())


def job_of(text: str, folder: Path) -> EvalAdapt:
    return EvalAdapt(
        cases=(text,),
        effort="fast",
        preset="ultrafast",
        out=folder / "a.json",
        cells=folder / "cells",
        quick=True,
    )


def test_a_run_has_a_row_for_every_variant_and_goes_on_from_its_cells(
    thumbnail, tmp_path, monkeypatch
):
    """Another name for the same field changes no bit; at noon a tool that is not used neither."""
    monkeypatch.setattr("lab.adapt.measure.AT_DB", 34.0)  # which this field alone does not reach
    text = f"{thumbnail.drive},field={thumbnail.field},again:2/1={thumbnail.field}"
    text += f",noon={thumbnail.drive.partition('=')[2]}"
    job = job_of(text, tmp_path)
    result = run_adapt(job, Console(file=io.StringIO(), width=200))
    rows = {row["variant"]: row for row in result["rows"]}
    assert list(rows) == ["off", "matrix", "auto", "again"]
    assert rows["again"]["kbit_33db"] == rows["off"]["kbit_33db"]
    assert rows["again"]["side_bytes"] == thumbnail.field.stat().st_size
    assert rows["again"]["noon_bits_percent"] is None
    assert rows["off"]["side_bytes"] == rows["off"]["extra_ms"] == 0
    assert rows["auto"]["extra_ms"] > 0
    assert rows["again"]["extra_ms"] is None
    assert "passes" not in rows["off"]
    assert (rows["again"]["passes"], rows["again"]["identities"]) == (2, 1)
    assert "drives_to_break_even" not in rows["again"], "it saves nothing"
    assert rows["auto"]["messages_differ"] == rows["auto"]["noon_messages_differ"] == 0
    assert "messages_differ" not in rows["again"]
    assert rows["auto"]["relit_frames"] == rows["auto"]["switches"] == 0
    assert rows["off"]["kbit_36db"] > rows["off"]["kbit_33db"]
    assert rows["off"]["recovered_percent"] is None, "noon itself has nothing to win back"
    assert rows["off"]["kbit_33db"] > 0
    assert rows["off"]["lowest_psnr_db"] < 34
    assert rows["off"]["noon_bits_percent"] == 0.0
    assert rows["matrix"]["noon_bits_percent"] == rows["auto"]["noon_bits_percent"] == 0.0
    assert json.loads(job.out.read_text())["rows"] == result["rows"]
    cells = {path: path.read_bytes() for path in job.cells.iterdir()}
    assert run_adapt(job, Console(quiet=True))["rows"] == result["rows"]
    assert {path: path.read_bytes() for path in job.cells.iterdir()} == cells


def test_where_a_field_shows_33_db_before_a_bit_is_sent_no_bits_are_stated(thumbnail, tmp_path):
    text = f"{thumbnail.empty},field={thumbnail.field},again={thumbnail.field}"
    text += f",empty={thumbnail.empty.partition('=')[2]}"
    job = job_of(text, tmp_path)
    said = io.StringIO()
    off, _, _, again = run_adapt(job, Console(file=said, width=200))["rows"]
    assert off["kbit_33db"] is None
    assert off["lowest_psnr_db"] > 33
    assert off["kbit_33db_at_most"] > 0
    assert off["x264_kbit_33db"] > 0
    assert again["recovered_percent"] is again["second_vehicle_percent"] is None
    assert f"at most {off['kbit_33db_at_most']:.1f} kbit a frame: not at 33 dB" in said.getvalue()
    assert f"from {off['lowest_psnr_db']:.1f} dB on" in said.getvalue()


ROW = AdaptRow(
    case="dusk",
    drive="transforms_drive_dusk@10",
    frames=24,
    variant="matrix",
    kbit_33db=71.7,
    lowest_psnr_db=25.31,
    x264_kbit_33db=100.0,
    recovered_percent=None,
    noon_bits_percent=0.0,
    second_vehicle_percent=None,
    side_bytes=0,
    extra_ms=1.26,
)


def test_bits_are_told_as_a_bound_where_a_field_shows_more_before_a_bit_is_sent():
    assert ROW.kbit_text == "71.7 (-28.3 %)"
    assert replace(ROW, kbit_33db=None).kbit_text is None
    assert replace(ROW, kbit_33db=None, kbit_33db_at_most=20.0).kbit_text == "≤ 20.0 (-80.0 %)"
