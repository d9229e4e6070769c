"""What an evaluation keeps between runs."""

import json
from dataclasses import replace

import numpy as np
import pytest

from rfcore.errors import InvalidData, InvalidInput
from rfcore.image import I420
from rfedge.evaluate.cells import CellStore, clip_key, program_version
from rfedge.evaluate.clips import Clip, CodedClip
from rfedge.evaluate.rivals import x264_lowdelay

KEY = {"scene": "street", "hz": 10, "method": "x264", "point": 23.0}
CLIP = CodedClip(
    23.0,
    np.array([100, 20, 30]),
    np.array([1.5, 2.5, 0.1]),
    np.array([0.9, 0.8, 1.0]),
    12.25,
    {"mode": ("render", "warp", "warp")},
)


def forbidden():
    raise AssertionError("computed although it was there")


def test_a_cell_is_computed_once_and_read_back_as_it_was(tmp_path):
    store = CellStore(tmp_path / "cells")
    first = store.clip(KEY, lambda: CLIP)
    again = store.clip(dict(reversed(KEY.items())), forbidden)
    assert first is CLIP
    for name in ("frame_bytes", "luma_mse", "ssim"):
        np.testing.assert_array_equal(getattr(again, name), getattr(CLIP, name))
    assert (again.point, again.cpu_ms, again.notes) == (CLIP.point, CLIP.cpu_ms, CLIP.notes)


@pytest.mark.parametrize("change", [{"hz": 30}, {"point": 24.0}, {"extra": "x"}])
def test_any_other_key_is_another_cell(tmp_path, change):
    store = CellStore(tmp_path)
    store.clip(KEY, lambda: CLIP)
    assert not store.has({**KEY, **change})


def test_a_cell_of_other_options_is_not_taken(tmp_path):
    """The same name, clip and point, and one option of the encoder changed: coded anew."""
    frame = I420(np.zeros((48, 64), np.uint8), *[np.zeros((24, 32), np.uint8)] * 2)
    clip = Clip("street", 10.0, [frame] * 2, "digest", None)
    coder = replace(x264_lowdelay("veryfast", "x264"), points=(30.0,))
    changed = replace(coder, options={**coder.options, "tune": "zerolatency,psnr"})
    store, made = CellStore(tmp_path), []
    for each in (coder, changed, coder):
        store.clip(clip_key(clip, each, 30.0), lambda: made.append(1) or CLIP)
    assert len(made) == 2
    assert store.has(clip_key(clip, changed, 30.0))


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
    before = program_version.__wrapped__(program)
    (program / changed).write_bytes(b"two")
    assert program_version.__wrapped__(program) != before


def test_a_program_is_not_its_documents(program):
    before = program_version.__wrapped__(program)
    (program / "docs/page.md").write_text("new")
    (program / "rfcore/note.txt").write_text("new")
    assert program_version.__wrapped__(program) == before


def test_a_program_whose_modules_changed_places_is_another_one(program):
    before = program_version.__wrapped__(program)
    (program / "rfcore/codec/encoder.py").rename(program / "rfcore/codec/decoder.py")
    assert program_version.__wrapped__(program) != before


def test_a_cell_that_is_forgotten_is_made_again(tmp_path):
    store = CellStore(tmp_path)
    store.forget(KEY)
    store.clip(KEY, lambda: CLIP)
    store.forget(KEY)
    assert not store.has(KEY)
    with pytest.raises(AssertionError):
        store.clip(KEY, forbidden)


def test_a_computation_that_fails_leaves_nothing_behind(tmp_path):
    store = CellStore(tmp_path)
    with pytest.raises(AssertionError):
        store.clip(KEY, forbidden)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("damage", ["", "{}", '{"key": {}, "result": {}}'])
def test_a_damaged_cell_is_refused_by_name(tmp_path, damage):
    store = CellStore(tmp_path)
    store.clip(KEY, lambda: CLIP)
    store.path(KEY).write_text(damage)
    with pytest.raises(InvalidData, match=store.path(KEY).name):
        store.clip(KEY, forbidden)


def test_a_cell_says_what_it_is(tmp_path):
    store = CellStore(tmp_path)
    store.clip(KEY, lambda: CLIP)
    assert json.loads(store.path(KEY).read_text())["key"] == KEY


def test_a_clip_has_one_value_per_frame():
    with pytest.raises(InvalidInput, match="one value per frame"):
        CodedClip(1.0, np.array([1, 2]), np.array([1.0]), np.ones(2), 0.0)


def test_rows_are_kept_like_clips(tmp_path):
    store, rows = CellStore(tmp_path), [{"frame": "a", "bytes": 3}, {"frame": "b", "bytes": 4}]
    assert store.rows(KEY, lambda: rows) is rows
    assert store.rows(KEY, forbidden) == rows


def test_rows_are_not_taken_for_a_clip_nor_a_clip_for_rows(tmp_path):
    store = CellStore(tmp_path)
    store.rows(KEY, lambda: [{"a": 1}])
    with pytest.raises(InvalidData):
        store.clip(KEY, forbidden)
    other = {**KEY, "hz": 2}
    store.clip(other, lambda: CLIP)
    with pytest.raises(InvalidData, match="no rows"):
        store.rows(other, forbidden)
