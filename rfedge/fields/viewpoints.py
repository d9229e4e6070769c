"""A field seen from viewpoints: along a drive, around it, or from its middle.

An orbit and a look around need no given cameras. A field says where some of its training cameras
stood (``Sight``). Where these look at one point, an orbit goes about that, among them: all around
if they stand all around, else to and fro. Of another field, as of a street, it goes around the
whole, or to and fro behind cameras that look one way. A field's box reaches as far as its sky; its
middle is therefore the median of its splats, and its radius the distance that three quarters of
them lie within.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rfcore.camera import Camera, Intrinsics, Pose, Vec3
from rfcore.errors import InvalidInput
from rfcore.field import Quality, RadianceField, SplatField
from rfcore.image import Rgb, rgb_from_colour, write_png
from rfcore.metrics import psnr
from rfcore.vertical import Sight, seen_point, upright_from
from rfcore.views import PosedPicture

F64 = NDArray[np.float64]
UPS = {"z": (0.0, 0.0, 1.0), "y": (0.0, 1.0, 0.0), "-y": (0.0, -1.0, 0.0)}
"""Up in ENU, in OpenGL's world, and in the world of OpenCV and most COLMAP models."""
GAP_RAD = math.radians(100)
"""Cameras with a larger gap between them do not stand all around."""
SWING = 0.5
"""Share of the cameras' elevations that an orbit to and fro between them goes through."""
ONE_WAY, BEHIND_RAD = 0.5, math.radians(20)
"""Length of the mean of the cameras' axes from which they look one way, and how far to both sides
an orbit goes behind such cameras."""
FIELD_OF_VIEW_RAD = math.radians(75)
ELEVATION_RAD = math.radians(25)
"""Height of an orbit above the horizon of its middle."""
DISTANCE = 1.5
"""Distance of an orbit from its middle, in units of the field's radius."""


@dataclass(frozen=True)
class OrbitSettings:
    """One turn; ``up``: a key of ``UPS``, None for the field's own vertical. ``centre_m`` and
    ``radius_m``, the cameras' distance from it: None for those that the field suggests."""

    frames: int = 96
    width_px: int = 960
    height_px: int = 540
    up: str | None = None
    centre_m: Vec3 | None = None
    radius_m: float | None = None

    def __post_init__(self) -> None:
        if not 1 <= self.frames <= 100_000:
            raise InvalidInput("frames", f"{self.frames} is outside 1..100000")
        if self.up is not None:
            check_up(self.up)
        if self.centre_m is not None and not all(map(math.isfinite, self.centre_m)):
            raise InvalidInput("centre", f"{self.centre_m} must be finite")
        if self.radius_m is not None and not 1e-3 <= self.radius_m <= 1e6:
            raise InvalidInput("radius", f"{self.radius_m:g} m is outside 0.001..1000000 m")


def check_up(name: str) -> None:
    """Raise ``InvalidInput`` unless ``name`` is a key of ``UPS``."""
    if name not in UPS:
        raise InvalidInput("up", f"'{name}' is none of {', '.join(UPS)}")


def vertical(field: RadianceField, up: str | None) -> Vec3:
    """Return the direction that ``up`` names, or the field's own vertical."""
    return field.metadata.vertical if up is None else UPS[up]


@dataclass(frozen=True)
class Orbit:
    """The cameras of one turn, the point that they look at, and their distance from it."""

    centre_m: F64
    radius_m: float
    cameras: list[Camera]


def orbit(field: RadianceField, settings: OrbitSettings) -> Orbit:
    """Return one turn around what the field shows, or around a given centre."""
    up = vertical(field, settings.up)
    turns_rad = np.linspace(0, 2 * math.pi, settings.frames, endpoint=False)
    sights, given = field.metadata.sights, settings.centre_m
    middle = seen_point(sights)
    if middle is not None:
        middle = middle if given is None else np.array(given)
        towards, radius_m = _among(sights, middle, up, turns_rad)
    else:
        middle, reach_m = middle_of(field)
        middle = middle if given is None else np.array(given)
        towards, radius_m = _about(sights, up, turns_rad), DISTANCE * reach_m
    radius_m = settings.radius_m or radius_m
    intrinsics = _intrinsics(settings.width_px, settings.height_px)
    cameras = [
        Camera(intrinsics, looking_at(middle + radius_m * way, middle, np.array(up)))
        for way in towards
    ]
    return Orbit(middle, radius_m, cameras)


def _among(sights: Sequence[Sight], middle: F64, up: Vec3, turns_rad: F64) -> tuple[F64, float]:
    """Return unit vectors [N, 3] from what cameras look at, between them, and their distance."""
    offsets = _upright([sight.eye_m for sight in sights] - middle, up)
    ranges_m = np.linalg.norm(offsets, axis=1)
    elevations_rad = np.arcsin(offsets[:, 2] / np.maximum(ranges_m, 1e-9))
    azimuths_rad = np.sort(np.arctan2(offsets[:, 1], offsets[:, 0]))
    gaps_rad = np.diff(azimuths_rad, append=azimuths_rad[0] + 2 * math.pi)
    last = int(np.argmax(gaps_rad))
    level_rad = np.full(len(turns_rad), np.median(elevations_rad))
    if gaps_rad[last] < GAP_RAD:
        towards = _turned(azimuths_rad[0] + turns_rad, level_rad, up)
    else:
        half_rad = math.pi - gaps_rad[last] / 2
        rise_rad = SWING * float(np.ptp(elevations_rad)) / 2
        middle_rad = azimuths_rad[last] - half_rad, float(elevations_rad.mean())
        towards = _to_and_fro(middle_rad, (half_rad, rise_rad), up, turns_rad)
    return towards, float(np.median(ranges_m))


def _about(sights: Sequence[Sight], up: Vec3, turns_rad: F64) -> F64:
    """Return unit vectors [N, 3] towards the places of an orbit around a whole field: from all
    sides, or from behind cameras that all look one way, for nothing shows what is behind them."""
    ahead = _upright([sight.towards for sight in sights] or np.zeros((1, 3)), up).mean(axis=0)
    if np.linalg.norm(ahead) < ONE_WAY:
        return _turned(turns_rad, np.full(len(turns_rad), ELEVATION_RAD), up)
    middle_rad = math.atan2(-ahead[1], -ahead[0]), ELEVATION_RAD
    return _to_and_fro(middle_rad, (BEHIND_RAD, ELEVATION_RAD / 2), up, turns_rad)


def _to_and_fro(
    middle_rad: tuple[float, float], half_rad: tuple[float, float], up: Vec3, turns_rad: F64
) -> F64:
    """Return unit vectors [N, 3] on an ellipse; ``middle_rad`` and ``half_rad``: azimuth and
    elevation of its middle, and its half axes."""
    azimuths_rad = middle_rad[0] - half_rad[0] * np.cos(turns_rad)
    return _turned(azimuths_rad, middle_rad[1] + half_rad[1] * np.sin(turns_rad), up)


def _upright(vectors: ArrayLike, up: Vec3) -> F64:
    """Return vectors [N, 3] of the field's axes in the upright frame."""
    return np.asarray(np.array(vectors) @ np.array(upright_from(up).rotation_matrix()).T)


def _turned(azimuths_rad: F64, elevations_rad: F64, up: Vec3) -> F64:
    """Return unit vectors [N, 3] of directions in the upright frame, in the field's axes."""
    level = np.cos(elevations_rad)
    upright = level * np.cos(azimuths_rad), level * np.sin(azimuths_rad), np.sin(elevations_rad)
    return np.asarray(np.stack(upright, axis=1) @ np.array(upright_from(up).rotation_matrix()))


def look_around(field: RadianceField, width_px: int, height_px: int) -> list[Camera]:
    """Return four cameras in the middle of the field, level, a quarter turn apart."""
    middle, radius_m = middle_of(field)
    up = field.metadata.vertical
    intrinsics = _intrinsics(width_px, height_px)
    quarters = np.arange(4) * math.pi / 2
    return [
        Camera(intrinsics, looking_at(middle, middle + radius_m * way, np.array(up)))
        for way in _turned(quarters, np.zeros(4), up)
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


@dataclass(frozen=True)
class Viewpoint:
    """A camera that a field is rendered for; ``seen`` is the picture a real one took there."""

    name: str
    camera: Camera
    seen: PosedPicture | None = None


def orbit_viewpoints(field: RadianceField, settings: OrbitSettings) -> list[Viewpoint]:
    """Return the viewpoints of one turn around the field; say on stderr around what."""
    turn = orbit(field, settings)
    x, y, z = turn.centre_m
    print(
        f"orbit around {x:.2f} {y:.2f} {z:.2f} at {turn.radius_m:.2f} m (--centre, --radius)",
        file=sys.stderr,
    )
    return [Viewpoint(f"{number:05d}", camera) for number, camera in enumerate(turn.cameras)]


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
            seen = viewpoint.seen
            psnr_db.append(psnr(rgb, seen.read(), mask=seen.read_mask()))
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
