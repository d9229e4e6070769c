"""The verb ``rfedge eval compare``, from files to a result file."""

import json
import sys
from pathlib import Path

import pytest
from rich.console import Console

from rfcore.errors import InvalidInput
from rfcore.field import load_field
from rfedge.experiments.clips import DriveName, read_drive
from rfedge.experiments.compare.drives import CompareJob, foreign_coder, read_drive_comparisons
from rfedge.experiments.compare.measure import BEST
from rfedge.experiments.compare.run import run_compare
from rfedge.experiments.rivals import x264_lowdelay

SAMPLES = Path(__file__).parents[2] / "samples"
ROW_KEYS = {
    "scene",
    "hz",
    "method",
    "rival",
    "window_db",
    "bd_rate_percent",
    "ci95",
    "points",
    "first_frame_bytes",
    "cpu_ms",
    "rival_cpu_ms",
    "field_psnr_db",
}


class UsersCodec:
    """What a user brings: a class that is called without arguments."""

    def __new__(cls):
        return x264_lowdelay("superfast", "users-codec")


def test_a_drive_is_named_with_its_rate():
    name = DriveName.parse("street-empty@29.97=a/b=c.json")
    assert name == DriveName("street-empty", 29.97, Path("a/b=c.json"))


@pytest.mark.parametrize("text", ["drive.json", "a@=x", "a@0=x", "@10=x", "a@ten=x"])
def test_another_form_is_refused_by_an_example(text):
    with pytest.raises(InvalidInput, match="NAME@HZ=DATASET"):
        DriveName.parse(text)


@pytest.mark.parametrize("text", ["nowhere:X", "json:Nothing", "json", "json:JSONDecoder"])
def test_a_method_that_is_none_is_refused(text):
    with pytest.raises(InvalidInput, match="method"):
        foreign_coder(text)


def test_a_decimated_drive_is_every_fifth_frame_at_a_fifth_of_the_rate(tmp_path):
    job = CompareJob(
        field=SAMPLES / "fields" / "street.rff",
        drives=(),
        decimated=(f"empty@10={SAMPLES / 'street' / 'transforms_drive_empty.json'}",),
        preset="veryfast",
        out=tmp_path / "compare.json",
        cells=tmp_path / "cells",
    )
    field = load_field(job.field)
    (comparison,) = read_drive_comparisons(job, field)
    assert comparison.clip.rate_hz == 2.0
    whole = read_drive(job.decimated[0])
    assert [f.digest() for f in comparison.clip.frames] == [f.digest() for f in whole.frames[::5]]
    assert [c.world_from_cam for c in comparison.seen.cameras] == [
        c.world_from_cam.rounded() for c in whole.cameras[::5]
    ]


def test_a_comparison_of_nothing_is_refused(tmp_path):
    with pytest.raises(InvalidInput, match="there is none"):
        CompareJob(Path("field.rff"), (), "veryfast", tmp_path / "compare.json", tmp_path)


@pytest.mark.slow
@pytest.mark.sample
def test_a_quick_comparison_writes_rows_and_goes_on_from_its_cells(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "users_module", sys.modules[__name__])
    job = CompareJob(
        field=SAMPLES / "fields" / "street.rff",
        drives=(f"empty@10={SAMPLES / 'street' / 'transforms_drive_empty.json'}",),
        preset="veryfast",
        out=tmp_path / "compare.json",
        cells=tmp_path / "cells",
        methods=("users_module:UsersCodec",),
        quick=True,
    )
    first = run_compare(job, Console(quiet=True))
    cells = {path: path.read_bytes() for path in job.cells.iterdir()}
    again = run_compare(job, Console(quiet=True))
    assert again["rows"] == first["rows"]
    assert {path: path.read_bytes() for path in job.cells.iterdir()} == cells
    assert json.loads(job.out.read_text())["rows"] == first["rows"]
    assert all(set(row) >= ROW_KEYS for row in first["rows"])
    rivals = {row["rival"] for row in first["rows"]}
    assert {"x264-lowdelay", "svtav1-lowdelay", "users-codec", BEST} <= rivals
    headline = next(r for r in first["rows"] if r["rival"] == "x264-lowdelay")
    assert headline["bd_rate_percent"] < 0
