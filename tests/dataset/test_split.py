"""A recording cut into tiles: every picture is somewhere, borders are shared, readers take each."""

import json
from dataclasses import astuple
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.dataset import read_dataset
from rfcore.errors import DatasetError, InvalidInput
from rfedge.datasets.convert import SplitSettings, read_tiles, split_dataset, tiles_of

FAR_M = (500_000.0, 300.0)
"""Where the recording is in its world, so that readers choose an origin near it."""


def record(folder: Path, places_m: list[float], points: bool = True) -> Path:
    """Write a drive along x at ``FAR_M`` with a picture at each place."""
    folder.mkdir()
    frames = []
    for i, x in enumerate(places_m):
        cv2.imwrite(str(folder / f"{i}.png"), np.full((8, 12, 3), i, np.uint8))
        matrix = np.eye(4)
        matrix[:3, 3] = FAR_M[0] + x, FAR_M[1], 1.5
        frames.append(
            {"file_path": f"{i}.png", "time": i / 10, "transform_matrix": matrix.tolist()}
        )
    content = {"fl_x": 10.0, "fl_y": 10.0, "cx": 6.0, "cy": 4.0, "w": 12, "h": 8, "frames": frames}
    if points:
        content["ply_file_path"] = "points.ply"
        rows = [f"{FAR_M[0] + x} {FAR_M[1]} 0 9 9 9" for x in places_m]
        names = "".join(f"property double {n}\n" for n in "xyz")
        names += "".join(f"property uchar {n}\n" for n in ("red", "green", "blue"))
        head = f"ply\nformat ascii 1.0\nelement vertex {len(rows)}\n{names}end_header\n"
        (folder / "points.ply").write_text(head + "\n".join(rows) + "\n")
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


@given(
    st.lists(st.tuples(st.floats(-200, 200), st.floats(-200, 200)), min_size=1, max_size=60),
    st.floats(20, 300),
    st.floats(0, 1),
)
def test_each_picture_is_in_the_tile_it_is_on_and_in_those_it_is_near(places, length_m, share):
    ground_m = np.array(places)
    overlap_m = share * length_m
    tiles = tiles_of(ground_m, SplitSettings(length_m, overlap_m, fewest=1))
    assert {i for tile in tiles for i in tile.pictures} == set(range(len(places)))
    for tile in tiles:
        low_m, high_m = np.array(tile.area_m[:2]), np.array(tile.area_m[2:])
        assert (high_m - low_m <= length_m * (1 + 1e-6)).all()
        assert (high_m > low_m).all()
        outside_m = np.maximum(np.maximum(low_m - ground_m, ground_m - high_m), 0).max(axis=1)
        assert outside_m[list(tile.pictures)].max() <= overlap_m / 2 + 1e-6
        assert set(np.flatnonzero(outside_m < overlap_m / 2 - 1e-6)) <= set(tile.pictures)


def test_tiles_side_by_side_share_the_overlap_and_name_each_other():
    ground_m = np.column_stack([np.arange(0, 91, 1.0), np.zeros(91)])
    tiles = tiles_of(ground_m, SplitSettings(30, 10))
    assert [tile.name for tile in tiles] == ["tile-0-0", "tile-1-0", "tile-2-0"]
    assert [tile.area_m for tile in tiles] == [
        (0, -0.5, 30, 0.5),
        (30, -0.5, 60, 0.5),
        (60, -0.5, 90, 0.5),
    ]
    west, middle, east = (set(tile.pictures) for tile in tiles)
    assert west & middle == set(range(25, 36))
    assert middle & east == set(range(55, 66))
    assert [tile.neighbours for tile in tiles] == [
        ("tile-1-0",),
        ("tile-0-0", "tile-2-0"),
        ("tile-1-0",),
    ]
    assert {tile.margin_m for tile in tiles} == {5.0}


def test_ground_without_pictures_is_no_tile():
    ground_m = np.array([[0.0, 0.0], [1.0, 0.0], [100.0, 0.0]])
    tiles = tiles_of(ground_m, SplitSettings(10, 0, fewest=1))
    assert [tile.name for tile in tiles] == ["tile-0-0", "tile-9-0"]
    assert [tile.neighbours for tile in tiles] == [(), ()]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ((0, 0), "length: 0 m must be above 0"),
        ((float("nan"), 0), "length: nan m must be above 0"),
        ((10, -1), "overlap: -1 m is outside 0..10 m"),
        ((10, 11), "overlap: 11 m is outside 0..10 m"),
        ((10, 1, 0), "fewest: 0 must be at least 1"),
        ((10, 1, 1, -1), "points: -1 m must be at least 0"),
    ],
)
def test_settings_outside_their_limits_are_refused(settings, message):
    with pytest.raises(InvalidInput, match=message):
        SplitSettings(*settings)


def test_too_many_tiles_and_tiles_of_too_few_pictures_are_refused():
    ground_m = np.array([[0.0, 0.0], [5000.0, 5000.0]])
    with pytest.raises(InvalidInput, match=r"10 m makes 250000 tiles .* the limit is 1000"):
        tiles_of(ground_m, SplitSettings(10, 1))
    with pytest.raises(InvalidInput, match=r"leaves tile-0-0 1 pictures, it needs 8"):
        tiles_of(ground_m, SplitSettings(2500, 1))


def test_readers_take_every_tile_in_the_recordings_own_world(tmp_path):
    drive = record(tmp_path / "drive", [float(x) for x in range(0, 61, 2)])
    tiles = split_dataset(drive, tmp_path / "split", SplitSettings(30, 8, points_m=4.0))
    assert read_tiles(tmp_path / "split") == tiles
    whole = read_dataset(drive)
    listed = json.loads((tmp_path / "split/tiles.json").read_text())["tiles"]
    for tile, entry in zip(tiles, listed, strict=True):
        dataset = read_dataset(tmp_path / "split" / tile.name)
        assert list(astuple(dataset.tile_origin)) == entry["tile_origin_m"] != [0, 0, 0]
        for index, picture in zip(tile.pictures, dataset.pictures, strict=True):
            was = whole.pictures[index]
            place, before = (
                each.tile_origin.globalise(one.camera.world_from_cam).translation_m
                for each, one in ((dataset, picture), (whole, was))
            )
            assert place == pytest.approx(before, abs=1e-9)
            assert picture.time_ns == was.time_ns
            assert (picture.read() == was.read()).all()
        x_m = dataset.points.xyz_m[:, 0] + dataset.tile_origin.east_m
        west_m, east_m = tile.area_m[0], tile.area_m[2]
        assert west_m - 4 <= x_m.min() <= west_m + 2
        assert east_m - 2 <= x_m.max() <= east_m + 4


def test_a_recording_without_points_is_split_and_a_folder_is_not_overwritten(tmp_path):
    drive = record(tmp_path / "drive", [float(x) for x in range(20)], points=False)
    settings = SplitSettings(100, 0)
    (tile,) = split_dataset(drive, tmp_path / "split", settings)
    assert tile.neighbours == ()
    assert read_dataset(tmp_path / "split" / tile.name).points is None
    with pytest.raises(InvalidInput, match="exists"):
        split_dataset(drive, tmp_path / "split", settings)


@pytest.mark.parametrize(
    "content",
    ["{}", "[", '{"tiles": []}', '{"tiles": [{"id": "a"}]}', '{"tiles": [{"id": "../a", %s}]}'],
)
def test_a_list_of_tiles_that_is_damaged_is_refused(content, tmp_path):
    rest = '"area_m": [0, 0, 1, 1], "margin_m": 0, "pictures": [], "neighbours": []'
    (tmp_path / "tiles.json").write_text(content % rest if "%s" in content else content)
    with pytest.raises(DatasetError, match=r"tiles\.json"):
        read_tiles(tmp_path)


def test_a_folder_without_a_list_has_no_tiles(tmp_path):
    assert read_tiles(tmp_path) is None
