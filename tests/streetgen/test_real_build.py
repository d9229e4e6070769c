"""The street itself, rendered: two workers, a static pose, a real kill."""

import io
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from rfcore.dataset import read_dataset, verify_manifest
from rfcore.image import read_rgb
from rfcore.metrics import psnr
from streetgen import load_scene
from streetgen.build.run import Settings, build_scene
from streetgen.build.scene_renderer import RenderJob, SceneRenderer
from streetgen.render.backend import chosen_backend
from streetgen.render.renderer import Sampling
from streetgen.scene_file import Scene
from streetgen.shots import Selection

SHORT = """
name = "short"
field = "short"
[geometry]
length_m = 40.0
[drive]
duration_s = 0.2
speed_mps = {speed_mps}
rate_hz = 20.0
thinned_hz = []
"""


@pytest.fixture
def standing(tmp_path: Path) -> Scene:
    """A short street, and a car that stands in it."""
    file = tmp_path / "standing.toml"
    file.write_text(SHORT.format(speed_mps=0.0))
    return load_scene(str(file))


def build(scene: Scene, out: Path, size_px: tuple[int, int], workers: int, frames: str) -> None:
    selection = Selection(scene, "drive", frames, size_px)
    build_scene(selection, Settings(out, workers=workers), Console(file=io.StringIO()))


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_pose_looks_the_same_in_every_frame(standing, tmp_path):
    """The same place in frames 0 and 7 of the drive, in full size: at least 42 dB apart."""
    job = RenderJob(standing, tmp_path / "s", Sampling(16), chosen_backend(), 2, (640, 360))
    renderer = SceneRenderer(job)
    shot = Selection(standing, "drive", "0:1", (640, 360)).shots()[0]
    for index in (0, 7):
        renderer.take(replace(shot, index=index, time_s=index / 20))
    first, later = (read_rgb(tmp_path / "s" / "drive" / "images" / f"00000{i}.png") for i in (0, 7))
    assert first.std() > 30, "a street is no grey card"
    assert psnr(first, later) >= 42.0


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_two_workers_take_the_same_pictures_as_one(standing, tmp_path):
    for workers in (1, 2):
        build(standing, tmp_path / str(workers), (64, 36), workers, "0:4")
    one, two = (
        [picture.read() for picture in read_dataset(tmp_path / str(n)).pictures] for n in (1, 2)
    )
    assert len(one) == 4
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a, b)
    verify_manifest(tmp_path / "2")


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_workers_end_with_a_parent_that_is_killed(tmp_path):
    file = tmp_path / "driving.toml"
    file.write_text(SHORT.format(speed_mps=5.0))
    command = [sys.executable, "-m", "streetgen", "build", str(file)]
    command += ["--out", str(tmp_path / "s"), "--size", "64x36"]
    command += ["--split", "drive", "--workers", "2"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        begun = any("1 of 4 frames" in line for line in parent.stdout)
        parent.kill()
        parent.stdout.read()  # ends when no worker holds it any more
    assert begun
    assert list((tmp_path / "s" / "drive" / "images").glob("*.png"))
    scene = load_scene(str(file))
    build(scene, tmp_path / "s", (64, 36), 1, "0:4")
    assert len(read_dataset(tmp_path / "s").pictures) == 4
