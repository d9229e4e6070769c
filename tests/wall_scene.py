"""A field that is one grey wall, and a vehicle's pictures of it: answers by algebra."""

import numpy as np

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.field import SplatField
from rfcore.image import jpeg_bytes
from rfcore.raster.gaussians import Gaussians
from rfcore.wire.twin import PictureEncoding, TwinPicture

INTRINSICS = Intrinsics(96, 64, 80.0, 80.0, 48.0, 32.0)
WALL_M = 4.0
"""Distance of the wall that ``wall_field`` is, along +z."""


def wall_field(level: float) -> SplatField:
    """An opaque grey wall across the view of a camera at the origin."""
    x, y = np.meshgrid(np.arange(-4.0, 4.0, 0.1), np.arange(-3.0, 3.0, 0.1))
    means = np.stack([x.ravel(), y.ravel(), np.full(x.size, WALL_M)], 1).astype(np.float32)
    n = len(means)
    sh = np.full((n, 1, 3), (level - 0.5) / 0.28209479, np.float32)
    return SplatField(
        Gaussians(
            means,
            np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
            np.full((n, 3), np.log(0.1), np.float32),
            np.full(n, 8.0, np.float32),
            sh,
        )
    )


def seen(field: SplatField, *, key: tuple[str, str] = ("cav-1", "front"), sequence: int = 0,
         object_level: int | None = None) -> TwinPicture:  # fmt: skip
    """The field's own render as a vehicle's picture, with a block of 48x32 px of another level
    whose lower edge is at 48 px, if one is given."""
    camera = Camera(INTRINSICS, Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)))
    rgb = np.round(field.render(camera).colour.clip(0, 1) * 255).astype(np.uint8)
    if object_level is not None:
        rgb[16:48, 32:80] = object_level
    return TwinPicture(
        vehicle_id=key[0],
        camera_id=key[1],
        session_id="session",
        epoch=0,
        sequence=sequence,
        capture_time_ns=0,
        age_ns=5_000_000,
        pose=camera.world_from_cam,
        intrinsics=INTRINSICS,
        field_id=field.field_id,
        reconstruction_digest=b"",
        encoding=PictureEncoding.JPEG,
        picture=jpeg_bytes(rgb),
    )
