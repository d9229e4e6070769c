"""A thumbnail street on disk: a field of a few hundred Gaussians, and drives past it."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.field import SplatField, save_field
from rfcore.image import write_png
from tests.clouds import cloud

INTRINSICS = Intrinsics(96, 64, 70.0, 70.0, 48.0, 32.0)
FRAMES = 5
STEP_M = 0.05
NOISE_LEVELS = 3.0


def write_drive(folder: Path, field: SplatField, *, with_box: bool) -> Path:
    """Write what a camera sees that passes the wall: with noise, and a box the field lacks."""
    rng = np.random.default_rng(9)
    folder.mkdir()
    frames = []
    for k in range(FRAMES):
        camera = Camera(INTRINSICS, Pose((STEP_M * k, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)))
        levels = 255 * np.asarray(field.render_colour(camera))
        levels += rng.normal(scale=NOISE_LEVELS, size=levels.shape)
        if with_box:
            levels[24:48, 16 + 6 * k : 40 + 6 * k] = (230, 210, 30)
        write_png(folder / f"{k}.png", np.clip(np.rint(levels), 0, 255).astype(np.uint8))
        matrix = np.diag([1.0, -1.0, -1.0, 1.0])  # the file has OpenGL's camera axes
        matrix[0, 3] = STEP_M * k
        frames.append({"file_path": f"{k}.png", "transform_matrix": matrix.tolist()})
    k_ = INTRINSICS
    content = {"w": k_.width_px, "h": k_.height_px, "fl_x": k_.fx_px, "fl_y": k_.fy_px}
    path = folder / "transforms.json"
    path.write_text(json.dumps(content | {"cx": k_.cx_px, "cy": k_.cy_px, "frames": frames}))
    return path


@dataclass(frozen=True)
class Thumbnail:
    """Files of the street: the field, a drive with a box in it, and the same without."""

    folder: Path
    field: Path
    drive: str
    empty: str


@pytest.fixture(scope="session")
def thumbnail(tmp_path_factory: pytest.TempPathFactory) -> Thumbnail:
    folder = tmp_path_factory.mktemp("thumbnail")
    field = cloud(1, 1500, [-4, -3, 4], [4, 3, 4.5], 0.12, reach=1.2)
    save_field(field, folder / "wall.rff")
    drive = write_drive(folder / "drive", field, with_box=True)
    empty = write_drive(folder / "empty", field, with_box=False)
    return Thumbnail(folder, folder / "wall.rff", f"wall@10={drive}", f"wall@10={empty}")
