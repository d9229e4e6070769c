"""A field seen from viewpoints: along a drive, around it, or from its middle.

An orbit and a look around need no given cameras. A field's box reaches as far as its sky; its
middle is therefore the median of its splats, and its radius the distance that three quarters of
them lie within.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfcore.field import Quality, RadianceField, SplatField
from rfcore.image import Rgb, rgb_from_colour, write_png
from rfcore.metrics import psnr
from rfcore.views import PosedPicture

F64 = NDArray[np.float64]
UPS = {"z": (0.0, 0.0, 1.0), "y": (0.0, 1.0, 0.0), "-y": (0.0, -1.0, 0.0)}
"""Up in ENU, in OpenGL's world, and in the world of OpenCV and most COLMAP models."""
FIELD_OF_VIEW_RAD = math.radians(75)
ELEVATION_RAD = math.radians(25)
"""Height of an orbit above the horizon of its middle."""
DISTANCE = 1.5
"""Distance of an orbit from its middle, in units of the field's radius."""


@dataclass(frozen=True)
class OrbitSettings:
    """Once around the middle, looking at it from above."""

    frames: int = 96
    width_px: int = 960
    height_px: int = 540
    up: str = "z"

    def __post_init__(self) -> None:
        if not 1 <= self.frames <= 100_000:
            raise InvalidInput("frames", f"{self.frames} is outside 1..100000")
        if self.up not in UPS:
            raise InvalidInput("up", f"'{self.up}' is none of {', '.join(UPS)}")


def orbit(field: RadianceField, settings: OrbitSettings) -> list[Camera]:
    """Return the cameras of one turn around the field."""
    middle, radius_m = middle_of(field)
    up = np.array(UPS[settings.up])
    east, north = _across(up)
    intrinsics = _intrinsics(settings.width_px, settings.height_px)
    rise, reach = math.sin(ELEVATION_RAD), math.cos(ELEVATION_RAD)
    cameras = []
    for turn_rad in np.linspace(0, 2 * math.pi, settings.frames, endpoint=False):
        outward = reach * (math.cos(turn_rad) * east + math.sin(turn_rad) * north) + rise * up
        eye = middle + DISTANCE * radius_m * outward
        cameras.append(Camera(intrinsics, looking_at(eye, middle, up)))
    return cameras


def look_around(field: RadianceField, width_px: int, height_px: int) -> list[Camera]:
    """Return four cameras in the middle of the field, a quarter turn apart, z being up."""
    middle, radius_m = middle_of(field)
    up = np.array(UPS["z"])
    east, north = _across(up)
    intrinsics = _intrinsics(width_px, height_px)
    return [
        Camera(intrinsics, looking_at(middle, middle + radius_m * way, up))
        for way in (east, north, -east, -north)
    ]


def looking_at(eye: F64, target: F64, up: F64) -> Pose:
    """Return ``world_from_cam`` (x right, y down, z forward) at ``eye`` looking at ``target``."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(forward, right), forward, eye], axis=1)
    return Pose.from_matrix(axes.tolist())


def _intrinsics(width_px: int, height_px: int) -> Intrinsics:
    focal_px = width_px / 2 / math.tan(FIELD_OF_VIEW_RAD / 2)
    return Intrinsics(width_px, height_px, focal_px, focal_px, width_px / 2, height_px / 2)


def middle_of(field: RadianceField) -> tuple[F64, float]:
    """Return where the field is and its radius in metres, at least a millimetre."""
    if isinstance(field, SplatField) and len(field.gaussians):
        means = field.gaussians.means.astype(np.float64)
        middle = np.median(means, axis=0)
        radius_m = float(np.quantile(np.linalg.norm(means - middle, axis=1), 0.75))
    else:
        low, high = np.array(field.bounds.low_m), np.array(field.bounds.high_m)
        middle, radius_m = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    return middle, max(radius_m, 1e-3)


def _across(up: F64) -> tuple[F64, F64]:
    """Return two directions that make a right-handed frame with ``up``."""
    east = np.array([1.0, 0.0, 0.0])
    return east, np.cross(up, east)


@dataclass(frozen=True)
class Viewpoint:
    """A camera that a field is rendered for; ``seen`` is the picture a real one took there."""

    name: str
    camera: Camera
    seen: PosedPicture | None = None


def orbit_viewpoints(field: RadianceField, settings: OrbitSettings) -> list[Viewpoint]:
    """Return the viewpoints of one turn around the field."""
    cameras = orbit(field, settings)
    return [Viewpoint(f"{number:05d}", camera) for number, camera in enumerate(cameras)]


def drive_viewpoints(pictures: Iterable[PosedPicture]) -> list[Viewpoint]:
    """Return the viewpoints of a drive, named as its pictures."""
    return [Viewpoint(Path(p.name).stem, p.camera, p) for p in pictures]


def pictures_along(
    field: RadianceField, viewpoints: Iterable[Viewpoint], quality: Quality
) -> Iterator[tuple[Viewpoint, Rgb]]:
    """Yield what the field shows at each viewpoint."""
    for viewpoint in viewpoints:
        yield viewpoint, rgb_from_colour(field.render_colour(viewpoint.camera, quality))


def compared(
    pictures: Iterable[tuple[Viewpoint, Rgb]], psnr_db: list[float]
) -> Iterator[tuple[Viewpoint, Rgb]]:
    """Pass pictures through, and append the PSNR of each against what the camera saw there."""
    for viewpoint, rgb in pictures:
        if viewpoint.seen is not None:
            psnr_db.append(psnr(rgb, viewpoint.seen.read()))
        yield viewpoint, rgb


def write_pictures(
    folder: Path, pictures: Iterable[tuple[Viewpoint, Rgb]], psnr_db: Sequence[float] = ()
) -> None:
    """Write PNG files and print their names, with ``psnr_db`` if ``compared`` fills it."""
    folder.mkdir(parents=True, exist_ok=True)
    for viewpoint, rgb in pictures:
        path = folder / f"{viewpoint.name}.png"
        write_png(path, rgb)
        print(f"{path}  {psnr_db[-1]:.2f} dB" if psnr_db else path)
