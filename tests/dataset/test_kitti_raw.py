"""A raw drive of KITTI: the golden scene, measured by a GPS and an IMU."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rfcore.dataset import read_dataset
from rfcore.errors import DatasetError
from rfcore.geodesy import Anchor

DRIVE = "2011_09_26_drive_0001_sync"
HOME = Anchor(49.011212, 8.422885, 112.8)
VELO_FROM_IMU = np.array([[1.0, 0, 0, -0.81], [0, 1, 0, 0.32], [0, 0, 1, -0.8], [0, 0, 0, 1]])
CAM0_FROM_VELO = np.array(
    [[0.0, -1, 0, -0.004], [0, 0, -1, -0.076], [1, 0, 0, -0.27], [0, 0, 0, 1]]
)
SHIFT_M = (0.06, -0.0004, 0.0027)
"""Offset of camera 2 from camera 0."""
Fault = Callable[[Path], None]


def turn(axis: int, angle_rad: float) -> np.ndarray:
    matrix, (i, j) = np.eye(4), ((1, 2), (2, 0), (0, 1))[axis]
    matrix[i, i] = matrix[j, j] = np.cos(angle_rad)
    matrix[j, i], matrix[i, j] = np.sin(angle_rad), -np.sin(angle_rad)
    return matrix


RECTIFIED = turn(0, 0.01) @ turn(1, -0.008)


def imu_from_cam2() -> np.ndarray:
    cam2_from_cam0 = np.eye(4)
    cam2_from_cam0[:3, 3] = SHIFT_M
    return np.linalg.inv(cam2_from_cam0 @ RECTIFIED @ CAM0_FROM_VELO @ VELO_FROM_IMU)


def words(values: Any) -> str:
    return " ".join(map(repr, map(float, np.ravel(values))))


def write_raw(golden: Any, root: Path) -> tuple[Path, np.ndarray]:
    """Write a drive; return its folder, and where its first IMU position is in the golden scene."""
    folder = root / DRIVE
    names = golden._pictures(folder / "image_02" / "data")
    stamps = [f"2011-09-26 13:02:{25 + 0.1 * i:012.9f}" for i in range(len(names))]
    (folder / "image_02" / "timestamps.txt").write_text("\n".join(stamps) + "\n")
    poses = [matrix @ np.linalg.inv(imu_from_cam2()) for matrix in golden.world_from_cam]
    (folder / "oxts" / "data").mkdir(parents=True)
    for name, pose in zip(names, poses, strict=True):
        place = HOME.geodetic_from_world(tuple(pose[:3, 3] - poses[0][:3, 3]))
        pitch = -np.arcsin(pose[2, 0])
        roll, yaw = np.arctan2(pose[2, 1], pose[2, 2]), np.arctan2(pose[1, 0], pose[0, 0])
        line = words([*place, roll, pitch, yaw, *range(24)])
        (folder / "oxts" / "data" / f"{Path(name).stem}.txt").write_text(line + "\n")
    (fx, fy), (cx, cy) = golden.FOCAL_PX, golden.CENTRE_PX
    p = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]) @ np.c_[np.eye(3), SHIFT_M]
    (root / "calib_cam_to_cam.txt").write_text(
        f"calib_time: 09-Jan-2012 13:57:47\nR_rect_00: {words(RECTIFIED[:3, :3])}\n"
        f"P_rect_02: {words(p)}\n"
    )
    for name, matrix in (("imu_to_velo", VELO_FROM_IMU), ("velo_to_cam", CAM0_FROM_VELO)):
        text = f"calib_time: x\nR: {words(matrix[:3, :3])}\nT: {words(matrix[:3, 3])}\n"
        (root / f"calib_{name}.txt").write_text(text)
    return folder, poses[0][:3, 3]


def test_the_point_lands_on_its_pixel(golden, tmp_path):
    folder, first_m = write_raw(golden, tmp_path)
    for path in (folder, folder / "oxts"):
        dataset = read_dataset(path)
        origin = np.array(dataclasses.astuple(dataset.tile_origin))
        near_m = np.subtract(golden.point, first_m) - origin
        assert len(dataset.pictures) == 3
        for picture, expected in zip(dataset.pictures, golden.pixels(), strict=True):
            u_px, v_px, _ = picture.camera.project(near_m.tolist())
            assert (u_px, v_px) == pytest.approx(expected, abs=1e-6)
            assert (picture.read()[int(v_px), int(u_px)] > 250).all()


def test_it_is_where_its_gps_says_and_when_its_clock_says(golden, tmp_path):
    dataset = read_dataset(write_raw(golden, tmp_path)[0])
    assert dataset.rate_hz == pytest.approx(10.0)
    assert dataset.pictures[0].time_ns == 1_317_042_145_000_000_000
    found = (dataset.anchor.latitude_deg, dataset.anchor.longitude_deg, dataset.anchor.height_m)
    assert found == pytest.approx((HOME.latitude_deg, HOME.longitude_deg, HOME.height_m))


def edit(name: str, before: str, after: str) -> Fault:
    def fault(folder: Path) -> None:
        file = folder / name
        text = file.read_text()
        assert before in text
        file.write_text(text.replace(before, after))

    return fault


SECOND = "oxts/data/000001.txt"
TIMES = "image_02/timestamps.txt"


@pytest.mark.parametrize(
    ("fault", "problem"),
    [
        (lambda f: (f / SECOND).unlink(), r"oxts/data: holds 2 files for 3 pictures in image_02"),
        (lambda f: (f / SECOND).rename(f / "oxts/data/000009.txt"), r"is of no picture; 000001"),
        (edit(SECOND, " 23.0", ""), r"000001\.txt: has 29 numbers"),
        (edit(SECOND, " 23.0", " nan"), r"000001\.txt: nan is not"),
        (lambda f: (f / SECOND).write_text(""), r"000001\.txt: has 0 numbers"),
        (lambda f: (f / SECOND).write_text("99 " * 30), r"000001\.txt: .*latitude.*99"),
        (lambda f: (f / "oxts/data/000000.txt").write_text("99 " * 30), r"000000\.txt: .*latitude"),
        (edit(TIMES, "13:02:25.1", "25:02:25.1"), r"timestamps\.txt: line 2: '2011-09-26 25"),
        (edit(TIMES, "25.100000000", "25.1000000001"), r"line 2: .* not a time to nanoseconds"),
        (edit(TIMES, "2011-09-26 13:02:25.200000000\n", ""), r"holds 2 times for 3 pictures"),
        (edit("../calib_cam_to_cam.txt", "R_rect_00", "R_rect_09"), r"no line 'R_rect_00:'"),
        (edit("../calib_cam_to_cam.txt", "P_rect_02", "P_rect_09"), r"no line 'P_rect_02:'"),
        (edit("../calib_imu_to_velo.txt", "T: -0.81 ", "T: "), r"line 3 \(T\): has 2 numbers"),
        (edit("../calib_velo_to_cam.txt", "R: 0.0 ", "R: "), r"line 2 \(R\): has 8 numbers"),
        (edit("../calib_velo_to_cam.txt", "R: 0.0 -1.0", "R: 0.0 -3.0"), r"not a rotation"),
        (lambda f: (f / "../calib_imu_to_velo.txt").unlink(), r"calib_imu_to_velo\.txt"),
    ],
)
def test_a_fault_is_one_clear_error(golden, tmp_path, fault, problem):
    folder, _ = write_raw(golden, tmp_path)
    fault(folder)
    with pytest.raises(DatasetError, match=problem) as refused:
        read_dataset(folder)
    assert "\n" not in str(refused.value)
