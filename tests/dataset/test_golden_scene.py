"""One scene in every format: the known point lands on the known pixel, forth and back."""

import dataclasses

import numpy as np
import pytest

from dataset.conftest import GoldenScene
from rfcore.camera import TileOrigin
from rfcore.dataset import read_dataset
from rfcore.errors import DatasetError

TIMED = ("transforms", "kitti", "folder", "video")


@pytest.fixture(params=GoldenScene.FORMATS)
def format_name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def test_the_point_lands_on_its_pixel(golden, format_name, tmp_path):
    dataset = read_dataset(golden.write(format_name, tmp_path / "d"))
    assert dataset.tile_origin == TileOrigin()
    for picture, expected in zip(dataset.pictures, golden.pixels(), strict=True):
        u_px, v_px, _ = picture.camera.project(golden.point)
        assert (u_px, v_px) == pytest.approx(expected, abs=1e-9)


def test_the_pixel_of_the_point_is_white(golden, format_name, tmp_path):
    """The file of a picture belongs to its pose, and nothing is flipped or shifted."""
    for picture in read_dataset(golden.write(format_name, tmp_path / "d")).pictures:
        u_px, v_px, _ = picture.camera.project(golden.point)
        rgb = picture.read()
        assert (rgb[int(v_px), int(u_px)] > 250).all()
        assert np.median(rgb) == pytest.approx(90, abs=1)


def test_a_byte_order_mark_before_text_changes_nothing(golden, format_name, tmp_path):
    """Editors of Windows write one."""
    folder = golden.write(format_name, tmp_path / "d")
    plain = read_dataset(folder)
    root = folder if folder.is_dir() else folder.parent
    texts = [p for p in root.rglob("*") if p.suffix in (".txt", ".json", ".toml", ".csv")]
    for text in texts:
        text.write_bytes(b"\xef\xbb\xbf" + text.read_bytes())
    assert texts or format_name == "colmap_binary"
    assert [p.camera for p in read_dataset(folder).pictures] == [p.camera for p in plain.pictures]


def test_a_scene_at_utm_magnitudes_keeps_its_pixels(golden_utm, format_name, tmp_path):
    """float64 resolves 1e-9 m there; cam_from_world of COLMAP multiplies that by its turn."""
    dataset = read_dataset(golden_utm.write(format_name, tmp_path / "d"))
    origin = dataset.tile_origin
    assert dataclasses.astuple(origin) == pytest.approx((691_609.0, 5_334_760.0, 520.5), abs=0.6)
    assert all(value == round(value) for value in dataclasses.astuple(origin))
    near = np.subtract(golden_utm.point, (origin.east_m, origin.north_m, origin.up_m))
    for picture, expected in zip(dataset.pictures, golden_utm.pixels(), strict=True):
        u_px, v_px, _ = picture.camera.project(near.tolist())
        assert (u_px, v_px) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("timed", TIMED)
def test_times_give_the_rate(golden, timed, tmp_path):
    dataset = read_dataset(golden.write(timed, tmp_path / "d"))
    times_ns = [picture.time_ns for picture in dataset.pictures]
    assert times_ns == [100_000_000_000, 100_100_000_000, 100_200_000_000]
    assert dataset.rate_hz == pytest.approx(10.0)


@pytest.mark.parametrize("colmap", ["colmap_text", "colmap_binary"])
def test_a_model_brings_its_points(golden, colmap, tmp_path):
    points = read_dataset(golden.write(colmap, tmp_path / "d")).points
    np.testing.assert_array_equal(points.xyz_m, [golden.point])
    np.testing.assert_array_equal(points.rgb, [[255, 128, 0]])


def test_a_video_is_read_in_any_order(golden, tmp_path):
    pictures = read_dataset(golden.write("video", tmp_path / "d")).pictures
    ahead = [picture.read() for picture in pictures]
    for i in (2, 0, 1, 1):
        np.testing.assert_array_equal(pictures[i].read(), ahead[i])


def test_a_folder_with_two_datasets_asks_which(golden, tmp_path):
    folder = golden.write("colmap_text", tmp_path)
    golden.write("inria", tmp_path)
    with pytest.raises(DatasetError, match=r"several datasets.*cameras\.json.*images\.txt"):
        read_dataset(folder)
    assert len(read_dataset(folder / "cameras.json").pictures) == 3
    assert len(read_dataset(folder / "sparse" / "0").pictures) == 3


def test_a_folder_without_a_dataset_says_what_is_expected(tmp_path):
    with pytest.raises(DatasetError, match=r"transforms\.json, .*camera\.toml"):
        read_dataset(tmp_path)
