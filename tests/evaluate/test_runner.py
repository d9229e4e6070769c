"""An experiment keeps finished pieces between runs, and writes and prints its rows at the end."""

import io
import json
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from rfcore.errors import InvalidData, InvalidInput
from rfcore.image import I420
from rfedge.evaluate import Experiment
from rfedge.evaluate.clips import Clip, CodedClip, Drive, DriveName, Runs
from rfedge.evaluate.rivals import x264_lowdelay
from rfedge.evaluate.runner import Run, coded_clip, program_version
from rfedge.jobs import CellStore
from rfedge.report.tables import text_table

KEY = {"scene": "street", "hz": 10, "method": "x264", "point": 23.0}
ROWS = [{"frame": "a", "bytes": 3}, {"frame": "b", "bytes": 4}]
FRAME = I420(np.zeros((48, 64), np.uint8), *[np.zeros((24, 32), np.uint8)] * 2)
CLIP = Clip("street", 10.0, [FRAME] * 3, "digest", None)


class Counting:
    """Codes every clip alike and counts how often it was asked to."""

    name, points, version = "counting", (23.0,), "test"

    def __init__(self):
        self.coded = 0

    def code(self, _frames, _rate_hz, point):
        self.coded += 1
        mse, ssim = np.array([1.5, 2.5, 0.1]), np.array([0.9, 0.8, 1.0])
        notes = {"mode": ("render", "warp", "warp")}
        return CodedClip(point, np.array([100, 20, 30]), mse, ssim, 12.25, notes)


def test_runs_are_coded_apart_and_their_steady_frames_joined(tmp_path):
    class Telling:
        """Bytes of a frame: a hundred times its level, and its number in the clip."""

        name, points, version = "telling", (1.0,), "test"

        def code(self, frames, _rate_hz, point):
            sizes = np.array([100 * int(f.y[0, 0]) + k for k, f in enumerate(frames)])
            return CodedClip(point, sizes, np.ones(len(frames)), np.ones(len(frames)), 1.0)

    frames = [I420(np.full((48, 64), k, np.uint8), FRAME.u, FRAME.v) for k in range(9)]
    drive = Drive(DriveName.parse("a@10=x"), frames, frames)
    made = coded_clip(drive.spread(Runs(2, 3)).clip(), Telling(), 1.0, CellStore(tmp_path))
    assert made.frame_bytes.tolist() == [0, 101, 202, 701, 802]
    whole = coded_clip(drive.clip(), Telling(), 1.0, CellStore(tmp_path))
    assert whole.frame_bytes.tolist() == [101 * k for k in range(9)]


def forbidden():
    raise AssertionError("computed although it was there")


def test_a_clip_is_coded_once_and_read_back_as_it_was(tmp_path):
    coder, store = Counting(), CellStore(tmp_path / "cells")
    first, again = (coded_clip(CLIP, coder, 23.0, store) for _ in range(2))
    assert coder.coded == 1
    for name in ("frame_bytes", "luma_mse", "ssim"):
        np.testing.assert_array_equal(getattr(again, name), getattr(first, name))
    assert (again.point, again.cpu_ms, again.notes) == (first.point, first.cpu_ms, first.notes)


@pytest.mark.parametrize("change", [{"hz": 30}, {"point": 24.0}, {"extra": "x"}])
def test_any_other_key_is_another_cell(tmp_path, change):
    store = CellStore(tmp_path)
    store.rows(KEY, lambda: ROWS)
    assert store.rows(dict(reversed(KEY.items())), forbidden) == ROWS
    assert not store.has({**KEY, **change})


def test_a_clip_of_other_options_is_coded_anew(tmp_path):
    """The same name, clip and point, and one option of the encoder changed."""
    coder = replace(x264_lowdelay("veryfast", "x264"), points=(30.0,))
    changed = replace(coder, options={**coder.options, "tune": "zerolatency,psnr"})
    for each in (coder, changed, coder):
        coded_clip(CLIP, each, 30.0, CellStore(tmp_path))
    assert len(list(tmp_path.iterdir())) == 2


@pytest.fixture
def program(tmp_path):
    """A copy of the shape of the program: what decides about a cell, and what does not."""
    for name in ("rfcore/codec/encoder.py", "rfcore/native/_native.so", "rfedge/offline.py"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"one")
    (tmp_path / "rfedge/evaluate").mkdir()
    (tmp_path / "docs").mkdir()
    return tmp_path


@pytest.mark.parametrize(
    "changed", ["rfcore/codec/encoder.py", "rfcore/native/_native.so", "rfedge/evaluate/new.py"]
)
def test_a_changed_program_is_another_one(program, changed):
    before = program_version.__wrapped__(root=program)
    (program / changed).write_bytes(b"two")
    assert program_version.__wrapped__(root=program) != before


def test_an_experiments_own_code_is_part_of_its_program(program):
    before = program_version.__wrapped__("lab/paper", root=program)
    (program / "lab/paper").mkdir(parents=True)
    (program / "lab/paper/run.py").write_bytes(b"one")
    assert program_version.__wrapped__("lab/paper", root=program) != before


def test_a_program_is_not_its_documents(program):
    before = program_version.__wrapped__(root=program)
    (program / "docs/page.md").write_text("new")
    (program / "rfcore/note.txt").write_text("new")
    assert program_version.__wrapped__(root=program) == before


def test_a_program_whose_modules_changed_places_is_another_one(program):
    before = program_version.__wrapped__(root=program)
    (program / "rfcore/codec/encoder.py").rename(program / "rfcore/codec/decoder.py")
    assert program_version.__wrapped__(root=program) != before


def test_a_cell_that_is_forgotten_is_made_again(tmp_path):
    store = CellStore(tmp_path)
    store.cell(KEY).forget()
    store.rows(KEY, lambda: ROWS)
    store.cell(KEY).forget()
    assert not store.has(KEY)
    with pytest.raises(AssertionError):
        store.rows(KEY, forbidden)
    assert list(tmp_path.iterdir()) == [], "what fails leaves nothing behind"


@pytest.mark.parametrize("damage", ["", "{}", '{"key": {}, "result": []}', '{"key": 3}'])
def test_a_damaged_cell_is_refused_by_name(tmp_path, damage):
    store = CellStore(tmp_path)
    store.rows(KEY, lambda: ROWS)
    path = store.cell(KEY).path
    assert json.loads(path.read_text())["key"] == KEY
    path.write_text(damage)
    with pytest.raises(InvalidData, match=path.name):
        store.rows(KEY, forbidden)


def test_rows_are_not_taken_for_a_clip_nor_a_clip_for_rows(tmp_path):
    store, coder = CellStore(tmp_path), Counting()
    coded_clip(CLIP, coder, 23.0, store)
    (path,) = tmp_path.iterdir()
    key = json.loads(path.read_text())["key"]
    with pytest.raises(InvalidData, match="no rows"):
        store.rows(key, forbidden)
    store.cell(key).keep(ROWS)
    with pytest.raises(InvalidData):
        coded_clip(CLIP, coder, 23.0, store)


def test_a_clip_has_one_value_per_frame():
    with pytest.raises(InvalidInput, match="one value per frame"):
        CodedClip(1.0, np.array([1, 2]), np.array([1.0]), np.ones(2), 0.0)


def test_a_run_writes_its_result_and_prints_the_tables_of_it(tmp_path):
    job = Experiment(out=tmp_path / "made" / "x.json", cells=tmp_path / "cells", quick=True)
    said = io.StringIO()
    run = Run.begin("test", job, [], Console(file=said, width=80))
    run.tell("[bold]half done")
    parts = [text_table(("what", "ms"), [("render", "20"), ("code", "7")]), "words of the page"]
    result = run.finish({"rows": [1, 2]}, lambda _: parts)
    assert json.loads(job.out.read_text()) == result
    assert (result["kind"], result["quick"], result["rows"]) == ("test", True, [1, 2])
    assert said.getvalue().startswith("[bold]half done\n")
    assert "render" in said.getvalue()
    assert said.getvalue().endswith(f"\nwritten to {job.out}\n")
