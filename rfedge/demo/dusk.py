"""A drive at dusk, made of a drive at noon: the same pictures under a declared light.

The sample has no pictures of an evening; ``rfedge scene build street-dusk`` renders some. Without
them, the linear light of each noon picture (sRGB's curve undone, IEC 61966-2-1) is multiplied by

    TINT * (SHADOW + 1 / (1 + exp(-s / WIDTH_M))),

s being by how many metres what a pixel shows lies to the right of the drive's first camera. Depth
is the field's, so that the light belongs to places on the street and moves through the picture with
them: a matrix of colours, the same for a whole picture, does not say it. It is no sunset: shadows
of noon stay where they were and no lamp is lit.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera
from rfcore.dataset import read_dataset
from rfcore.dataset.read import read_source
from rfcore.dataset.source import SourceCamera
from rfcore.dataset.write import WrittenPicture, write_transforms
from rfcore.field import RadianceField, render_field_view
from rfcore.image import Rgb, write_png

__all__ = ["SHADOW", "TINT", "WIDTH_M", "at_dusk", "write_dusk"]

F32 = NDArray[np.float32]
TINT = (0.2, 0.22, 0.32)
"""Of noon's red, green and blue light."""
SHADOW = 0.3
"""Share of it far to the left; far to the right it is 1 more."""
WIDTH_M = 3.0
"""How wide the border between the two is."""
FAR_M = 1000.0
"""Where the field shows nothing: the sky."""


def write_dusk(drive: Path, field: RadianceField, folder: Path) -> Path:
    """Write the drive's pictures at dusk as a dataset in ``folder``; return its transforms file.

    Raises ``DatasetError`` for a drive that cannot be read.
    """
    source = read_source(drive)
    posed = read_dataset(drive, tile_origin=field.metadata.tile_origin).pictures
    folder.mkdir(parents=True)
    right = _right_of(posed[0].camera)
    written = []
    for number, (taken, picture) in enumerate(zip(source.pictures, posed, strict=True)):
        depth_m = render_field_view(field, picture.camera).depth
        name = f"{number:03d}.png"
        write_png(folder / name, at_dusk(picture.read(), depth_m, picture.camera, right))
        camera = SourceCamera(picture.camera.intrinsics)
        written.append(WrittenPicture(name, camera, taken.world_from_cam, taken.time_ns))
    write_transforms(folder, written, None)
    return folder / "transforms.json"


def at_dusk(rgb: Rgb, depth_m: F32, camera: Camera, right: tuple[F32, float]) -> Rgb:
    """Return a noon picture, uint8 [H, W, 3], in the light of dusk.

    ``depth_m`` [H, W]: z, 0 where nothing is; ``right``: a direction in the world and the metres
    along it at which s is 0.
    """
    direction, origin_m = right
    side_m = _points(depth_m, camera) @ direction - np.float32(origin_m)
    share = np.float32(SHADOW) + 1 / (1 + np.exp(-np.clip(side_m / WIDTH_M, -30, 30)))
    return _displayed(_linear(rgb) * share[..., None] * np.array(TINT, np.float32))


def _right_of(camera: Camera) -> tuple[F32, float]:
    rotation = np.array(camera.world_from_cam.rotation_matrix(), np.float32)
    direction = rotation[:, 0]
    return direction, float(np.array(camera.world_from_cam.translation_m, np.float32) @ direction)


def _points(depth_m: F32, camera: Camera) -> F32:
    """Return what each pixel shows, [H, W, 3] in the world."""
    k, pose = camera.intrinsics, camera.world_from_cam
    z = np.where(depth_m > 0, depth_m, np.float32(FAR_M))
    x = (np.arange(k.width_px, dtype=np.float32) + 0.5 - k.cx_px) / k.fx_px
    y = (np.arange(k.height_px, dtype=np.float32) + 0.5 - k.cy_px) / k.fy_px
    in_camera = np.stack([x[None] * z, y[:, None] * z, z], axis=-1)
    rotation = np.array(pose.rotation_matrix(), np.float32)
    return np.asarray(in_camera @ rotation.T + np.array(pose.translation_m, np.float32), np.float32)


def _linear(rgb: Rgb) -> F32:
    shown = np.arange(256, dtype=np.float32) / 255
    linear = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    return np.asarray(linear, np.float32)[rgb]


def _displayed(linear: F32) -> Rgb:
    inside = np.clip(linear, 0, 1)
    shown = np.where(inside <= 0.0031308, 12.92 * inside, 1.055 * inside ** (1 / 2.4) - 0.055)
    return np.floor(shown * 255 + 0.5).astype(np.uint8)
