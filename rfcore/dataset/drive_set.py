"""Drives of public sets: cameras on a vehicle (ego) whose poses are known over time.

A set has a name for each drive of one camera: ``CAMERA``, or ``SCENE/CAMERA`` where several drives
lie together. ``PATH#NAME`` chooses one; nothing is chosen among several. A picture's pose is the
vehicle's at its time of capture, interpolated between two poses within a second
(``rfcore.motion``) and never extrapolated, after the camera's mounting: ``world_from_ego`` and
``ego_from_cam``. Pictures without one are left out, which is said.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from rfcore.camera import Intrinsics, Pose
from rfcore.dataset.bag_transforms import NS, Edge
from rfcore.dataset.keys import blamed_on
from rfcore.dataset.picture_file import PictureFile
from rfcore.dataset.source import Source, SourceCamera, SourcePicture
from rfcore.errors import DatasetError, named
from rfcore.image import Rgb
from rfcore.views import Mask

US = 1000
"""Nanoseconds of a microsecond."""
MAX_GAP_NS = NS
"""Poses further apart are not interpolated."""


class DriveSet(Protocol):
    """A set on disk; ``file`` is the one by which it is recognised."""

    @property
    def file(self) -> Path: ...

    @property
    def names(self) -> Sequence[str]:
        """Names of the drives, each of one camera."""

    def read(self, name: str) -> Source:
        """Read one of ``names``; raise ``DatasetError`` naming file and row."""


def names_below(drives: DriveSet, wanted: str) -> list[str]:
    """Return the drives that are called ``wanted``, or are of a scene called so; all for ""."""
    return [n for n in drives.names if not wanted or n == wanted or n.startswith(f"{wanted}/")]


def read_chosen(drives: DriveSet, path: Path, wanted: str) -> Source:
    """Read the drive that ``path#wanted`` names; raise ``DatasetError`` for none and several."""
    found = names_below(drives, wanted)
    if not found:
        there = named(drives.names, "none")
        asked = f"no '{wanted}'" if wanted else "no camera"
        raise DatasetError(f"{path}: has {asked}; its cameras: {there}")
    if len(found) > 1:
        example = shlex.quote(f"{path}#{found[0]}")
        raise DatasetError(
            f"{path}: holds several cameras ({named(found, 'none')}): name one, {example}"
        )
    return drives.read(found[0])


@dataclass(frozen=True)
class Shot:
    """A picture before its pose is known. ``where`` is the place that names it, for errors."""

    where: str
    name: str
    time_ns: int
    camera: SourceCamera
    ego_from_cam: Pose
    read: Callable[[], Rgb]
    mask: Callable[[], Mask] | None = None
    notes: tuple[str, ...] = ()

    @staticmethod
    def of_file(path: Path, time_ns: int, camera: SourceCamera, ego_from_cam: Pose) -> Shot:
        """Return the shot of a picture file."""
        opened = PictureFile.of(path, camera.intrinsics)
        return Shot(
            where=str(path),
            name=path.name,
            time_ns=time_ns,
            camera=camera,
            ego_from_cam=ego_from_cam,
            read=opened.read,
            mask=opened.mask,
            notes=opened.notes,
        )

    def at(self, world_from_ego: Pose) -> SourcePicture:
        """Return the picture where the vehicle was."""
        return SourcePicture(
            where=self.where,
            name=self.name,
            camera=self.camera,
            world_from_cam=world_from_ego.compose(self.ego_from_cam),
            read=self.read,
            time_ns=self.time_ns,
            mask=self.mask,
            notes=self.notes,
        )


def posed_source(file: Path, shots: Sequence[Shot], ego: Edge, notes: Sequence[str]) -> Source:
    """Return the pictures in order of time, each where ``ego`` was then.

    Raises ``DatasetError`` when none has a pose.
    """
    pictures, left_out, between = [], [], 0
    for shot in sorted(shots, key=lambda shot: shot.time_ns):
        world_from_ego = ego.at(shot.time_ns, MAX_GAP_NS)
        if world_from_ego is None:
            left_out.append(shot)
            continue
        between += shot.time_ns not in ego.samples
        pictures.append(shot.at(world_from_ego))
    said = list(notes)
    if between:
        said.append(f"poses of {between} of {len(pictures)} pictures are interpolated in time")
    if left_out:
        first_s, last_s = (shot.time_ns / NS for shot in (left_out[0], left_out[-1]))
        span = "at no time"
        if ego.samples:
            span = f"from {min(ego.samples) / NS:.3f} to {max(ego.samples) / NS:.3f} s"
        problem = (
            f"{len(left_out)} of {len(shots)} pictures, from {first_s:.3f} to {last_s:.3f} s, have "
            f"no pose of the vehicle within 1 s; {ego.topic} has poses {span}"
        )
        if not pictures:
            raise DatasetError(f"{file}: {problem}; take poses and pictures of the same drive")
        said.append(f"{problem}: left out")
    return Source(file, tuple(pictures), notes=tuple(said))


def pinhole_of_matrix(
    where: str, rows: Sequence[Sequence[float]], size_px: tuple[int, int]
) -> SourceCamera:
    """Return the camera of the matrix K, in rows of 3 numbers or more; refuse anything else.

    Further numbers, a shift of the camera in a projection matrix, must be 0.
    """
    (fx_px, skew, cx_px, *a), (below, fy_px, cy_px, *b), last = rows[:3]
    if skew or below or any((*a, *b)) or list(last[:3]) != [0, 0, 1] or any(last[3:]):
        raise DatasetError(f"{where}: {rows} is not the matrix of a pinhole without skew")
    with blamed_on(where):
        return SourceCamera(Intrinsics(*size_px, fx_px, fy_px, cx_px, cy_px))
