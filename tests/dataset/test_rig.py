"""The rig file: what it says, and what is refused with which words."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rfcore.camera import Pose, camera_on_rig
from rfcore.dataset.rig import MAX_RIG_CAMERAS, Rig, RigCamera, read_rig, read_rig_drive, write_rig
from rfcore.errors import DatasetError
from rfcore.image import write_png
from rfcore.wire.values import MAX_CAMERAS, MAX_LEVER_ARM_M

EXTRINSICS = "camera_from_rig = [[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 0]]\n"
FRONT = f'[[camera]]\nname = "front"\ndrive = "front"\n{EXTRINSICS}'
REAR = f'[[camera]]\nname = "rear"\ndrive = "rear"\n{EXTRINSICS}'
LIVE = f'[[camera]]\nname = "rear"\nsource = "rtsp://a/b"\ncamera_file = "r.toml"\n{EXTRINSICS}'


def read(tmp_path: Path, text: str) -> Rig:
    (tmp_path / "rig.toml").write_text(text)
    return read_rig(tmp_path)


def test_cameras_are_read_the_reference_first(tmp_path):
    rig = read(tmp_path, 'reference = "rear"\n' + FRONT + "priority = 2.0\n" + REAR)
    assert [camera.name for camera in rig.cameras] == ["rear", "front"]
    assert (rig.cameras[1].priority, rig.cameras[1].drive) == (2.0, tmp_path / "front")
    assert rig.reference.camera_from_rig.translation_m == (0.5, 0.0, 0.0)
    assert not rig.is_live


def test_sources_make_a_live_rig(tmp_path):
    rig = read(tmp_path, LIVE)
    assert rig.is_live
    assert rig.reference.camera_file == tmp_path / "r.toml"


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("camera = [", "not TOML"),
        ("", "key 'camera' is missing"),
        ("camera = []", "has 0 cameras, outside 1..32"),
        (FRONT * 2, "2 cameras are named 'front'"),
        (FRONT + LIVE, "either all a 'drive' or all a 'source'"),
        ('reference = "roof"\n' + FRONT, "key 'reference' is 'roof', none of front"),
        (FRONT + 'source = "rtsp://a/b"', "camera 'front': name either a 'drive' or a 'source'"),
        (FRONT.replace('drive = "front"\n', ""), "name either a 'drive' or a 'source'"),
        (LIVE.replace('camera_file = "r.toml"\n', ""), "a source needs a camera.toml"),
        (FRONT.replace(EXTRINSICS, ""), "camera 'front': key 'camera_from_rig' is missing"),
        (FRONT.replace("[0, 1, 0, 0]", "[0, 2, 0, 0]"), "not a rotation"),
        (FRONT.replace("0.5]", "500]"), "beyond 100 m from the rig's origin"),
        (FRONT + "priority = 0", "key 'priority' is 0, outside 0.1..10"),
        (FRONT + "prioritty = 1", "key 'prioritty' is none of name, drive"),
        (FRONT.replace('"front"\nc', '"../front"\nc'), "leaves the dataset's folder"),
        ("rate = 3\n" + FRONT, "key 'rate' is none of reference, camera"),
    ],
)
def test_a_bad_file_is_refused_by_name(tmp_path, text, problem):
    with pytest.raises(DatasetError) as raised:
        read(tmp_path, text)
    assert problem in str(raised.value)
    assert "rig.toml" in str(raised.value)


def test_a_rig_may_have_as_many_cameras_as_a_hello():
    assert MAX_RIG_CAMERAS == MAX_CAMERAS
    assert MAX_LEVER_ARM_M == 100.0


def yaw(rad: float) -> Pose:
    return Pose((0.0, 0.2, 0.0), (math.cos(rad / 2), 0.0, math.sin(rad / 2), 0.0))


def write_drives(tmp_path: Path, rig: Rig, counts: dict[str, int]) -> None:
    for camera in rig.cameras:
        camera.drive.mkdir()
        frames = []
        for i in range(counts[camera.name]):
            pose = camera_on_rig(Pose((i, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)), camera.camera_from_rig)
            rows = zip(pose.rotation_matrix(), pose.translation_m, strict=True)
            matrix = [*([r[0], -r[1], -r[2], t] for r, t in rows), [0, 0, 0, 1]]
            write_png(camera.drive / f"{i}.png", np.zeros((4, 6, 3), np.uint8))
            frames.append(f'{{"file_path": "{i}.png", "transform_matrix": {matrix}}}')
        text = f'{{"w": 6, "h": 4, "fl_x": 5, "frames": [{", ".join(frames)}]}}'
        (camera.drive / "transforms.json").write_text(text)
    write_rig(tmp_path / "rig.toml", rig)


def rig_of_two(tmp_path: Path) -> Rig:
    return Rig(
        (
            RigCamera("front", yaw(0.3), tmp_path / "front", priority=1.5),
            RigCamera("rear", yaw(3.0), tmp_path / "rear"),
        )
    )


def test_a_rig_that_was_written_is_read_back(tmp_path):
    rig = rig_of_two(tmp_path)
    write_drives(tmp_path, rig, {"front": 2, "rear": 2})
    again = read_rig(tmp_path / "rig.toml")
    for was, found in zip(rig.cameras, again.cameras, strict=True):
        assert (was.name, was.drive, was.priority) == (found.name, found.drive, found.priority)
        apart = was.camera_from_rig.inverse().compose(found.camera_from_rig)
        assert math.hypot(*apart.translation_m) < 1e-12
        assert abs(apart.rotation[0]) == pytest.approx(1.0, abs=1e-12)


def test_every_camera_is_where_the_rigs_rounded_pose_puts_it(tmp_path):
    rig = rig_of_two(tmp_path)
    write_drives(tmp_path, rig, {"front": 3, "rear": 3})
    instants = read_rig_drive(read_rig(tmp_path))
    assert len(instants) == 3
    for i, instant in enumerate(instants):
        pose = instant.world_from_rig
        assert pose == pose.rounded()
        assert pose.translation_m == pytest.approx((i, 0.0, 0.0), abs=1e-6)
        for camera in read_rig(tmp_path).cameras:
            found = instant.pictures[camera.name].camera.world_from_cam
            assert found == camera_on_rig(pose, camera.camera_from_rig)


def test_drives_of_different_lengths_are_refused(tmp_path):
    write_drives(tmp_path, rig_of_two(tmp_path), {"front": 3, "rear": 2})
    with pytest.raises(DatasetError, match="camera 'rear' has 2 pictures, that of 'front' 3"):
        read_rig_drive(read_rig(tmp_path))


def test_extrinsics_that_the_drives_contradict_are_refused(tmp_path):
    rig = rig_of_two(tmp_path)
    write_drives(tmp_path, rig, {"front": 2, "rear": 2})
    wrong = replace(rig.cameras[1], camera_from_rig=yaw(2.9))
    write_rig(tmp_path / "rig.toml", replace(rig, cameras=(rig.cameras[0], wrong)))
    with pytest.raises(DatasetError, match=r"camera 'rear': its drive has 0.png .* degrees from"):
        read_rig_drive(read_rig(tmp_path))
