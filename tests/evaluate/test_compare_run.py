"""The verb ``rfedge eval compare``, from files to a result file."""

import contextlib
import io
import json
import math
import pickle
import re
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from rich.console import Console

from rfcore.errors import InvalidInput
from rfcore.field import load_field
from rfedge.evaluate import runner
from rfedge.evaluate.clips import DriveName, read_drive
from rfedge.evaluate.compare import EvalCompare, measure, run
from rfedge.evaluate.compare.drives import (
    asked_families,
    jobs_of_drives,
    read_drive_comparisons,
)
from rfedge.evaluate.compare.measure import BEST, BEST_OF_ANY_CPU
from rfedge.evaluate.compare.rows import compare_parts
from rfedge.evaluate.compare.run import run_compare
from rfedge.evaluate.own_coder import own_coder
from rfedge.jobs import run_jobs

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


def test_a_drive_is_named_with_its_rate():
    name = DriveName.parse("street-empty@29.97=a/b=c.json")
    assert name == DriveName("street-empty", 29.97, Path("a/b=c.json"))


@pytest.mark.parametrize("text", ["drive.json", "a@=x", "a@0=x", "@10=x", "a@ten=x"])
def test_another_form_is_refused_by_an_example(text):
    with pytest.raises(InvalidInput, match="NAME@HZ=DATASET"):
        DriveName.parse(text)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("json", "is not MODULE:CLASS"),
        ("json:", "is not MODULE:CLASS"),
        ("nowhere:X", r"neither .*nowhere\.py nor an installed module 'nowhere'"),
        ("json.nowhere:X", r"neither .*json/nowhere\.py nor an installed module"),
        ("json:Nothing", r"json \(.*\) has no 'Nothing'"),
        ("json:JSONDecoder", "lacks name, points, version, code of a ClipCoder"),
        ("json:load", "cannot be called without arguments"),
        (".relative:X", "is not MODULE:CLASS"),
    ],
)
def test_a_method_that_is_none_is_refused_with_what_was_looked_for(text, why):
    with pytest.raises(InvalidInput, match=f"method: .*{why}"):
        own_coder(text)


MJPEG = """
class MotionJpeg:
    name, points, version = "mjpeg", (2.0, 8.0), "1"

    def code(self, frames, rate_hz, point):
        raise NotImplementedError
"""


@pytest.fixture
def working_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    for name in ("mjpeg_rival_here", "rivals_here", "rivals_here.mjpeg", "broken_rival"):
        sys.modules.pop(name, None)


def test_a_method_is_found_in_the_working_folder(working_folder):
    (working_folder / "mjpeg_rival_here.py").write_text(MJPEG)
    before = list(sys.path)
    assert own_coder("mjpeg_rival_here:MotionJpeg").name == "mjpeg"
    assert sys.path == before


def test_a_method_is_found_in_a_package_of_the_working_folder(working_folder):
    (working_folder / "rivals_here").mkdir()
    (working_folder / "rivals_here/mjpeg.py").write_text(MJPEG)
    assert own_coder("rivals_here.mjpeg:MotionJpeg").points == (2.0, 8.0)


def test_a_module_that_lacks_something_itself_is_told_from_one_that_is_not_there(working_folder):
    (working_folder / "broken_rival.py").write_text("import not_installed_here")
    with pytest.raises(InvalidInput, match="broken_rival needs 'not_installed_here'"):
        own_coder("broken_rival:X")


@pytest.mark.parametrize("window", [(35.0, 32.0), (32.0, 32.0), (0.0, 30.0), (30.0, math.inf)])
def test_a_window_that_does_not_rise_is_refused(window):
    with pytest.raises(InvalidInput, match="window"):
        EvalCompare(field=Path("f.rff"), drives=("a@1=b",), window=window)


X264_HERE = """
import rfedge.evaluate.rivals as rivals

class Mine:
    name, version = "mine", "1"

    def __init__(self):
        self.points = rivals.X264_CRFS

    def code(self, frames, rate_hz, point):
        return rivals.x264_with_our_tools("ultrafast").code(frames, rate_hz, point)
"""


def test_a_codec_of_ones_own_is_a_method_against_x264_and_its_file_an_input(
    thumbnail, tmp_path, working_folder
):
    (working_folder / "mjpeg_rival_here.py").write_text(X264_HERE)
    anchor = "x264-our-tools-ultrafast"
    job = job_of(
        thumbnail,
        tmp_path,
        method=("mjpeg_rival_here:Mine",),
        rivals=(anchor,),
        window=(33.0, 36.0),
    )
    result = run_compare(job, Console(quiet=True))
    own = {row["rival"]: row for row in result["rows"] if row["method"] == "mine"}
    assert abs(own[anchor]["bd_rate_percent"]) < 1, "x264 at other points, against itself"
    assert own.keys() == {anchor, "x264-lowdelay-psnr", BEST, BEST_OF_ANY_CPU} & own.keys()
    *_, told = compare_parts(result)
    assert told.startswith("wall, 10 Hz: mine takes")
    files = {str(thumbnail.field), thumbnail.drive.partition("=")[2], "mjpeg_rival_here.py"}
    assert result["inputs"].keys() == files


def job_of(thumbnail, folder, **change):
    given = {
        "field": thumbnail.field,
        "drives": (thumbnail.drive,),
        "effort": "fast",
        "preset": "ultrafast",
        "out": folder / "compare.json",
        "cells": folder / "cells",
        "quick": True,
    }
    return EvalCompare(**given | change)


@pytest.fixture(scope="module", autouse=True)
def few_draws():
    """Intervals of forty draws: there are many rows, and what is drawn has tests of its own."""
    with pytest.MonkeyPatch.context() as patched:
        few = partial(measure.bd_rate_interval, repetitions=40)
        patched.setattr(measure, "bd_rate_interval", few)
        yield


@pytest.fixture(scope="module")
def compared(thumbnail, tmp_path_factory):
    """A comparison over a window that our own points do not reach down to, with a background."""
    folder = tmp_path_factory.mktemp("compared")
    job = job_of(
        thumbnail,
        folder,
        quick=False,
        rivals=("x264-lowdelay",),
        window=(33.0, 36.0),
        background=(thumbnail.empty,),
    )
    return job, run_compare(job, Console(quiet=True))


@pytest.fixture(scope="module")
def compared_quickly(thumbnail, tmp_path_factory):
    """A quick comparison, what it printed, and its progress."""
    job = job_of(thumbnail, tmp_path_factory.mktemp("quick"), window=(33.0, 36.0))
    console = Console(record=True, file=io.StringIO(), width=80)
    with pytest.MonkeyPatch.context() as patched, contextlib.redirect_stderr(io.StringIO()) as told:
        patched.setattr(run, "TOLD_EVERY_S", 0.0)
        patched.setattr(run, "TOLD_SHARE", 0.0)
        result = run_compare(job, console)
    return job, result, console.export_text(), told.getvalue()


def test_every_curve_spans_the_window_that_was_asked_for(compared):
    _, result = compared
    for curve in result["curves"]:
        assert curve["psnr_db"][0] <= 33 <= 36 <= curve["psnr_db"][-1]
        assert curve["psnr_db"] == sorted(curve["psnr_db"])
        assert len(curve["point"]) == len(curve["bytes_per_frame"]) == len(curve["ssim"])
    assert {tuple(row["window_db"]) for row in result["rows"]} == {(33.0, 36.0)}


def test_a_quick_comparison_has_no_interval_and_names_each_method_once(compared_quickly):
    _, result, _, _ = compared_quickly
    for row in result["rows"]:
        assert set(row) >= ROW_KEYS
        assert row["ci95"] is None
    assert {row["method"].rsplit("-", 1)[0] for row in result["rows"]} == {
        "rfedge-fast",
        "rfedge-without-field-fast",
    }


def test_a_quick_comparison_says_so_in_each_table_and_has_a_line_for_a_rival(compared_quickly):
    _, result, printed, _ = compared_quickly
    parts = list(compare_parts(result))
    assert printed.count("QUICK") == len(parts)
    for setting in {row["rival_setting"] for row in result["rows"]}:
        lines = re.findall(rf"^{setting}[ *]+[-+]\d", printed, re.MULTILINE)
        assert len(lines) == 1


def test_what_a_fields_own_bytes_leave_names_the_rival_and_the_quality(compared_quickly):
    _, result, _, _ = compared_quickly
    (table,) = (part for part in compare_parts(result) if "own bytes" in str(part))
    (row, *_) = result["break_even"]
    cells = {column.text(table.rows[0]) for column in table.columns}
    assert cells >= {row["rival"], f"{row['at_db']:g}"}


def test_a_comparison_ends_with_what_each_drive_saved_in_words(compared_quickly):
    _, result, printed, _ = compared_quickly
    last = " ".join(printed.split())
    for row in result["rows"]:
        if row["rival"] == "x264-our-tools" and row["method"].startswith("rfedge-fast"):
            direction = "fewer" if row["bd_rate_percent"] < 0 else "more"
            percent = abs(row["bd_rate_percent"])
            said = f"{percent:.0f} % {direction} bits than {row['rival_setting']}"
            assert said in last[last.rindex("QUICK") :]


def test_a_quick_comparison_says_how_many_clips_it_codes_and_how_many_are_done(compared_quickly):
    _, _, printed, told = compared_quickly
    count = int(re.search(r"(\d+) clips to code", printed)[1])
    assert count <= 16
    assert re.findall(r"(\d+) of (\d+) clips, about \d+ s left", told) == [
        (str(done), str(count)) for done in range(1, count + 1)
    ]


def test_a_quick_comparison_is_near_a_whole_one(compared_quickly, tmp_path):
    quick, result, _, _ = compared_quickly
    anchor = "x264-our-tools-ultrafast"
    whole = replace(quick, quick=False, rivals=(anchor,), out=tmp_path / "whole.json")
    found = [
        {
            row["method"]: row["bd_rate_percent"]
            for row in rows["rows"]
            if row["rival"] == anchor and tuple(row["window_db"]) == (33.0, 36.0)
        }
        for rows in (result, run_compare(whole, Console(quiet=True)))
    ]
    for method, percent in found[0].items():
        assert percent == pytest.approx(found[1][method], abs=3)


def test_a_background_is_refused_for_a_quick_comparison(thumbnail, tmp_path):
    with pytest.raises(InvalidInput, match="background"):
        job_of(thumbnail, tmp_path, background=(thumbnail.empty,))


def test_a_whole_comparison_has_its_interval_around_its_figure(compared):
    _, result = compared
    for row in result["rows"]:
        low, high = row["ci95"]
        assert low <= row["bd_rate_percent"] <= high


def test_shares_of_area_and_bits_are_whole(compared):
    _, result = compared
    assert sum(row["area_percent"] for row in result["bits"]) == pytest.approx(100)
    assert sum(row["slice_percent"] for row in result["bits"]) == pytest.approx(100)
    moving = next(row for row in result["bits"] if row["shows"] == "moving")
    assert moving["slice_percent"] > moving["area_percent"], "the box is not in the field"


def test_a_finished_comparison_is_not_coded_again(compared):
    job, result = compared
    cells = {path: path.read_bytes() for path in job.cells.iterdir()}
    again = run_compare(job, Console(quiet=True))
    assert again["rows"] == result["rows"]
    assert {path: path.read_bytes() for path in job.cells.iterdir()} == cells
    assert json.loads(job.out.read_text())["curves"] == result["curves"]


def test_jobs_leave_all_cells_that_a_comparison_looks_for(
    compared, thumbnail, tmp_path, monkeypatch
):
    here, result = compared
    addresses, cells = [], {}

    def on_workers(jobs, tell, address, _processes):
        addresses.append(address)
        done = run_jobs(pickle.loads(pickle.dumps(jobs)), tell)
        cells.update({path.name: path.read_bytes() for path in job.cells.iterdir()})
        return done

    monkeypatch.setattr(runner, "run_jobs", on_workers)
    same = {"window": here.window, "background": here.background, "rivals": here.rivals}
    same["quick"] = False
    job = job_of(thumbnail, tmp_path, ray="10.0.0.1:6379", **same)
    again = run_compare(job, Console(quiet=True))
    assert addresses == ["10.0.0.1:6379"]
    assert len(cells) >= 50
    after = {path.name: path.read_bytes() for path in job.cells.iterdir()}
    assert {name: after[name] for name in cells} == cells
    assert len(after) == len(cells) + 2, "processor times, and whose bits they are"
    assert [row["bytes_per_frame"] for row in again["curves"]] == [
        row["bytes_per_frame"] for row in result["curves"]
    ]


@pytest.mark.slow
def test_processes_give_the_rows_that_one_gives(thumbnail, tmp_path):
    only = {"rivals": ("x264-lowdelay",), "window": (33.0, 36.0)}
    alone = job_of(thumbnail, tmp_path, **only)
    shared = replace(alone, cells=tmp_path / "shared", processes=2)
    one, two = (run_compare(job, Console(quiet=True)) for job in (alone, shared))
    assert [row["bytes_per_frame"] for row in two["curves"]] == [
        row["bytes_per_frame"] for row in one["curves"]
    ]


def test_processes_that_cannot_be_are_refused(thumbnail, tmp_path):
    with pytest.raises(InvalidInput, match="processes: 0 is outside"):
        job_of(thumbnail, tmp_path, processes=0)


def test_each_drive_of_a_comparison_keeps_its_background():
    job = EvalCompare(
        field=Path("wall.rff"),
        drives=("a@10=a.json", "b@5=b.json,own.rff"),
        decimated=("c@30=c.json",),
        background=("b@5=nothing.json",),
    )
    apart = [(one.drives, one.decimated, one.background) for one in jobs_of_drives(job)]
    assert apart == [
        (("a@10=a.json",), (), ()),
        (("b@5=b.json,own.rff",), (), ("b@5=nothing.json",)),
        ((), ("c@30=c.json",), ()),
    ]


def test_a_window_that_the_field_beats_is_refused_and_the_one_named_works(thumbnail, tmp_path):
    job = job_of(thumbnail, tmp_path, window=(15.0, 18.0), rivals=("x264-lowdelay",))
    with pytest.raises(
        InvalidInput, match=r"15\.\.18 dB is not within .*rfedge-fast.* reaches"
    ) as caught:
        run_compare(job, Console(quiet=True))
    assert not job.out.exists()
    low, high = map(float, str(caught.value).partition(" --window ")[2].split()[:2])
    result = run_compare(replace(job, window=(low, high)), Console(quiet=True))
    assert {tuple(row["window_db"]) for row in result["rows"]} == {(low, high)}


def test_a_background_without_its_drive_is_refused(thumbnail, tmp_path):
    elsewhere = thumbnail.empty.replace("wall@10", "alley@10")
    with pytest.raises(InvalidInput, match="alley"):
        run_compare(
            job_of(thumbnail, tmp_path, quick=False, background=(elsewhere,)), Console(quiet=True)
        )


def test_a_decimated_drive_is_every_fifth_frame_at_a_fifth_of_the_rate(tmp_path):
    job = EvalCompare(
        field=SAMPLES / "fields" / "street.rff",
        decimated=(f"empty@10={SAMPLES / 'street' / 'transforms_drive_empty.json'}",),
        effort="fast",
        preset="veryfast",
        out=tmp_path / "compare.json",
        cells=tmp_path / "cells",
    )
    (comparison,) = read_drive_comparisons(job)
    assert comparison.clip.rate_hz == 2.0
    whole = read_drive(job.decimated[0])
    assert [f.digest() for f in comparison.clip.frames] == [f.digest() for f in whole.frames[::5]]
    assert [c.world_from_cam for c in comparison.rendered.cameras] == [
        c.world_from_cam.rounded() for c in whole.cameras[::5]
    ]


@pytest.mark.sample
def test_a_drive_may_name_a_field_of_its_own(thumbnail, tmp_path):
    """The street's field at the wall's poses; the wall's is the command's."""
    own = SAMPLES / "fields" / "street.rff"
    drives = (thumbnail.drive, f"{thumbnail.drive.replace('wall', 'other')},{own}")
    walls, other = read_drive_comparisons(job_of(thumbnail, tmp_path, drives=drives))
    assert walls.rendered.field_id == load_field(thumbnail.field).field_id
    assert other.rendered.field_id == load_field(own).field_id
    assert other.field_bytes == own.stat().st_size


def test_a_comparison_of_nothing_is_refused():
    with pytest.raises(InvalidInput, match="there is none"):
        EvalCompare(field=Path("field.rff"))


def test_rivals_that_are_asked_for_stand_alone_with_the_one_a_field_is_paid_for_against(
    thumbnail, tmp_path
):
    job = job_of(thumbnail, tmp_path, window=(33.0, 36.0), rivals=("x264-our-tools-ultrafast",))
    result = run_compare(job, Console(quiet=True))
    assert {row["rival"] for row in result["rows"]} - {BEST, BEST_OF_ANY_CPU} == {
        "x264-our-tools-ultrafast",
        "x264-lowdelay-psnr",
    }
    assert {row["rival"] for row in result["break_even"]} == {"x264-lowdelay-psnr-ultrafast"}
    assert result["ssim"] == []


def test_a_rival_is_named_by_its_family_or_as_tables_print_it():
    asked = asked_families(
        EvalCompare(
            field=Path("f.rff"),
            drives=("a@1=b",),
            rivals=("svtav1-lowdelay-p4", "x265-medium"),
        )
    )
    assert {family: [coder.name for coder in those] for family, those in asked.items()} == {
        "x264-lowdelay-psnr": ["x264-lowdelay-psnr-veryfast"],
        "x265-medium": ["x265-lowdelay-psnr-medium"],
        "svtav1-lowdelay": ["svtav1-lowdelay-p4"],
    }


def test_a_rival_that_nobody_knows_is_refused_with_those_there_are(thumbnail, tmp_path):
    job = job_of(thumbnail, tmp_path, rivals=("h264",))
    with pytest.raises(InvalidInput, match="rivals: 'h264' is none of x264-lowdelay, x264-lowd"):
        run_compare(job, Console(quiet=True))
