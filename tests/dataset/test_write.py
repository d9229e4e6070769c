"""A dataset written as transforms.json is read back the same."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rfcore.camera import Intrinsics, Pose
from rfcore.dataset.read import read_source
from rfcore.dataset.source import SourceCamera, SourcePoints
from rfcore.dataset.write import WrittenPicture, write_transforms
from rfcore.errors import InvalidInput
from rfcore.files import whole_folder
from rfcore.image import write_png
from rfcore.lens import BrownLens, FisheyeLens

BROWN = BrownLens(0.1, -0.2, 1e-3, 2e-3, 0.05)
LENSES = [None, BROWN, replace(BROWN, k4=0.3, k6=-0.01), FisheyeLens(0.1)]
K = Intrinsics(8, 6, 7.5, 7.25, 4.125, 2.875)
FAR = Pose((691_608.125, 5_334_760.0625, 519.5), (0.5, -0.5, 0.5, -0.5))
TURNED = Pose((1.0, 2.0, 3.0), (math.cos(0.3), 0.0, math.sin(0.3), 0.0))
POINTS = SourcePoints(
    np.array([[691_600.123456789, 1.0, 2.0]]), np.array([[1, 128, 255]], np.uint8)
)


def written(folder: Path, cameras: list[SourceCamera]) -> list[WrittenPicture]:
    pictures = []
    for i, (camera, pose) in enumerate(zip(cameras, (FAR, TURNED), strict=True)):
        write_png(folder / f"{i}.png", np.full((6, 8, 3), i, np.uint8))
        pictures.append(WrittenPicture(f"{i}.png", camera, pose, 100_000_000 * i))
    write_transforms(folder, pictures, POINTS)
    return pictures


@pytest.mark.parametrize("lens", LENSES)
def test_poses_lenses_and_points_come_back_exactly(lens, tmp_path):
    pictures = written(tmp_path, [SourceCamera(K, lens)] * 2)
    source = read_source(tmp_path)
    assert [p.time_ns for p in source.pictures] == [0, 100_000_000]
    for found, given in zip(source.pictures, pictures, strict=True):
        assert found.camera == given.camera
        assert found.world_from_cam.translation_m == given.world_from_cam.translation_m
        for axis in np.eye(3).tolist():
            assert found.world_from_cam.apply(axis) == pytest.approx(
                given.world_from_cam.apply(axis), abs=1e-9
            )
    np.testing.assert_array_equal(source.points.xyz_m, POINTS.xyz_m)
    np.testing.assert_array_equal(source.points.rgb, POINTS.rgb)


def test_pictures_of_different_cameras_keep_their_own(tmp_path):
    cameras = [SourceCamera(K), SourceCamera(K, BrownLens(k1=0.1))]
    written(tmp_path, cameras)
    assert [p.camera for p in read_source(tmp_path).pictures] == cameras


def test_a_folder_appears_whole_or_not_at_all(tmp_path):
    with pytest.raises(RuntimeError, match="half way"):
        fill_half(tmp_path / "out")
    assert list(tmp_path.iterdir()) == []
    with whole_folder(tmp_path / "out") as folder:
        (folder / "a").write_text("a")
    assert (tmp_path / "out" / "a").read_text() == "a"
    with pytest.raises(InvalidInput, match="exists"), whole_folder(tmp_path / "out"):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def fill_half(path: Path) -> None:
    with whole_folder(path) as folder:
        (folder / "a").write_text("a")
        raise RuntimeError("half way")
