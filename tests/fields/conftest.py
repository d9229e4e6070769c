"""A small coloured cloud, a drive through it, and what the drive's camera saw."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.field import FieldMetadata, SplatField
from rfcore.image import Rgb
from rfcore.raster.gaussians import Gaussians
from rfcore.views import PosedPicture

INTRINSICS = Intrinsics(96, 64, 60.0, 60.0, 48.0, 32.0)


@dataclass(frozen=True)
class Place:
    """A field, and pictures of it taken along a drive."""

    field: SplatField
    pictures: list[PosedPicture]


def cloud(n: int = 300) -> Gaussians:
    """Blobs of any colour in a box that is no two ways alike, 1 to 6 m ahead of the drive."""
    rng = np.random.default_rng(4)
    sh = np.zeros((n, 4, 3), np.float32)
    sh[:, 0] = rng.uniform(-1.6, 1.6, (n, 3))
    sh[:, 1:] = rng.normal(scale=0.1, size=(n, 3, 3))
    return Gaussians(
        means=rng.uniform([-3, 1, -1], [4, 6, 2], (n, 3)).astype(np.float32),
        quaternions=rng.normal(size=(n, 4)).astype(np.float32),
        log_scales=rng.uniform(-1.9, -1.1, (n, 3)).astype(np.float32),
        opacity_logits=np.full(n, 2.5, np.float32),
        sh=sh,
    )


def taken(picture: Rgb) -> Callable[[], Rgb]:
    return lambda: picture


@pytest.fixture(scope="session")
def place() -> Place:
    """Return the cloud and six pictures of it, level and looking along y, as a car's would."""
    field = SplatField(cloud(), FieldMetadata("cloud", held_out_psnr_db=40.0))
    half = np.sqrt(0.5)
    pictures = []
    for number in range(6):
        pose = Pose((number / 5 - 0.4, -0.5, 0.3 + number / 20), (half, -half, 0.0, 0.0))
        camera = Camera(INTRINSICS, pose)
        rgb = np.floor(np.clip(field.render_colour(camera), 0, 1) * 255 + 0.5).astype(np.uint8)
        pictures.append(PosedPicture(f"{number:03d}.png", camera, taken(rgb)))
    return Place(field, pictures)
