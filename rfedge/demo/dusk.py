"""A drive at dusk, made of a drive at noon: the same pictures under a declared light.

The sample has no pictures of an evening; ``streetgen build street-dusk`` renders some. Without
them, the linear light of each noon picture (sRGB's curve undone, IEC 61966-2-1) is multiplied by

    TINT * (SHADOW + 1 / (1 + exp(-s / WIDTH_M))) + LAMP * sum of 1 / (1 + (d / REACH_M)^4),

s being by how many metres what a pixel shows lies to the right of the drive's first camera, and d
how far it is from a street lamp. Depth is the field's, so that the light belongs to places on the
street and moves through the picture with them: neither a matrix of colours, the same for a whole
picture, nor a grid of cells of the picture, says it as colours of the street do. Lamps stand on
alternate sides of the way, every ``LAMPS_M``. It is no sunset: shadows of noon stay where they
were, and lamps cast none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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

__all__ = ["LAMP", "LAMPS_M", "REACH_M", "SHADOW", "TINT", "DuskLight", "at_dusk", "write_dusk"]

F32 = NDArray[np.float32]
TINT = (0.2, 0.22, 0.32)
"""Of noon's red, green and blue light."""
SHADOW = 0.3
"""Share of it far to the left; far to the right it is 1 more."""
WIDTH_M = 3.0
"""How wide the border between the two is."""
LAMP = (0.9, 0.6, 0.25)
"""Of noon's light, at a lamp."""
REACH_M = 2.5
"""Where a lamp's light is half of that."""
LAMPS_M = 6.0
"""From one lamp to the next, along the way of the first camera."""
BESIDE_M, ABOVE_M = 3.0, 0.5
"""Where lamps hang, from the way of the first camera."""
BEYOND_M = 40.0
"""How far they go on behind the last camera."""
FAR_M = 1000.0
"""Where the field shows nothing: the sky."""


@dataclass(frozen=True, eq=False)
class DuskLight:
    """Where the light of dusk comes from: s is 0 at ``origin_m`` along ``right``, a unit vector of
    the world, float32 [3]; ``lamps_m``, float32 [N, 3], are in the world."""

    right: F32
    origin_m: float
    lamps_m: F32

    @classmethod
    def along(cls, cameras: Sequence[Camera]) -> DuskLight:
        """Return the light of a drive: lamps from its first camera to beyond its last."""
        first, last = (
            np.array(camera.world_from_cam.translation_m, np.float32)
            for camera in (cameras[0], cameras[-1])
        )
        right, down, ahead = np.array(cameras[0].world_from_cam.rotation_matrix(), np.float32).T
        way_m = max(float((last - first) @ ahead), 0.0) + BEYOND_M
        along_m = np.arange(LAMPS_M, way_m, LAMPS_M, dtype=np.float32)
        side_m = BESIDE_M * (-1.0) ** np.arange(len(along_m), dtype=np.float32)
        lamps = first + along_m[:, None] * ahead + side_m[:, None] * right - ABOVE_M * down
        return cls(right, float(first @ right), np.asarray(lamps, np.float32))

    def on(self, points_m: F32) -> F32:
        """Return the share of noon's linear light that reaches points [..., 3] of the world."""
        side_m = points_m @ self.right - np.float32(self.origin_m)
        share = np.float32(SHADOW) + 1 / (1 + np.exp(-np.clip(side_m / WIDTH_M, -30, 30)))
        lit = np.zeros_like(side_m)
        for lamp_m in self.lamps_m:
            away = ((points_m - lamp_m) ** 2).sum(axis=-1) / np.float32(REACH_M**2)
            lit += 1 / (1 + away * away)
        tint, lamp = (np.array(colour, np.float32) for colour in (TINT, LAMP))
        return np.asarray(share[..., None] * tint + lit[..., None] * lamp, np.float32)


def write_dusk(drive: Path, field: RadianceField, folder: Path) -> Path:
    """Write the drive's pictures at dusk as a dataset in ``folder``; return its transforms file.

    Raises ``DatasetError`` for a drive that cannot be read.
    """
    source = read_source(drive)
    posed = read_dataset(drive, tile_origin=field.metadata.tile_origin).pictures
    folder.mkdir(parents=True)
    light = DuskLight.along([picture.camera for picture in posed])
    written = []
    for number, (taken, picture) in enumerate(zip(source.pictures, posed, strict=True)):
        depth_m = render_field_view(field, picture.camera).depth
        name = f"{number:03d}.png"
        write_png(folder / name, at_dusk(picture.read(), depth_m, picture.camera, light))
        camera = SourceCamera(picture.camera.intrinsics)
        written.append(WrittenPicture(name, camera, taken.world_from_cam, taken.time_ns))
    write_transforms(folder, written, None)
    return folder / "transforms.json"


def at_dusk(rgb: Rgb, depth_m: F32, camera: Camera, light: DuskLight) -> Rgb:
    """Return a noon picture, uint8 [H, W, 3], in the light of dusk; ``depth_m`` [H, W]: z, 0 where
    nothing is."""
    return _displayed(_linear(rgb) * light.on(_points(depth_m, camera)))


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
