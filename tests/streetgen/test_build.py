"""Builds on disk: read back as they were taken, resumed after a kill, stopped by a full disk."""

import errno
import io
import json
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console

from rfcore.dataset import read_dataset, verify_manifest
from rfcore.dataset.rig import read_rig, read_rig_drive
from rfcore.dataset.source import read_points
from rfcore.errors import InvalidInput, RfedgeError
from streetgen.build import run
from streetgen.build.run import Settings, build_scene
from streetgen.build.scene_renderer import (
    RenderJob,
    SceneRenderer,
    ShotFiles,
    depth_mm,
    read_depth_m,
)
from streetgen.effects.lens import LensDistortion
from streetgen.render.backend import Backend
from streetgen.render.renderer import RenderedFrame
from streetgen.scene_file import DriveSettings, LocalisationNoise, Scene, TrainingSettings
from streetgen.shots import Selection

SCENE = Scene(
    "s",
    "s",
    drive=DriveSettings(duration_s=0.5, thinned_hz=(10.0,)),
    train=TrainingSettings(views=4),
)
SIZE_PX = (32, 18)


class RoadRenderer:
    """Stands in for the path tracer: a grey road 1.62 m below, each pixel of its own shade."""

    def render(self, *_: object) -> RenderedFrame:
        rows = np.arange(18) + 0.5 - 9
        depth_m = np.where(rows > 0, 1.62 * 16 / np.maximum(rows, 0.1), np.inf)
        shade = np.linspace(0.05, 0.9, 18 * 32, dtype=np.float32).reshape(18, 32, 1)
        return RenderedFrame(
            colour=np.repeat(shade, 3, axis=2),
            depth_m=np.repeat(depth_m[:, None], 32, axis=1).astype(np.float32),
            labels=np.repeat(np.where(rows > 0, 1, 0)[:, None], 32, axis=1).astype(np.uint8),
        )


class QuickRenderer(SceneRenderer):
    """A renderer whose world need not be made."""

    def __init__(self, job: RenderJob) -> None:
        self._job = job
        self._renderer = RoadRenderer()


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "SceneRenderer", QuickRenderer)
    monkeypatch.setattr(run, "chosen_backend", lambda _: Backend("llvm_ad_rgb", "libLLVM.so"))


def build(out: Path, scene: Scene = SCENE, splits: str = "all", frames: str | None = None) -> str:
    said = io.StringIO()
    selection = Selection(scene, splits, frames, SIZE_PX)
    build_scene(selection, Settings(out), Console(file=said, width=200))
    return said.getvalue()


def files(folder: Path) -> dict[str, bytes]:
    """All but the manifest, which names the command."""
    found = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(p.relative_to(folder)): p.read_bytes() for p in found if p.name != "manifest.json"}


def test_a_build_is_read_back_as_it_was_taken(tmp_path):
    build(tmp_path / "s", frames="0:19")
    shots = Selection(SCENE, "all", "0:19", SIZE_PX).shots()
    verify_manifest(tmp_path / "s")
    drive = read_dataset(tmp_path / "s" / "transforms_drive.json")
    assert len(drive.pictures) == 15
    for shot, picture in zip(shots, drive.pictures, strict=False):
        seen = drive.tile_origin.globalise(picture.camera.world_from_cam)
        true = shot.camera.world_from_cam
        np.testing.assert_allclose(seen.translation_m, true.translation_m, atol=1e-9)
        np.testing.assert_allclose(seen.rotation_matrix(), true.rotation_matrix(), atol=1e-9)
        assert picture.camera.intrinsics == shot.camera.intrinsics
        assert picture.time_ns == round(shot.time_s * 1e9)
    assert len(read_dataset(tmp_path / "s").pictures) == 4, "transforms.json is the training views"
    assert len(read_dataset(tmp_path / "s" / "transforms_drive_10hz.json").pictures) == 5


def test_points_lie_on_the_pixels_that_show_them_at_their_depth(tmp_path):
    build(tmp_path / "s", splits="drive", frames="0:1")
    shot = Selection(SCENE, "drive", "0:1", SIZE_PX).shots()[0]
    found = ShotFiles.of(tmp_path / "s", shot)
    depth_m = read_depth_m(tmp_path / "s" / "drive" / "depth" / "000000.png")
    rgb = cv2.imread(str(found.picture))[..., ::-1]
    points = read_points(found.points)
    assert len(points.xyz_m) == 9 * 32
    for xyz, colour in zip(points.xyz_m, points.rgb, strict=True):
        u, v, z = shot.camera.project(xyz)
        assert (u % 1, v % 1) == pytest.approx((0.5, 0.5), abs=1e-5)
        assert depth_m[int(v), int(u)] == pytest.approx(z, abs=0.0006)
        assert (rgb[int(v), int(u)] == colour).all()


def test_depth_is_in_millimetres_and_zero_where_there_is_none():
    stored = depth_mm(np.array([[1.2344, 65.535, 65.536, np.inf]], np.float32))
    assert stored.tolist() == [[1234, 65535, 0, 0]]
    assert stored.dtype == np.uint16


def test_a_build_goes_on_where_it_was_stopped(tmp_path):
    build(tmp_path / "whole", frames="0:6")
    build(tmp_path / "parts", frames="0:2")
    before = {path: path.stat().st_mtime_ns for path in tmp_path.glob("parts/drive/*/00000[01].*")}
    assert "2 of 6 frames are there already" in build(tmp_path / "parts", frames="0:6")
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert files(tmp_path / "parts") == files(tmp_path / "whole")
    assert "about" not in build(tmp_path / "parts", frames="0:6"), "nothing is left to take"


KILLED = """
import os, signal, sys
from pathlib import Path
from importlib.util import module_from_spec, spec_from_file_location
spec = spec_from_file_location("test_build", sys.argv[1])
test = module_from_spec(spec)
spec.loader.exec_module(test)
from streetgen.build import run, scene_renderer
from streetgen.render.backend import Backend
run.SceneRenderer = test.QuickRenderer
run.chosen_backend = lambda _: Backend("llvm_ad_rgb", "libLLVM.so")
write, seen = scene_renderer.write_points, []
def killing(path, points):
    write(path, points)
    seen.append(path)
    if len(seen) == 4:
        (path.parent.parent / "images" / "000003.png.part").write_bytes(b"half a pict")
        os.kill(os.getpid(), signal.SIGKILL)
scene_renderer.write_points = killing
test.build(Path(sys.argv[2]), splits="drive", frames="0:6")
"""


def test_a_build_that_was_killed_goes_on_to_the_same_bytes(tmp_path):
    """SIGKILL in the middle of the fourth frame, with a half-written picture left over."""
    command = [sys.executable, "-c", KILLED, __file__, str(tmp_path / "killed")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert len(list((tmp_path / "killed" / "drive" / "images").glob("*.png"))) == 3
    assert not (tmp_path / "killed" / "transforms.json").exists()
    build(tmp_path / "killed", splits="drive", frames="0:6")
    build(tmp_path / "whole", splits="drive", frames="0:6")
    assert files(tmp_path / "killed") == files(tmp_path / "whole")
    verify_manifest(tmp_path / "killed")


def test_a_full_disk_ends_in_one_error_and_leaves_whole_frames(tmp_path, monkeypatch):
    write = ShotFiles.write

    def full(self: ShotFiles, *values: object) -> None:
        if self.name == "000002":
            raise OSError(errno.ENOSPC, "No space left on device")
        write(self, *values)

    with monkeypatch.context() as until_space:
        until_space.setattr(ShotFiles, "write", full)
        with pytest.raises(RfedgeError, match=r"drive/000002 .*No space left.*goes on") as caught:
            build(tmp_path / "s", splits="drive", frames="0:4")
    assert "\n" not in str(caught.value)
    assert len(list((tmp_path / "s" / "drive" / "images").iterdir())) == 2
    assert "2 of 4" in build(tmp_path / "s", splits="drive", frames="0:4")
    assert len(read_dataset(tmp_path / "s").pictures) == 4


def test_another_build_is_not_mixed_into_a_folder(tmp_path):
    build(tmp_path / "s", frames="0:1")
    other = replace(SCENE, drive=replace(SCENE.drive, lane_offset_m=1.0))
    with pytest.raises(InvalidInput, match=r"holds another build \(differs in scene\)"):
        build(tmp_path / "s", other, frames="0:1")
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters" / "to-mother.txt").write_text("Dear")
    with pytest.raises(InvalidInput, match="holds no build of a scene"):
        build(tmp_path / "letters", frames="0:1")
    assert [path.name for path in (tmp_path / "letters").iterdir()] == ["to-mother.txt"]


def test_measured_poses_stand_beside_the_true_ones(tmp_path):
    noisy = replace(SCENE, pose_noise=LocalisationNoise(position_m=0.1))
    build(tmp_path / "s", noisy, splits="drive", frames="0:4")
    true, measured = (
        json.loads((tmp_path / "s" / f"transforms_drive{suffix}.json").read_text())["frames"]
        for suffix in ("", "_measured")
    )
    moved = [
        np.linalg.norm(np.subtract(a["transform_matrix"], b["transform_matrix"])[:3, 3])
        for a, b in zip(true, measured, strict=True)
    ]
    assert 0.01 < np.mean(moved) < 0.5
    assert [frame["file_path"] for frame in true] == [frame["file_path"] for frame in measured]


def test_a_lens_is_written_with_its_pictures(tmp_path):
    bent = replace(SCENE, effects={"lens": LensDistortion(k1=-0.1)})
    build(tmp_path / "s", bent, splits="drive", frames="0:1")
    content = json.loads((tmp_path / "s" / "transforms.json").read_text())
    assert content["k1"] == -0.1
    dataset = read_dataset(tmp_path / "s", distortion="undistort")
    assert dataset.changes == ("1 of 1 pictures are undistorted",)
    classes = cv2.imread(str(tmp_path / "s/drive/classes/000000.png"), cv2.IMREAD_UNCHANGED)
    depth_m = read_depth_m(tmp_path / "s" / "drive" / "depth" / "000000.png")
    assert ((classes == 0) == np.isinf(depth_m)).all()


def test_a_rig_is_recorded_with_a_file_that_the_agent_reads(tmp_path):
    drive = DriveSettings(
        duration_s=0.3, rate_hz=10.0, thinned_hz=(), rig="mid_front,mid_back,low_left"
    )
    build(tmp_path, replace(SCENE, drive=drive), "rig", frames="0:8")
    rig = read_rig(tmp_path)
    assert [camera.name for camera in rig.cameras] == ["mid_front", "mid_back", "low_left"]
    instants = read_rig_drive(rig)
    assert len(instants) == 2, "the third is not whole"
    for instant in instants:
        assert instant.world_from_rig.translation_m[2] == pytest.approx(0.0, abs=1e-6)
        heights = [p.camera.world_from_cam.translation_m[2] for p in instant.pictures.values()]
        assert heights == pytest.approx([2.5, 2.5, 0.5], abs=1e-6)
        assert instant.pictures["low_left"].read().shape == (18, 32, 3)
