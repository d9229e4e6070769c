"""Contents of a dataset as a reader finds them on disk: cameras, pictures, points.

Poses are world_from_cam with OpenCV camera axes, float64, in the dataset's own world; pictures have
the lens they were taken with. ``rfcore.dataset.assemble`` makes a ``Dataset`` of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Intrinsics, Pose
from rfcore.errors import DatasetError, FieldFormatError, InvalidInput
from rfcore.field.ply_table import Table, read_vertices
from rfcore.geodesy import Anchor
from rfcore.image import Rgb
from rfcore.lens import Lens
from rfcore.views import Mask


@dataclass(frozen=True)
class SourceCamera:
    """Intrinsics and, where the pictures are distorted, the lens."""

    intrinsics: Intrinsics
    lens: Lens | None = None


@dataclass(frozen=True)
class SourcePicture:
    """A picture as it was taken. ``where`` is the place in the file that names it, for errors.

    ``mask`` returns bool [H, W]: which pixels are learnt and measured. ``notes`` says what reading
    does to the picture.
    """

    where: str
    name: str
    camera: SourceCamera
    world_from_cam: Pose
    read: Callable[[], Rgb]
    time_ns: int | None = None
    mask: Callable[[], Mask] | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class SourcePoints:
    """Surface points in the dataset's world: ``xyz_m`` float64 [N, 3], ``rgb`` uint8 [N, 3].

    ``note`` says what was done to them to be so.
    """

    xyz_m: NDArray[np.float64]
    rgb: NDArray[np.uint8]
    note: str = ""

    def __post_init__(self) -> None:
        n = len(self.xyz_m)
        if self.xyz_m.shape != (n, 3) or self.rgb.shape != (n, 3):
            raise InvalidInput(
                "points", f"shapes {self.xyz_m.shape} and {self.rgb.shape} must both be [N, 3]"
            )
        if not np.isfinite(self.xyz_m).all():
            bad = int((~np.isfinite(self.xyz_m)).any(axis=1).sum())
            raise InvalidInput("points.xyz_m", f"{bad} of {n} points are not finite")


@dataclass(frozen=True)
class Source:
    """Everything one reader found.

    ``file`` is the one that describes it. ``sorted_out`` counts pictures that are listed but were
    deleted on purpose, by the rules of the format. ``exposure_varies`` is true where the dataset
    says that the camera chose exposure or white balance anew for each picture. ``anchor`` says
    where on the Earth its world is, if the dataset does. ``notes`` says in a line each what the
    reader chose or left out. ``feeds`` has lines of pose feeds by the topic they were recorded on.
    """

    file: Path
    pictures: tuple[SourcePicture, ...]
    points: SourcePoints | None = None
    sorted_out: int = 0
    exposure_varies: bool = False
    anchor: Anchor | None = None
    notes: tuple[str, ...] = ()
    feeds: Mapping[str, Sequence[str]] = field(default_factory=dict)


COLOURS = [
    tuple(f"{prefix}{name}" for name in ("red", "green", "blue")) for prefix in ("", "diffuse_")
]
"""Names of the properties that hold colours."""
GREY = 128
FULL = {"u1": 255, "u2": 65_535, "f4": 1, "f8": 1}
"""The value of white, by the type of the property; floats above 1 are 0..255."""


def read_points(path: Path) -> SourcePoints:
    """Read x, y, z in metres and the colour of every finite vertex; grey where it has none.

    Raises ``DatasetError`` naming the file.
    """
    try:
        table = read_vertices(path, ("x", "y", "z"))
        xyz_m = np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=1)
        rgb, note = _rgb(path, table)
        is_finite = np.isfinite(xyz_m).all(axis=1)
        if not is_finite.all():
            bad = int((~is_finite).sum())
            said = f"{path}: {bad} of {len(xyz_m)} points are not finite and left out"
            note = f"{note}; {said}" if note else said
        return SourcePoints(xyz_m[is_finite], rgb[is_finite], note)
    except (FieldFormatError, InvalidInput) as error:
        raise DatasetError(f"points of {path}: {error}") from error


def _rgb(path: Path, table: Table) -> tuple[NDArray[np.uint8], str]:
    """Return colours 0..255, and a note where they were not stated so."""
    present = set(table.dtype.names or ())
    names = next((names for names in COLOURS if set(names) <= present), None)
    if names is None:
        return np.full((len(table), 3), GREY, np.uint8), f"{path} has no colours: points are grey"
    colours = np.stack([table[name] for name in names], axis=1)
    kind = colours.dtype.str[1:]
    if kind == "u1":
        return colours, ""
    if kind not in FULL:
        raise DatasetError(f"points of {path}: colours of type {kind}; they must be uchar, 0..255")
    full = 255 if kind in ("f4", "f8") and colours.max(initial=0) > 1 else FULL[kind]
    bytes_ = np.clip(np.nan_to_num(colours.astype(np.float64)) * (255 / full) + 0.5, 0, 255)
    return bytes_.astype(np.uint8), f"{path}: colours of type {kind} are taken as 0..{full}"
