"""What an evaluation keeps between runs."""

import json

import numpy as np
import pytest

from rfcore.errors import InvalidData, InvalidInput
from rfedge.experiments.cells import CellStore
from rfedge.experiments.clips import CodedClip

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
