"""A street of a few hundred Gaussians as a whole sample: views, points, two drives, manifest."""

import json
from pathlib import Path

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.dataset import write_manifest
from rfcore.dataset.source import SourceCamera, SourcePoints
from rfcore.dataset.write import WrittenPicture, transforms_of, write_points
from rfcore.image import write_png
from rfcore.raster.gaussians import Gaussians
from rfcore.raster.native import Rasterizer
from tests.clouds import upright

INTRINSICS = Intrinsics(96, 64, 60.0, 60.0, 48.0, 32.0)
DRIVE_FRAMES = 4


def tiny_street() -> Gaussians:
    rng = np.random.default_rng(3)
    means = rng.uniform([-4, -2, 4], [4, 2, 9], (400, 3))
    return upright(means, rng.uniform(-1.5, 1.5, (400, 3)), 0.25).gaussians


def write_views(folder: Path, name: str, xs_m: list[float], boxes: bool = False) -> None:
    """Render and write one set of views, with a box nobody trained on if ``boxes``."""
    rasterizer = Rasterizer(tiny_street())
    written = []
    (folder / name).mkdir()
    for number, x_m in enumerate(xs_m):
        camera = Camera(INTRINSICS, Pose((x_m, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)))
        colour = rasterizer.render(camera).colour
        rgb = np.floor(np.clip(colour, 0, 1) * 255 + 0.5).astype(np.uint8)
        if boxes:
            rgb[20:40, 10 + 4 * number : 34 + 4 * number] = (200, 30, 40)
        file, time_ns = f"{name}/{number:03d}.png", number * 100_000_000
        write_png(folder / file, rgb)
        pose = camera.world_from_cam
        written.append(WrittenPicture(file, SourceCamera(INTRINSICS), pose, time_ns))
    points = "points.ply" if name == "train" else None
    (folder / f"transforms_{name}.json").write_text(json.dumps(transforms_of(written, points)))


@pytest.fixture
def tiny_sample(tmp_path: Path) -> Path:
    """Return a folder laid out as ``samples/street``."""
    folder = tmp_path / "tiny"
    folder.mkdir()
    write_views(folder, "train", [i / 4 - 1.5 for i in range(12)])
    drive = [i / 10 for i in range(DRIVE_FRAMES)]
    write_views(folder, "drive_empty", drive)
    write_views(folder, "drive_vehicles", drive, boxes=True)
    means_m = tiny_street().means.astype(np.float64)
    grey = np.full(means_m.shape, 128, np.uint8)
    write_points(folder / "points.ply", SourcePoints(means_m, grey))
    write_manifest(folder)
    return folder


@pytest.fixture
def tiny_gaussians() -> Gaussians:
    """Return the Gaussians the tiny street's pictures were rendered from."""
    return tiny_street()
