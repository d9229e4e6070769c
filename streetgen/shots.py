"""List the pictures that a scene consists of as posed shots, and select some of them.

* ``drive``: the moving camera at the full rate; lower rates are every n-th frame of it.
* ``train``: cars with the camera rig pass through the street, alternately in both directions; at
  each of ``views`` places the next camera of the rig takes one picture.
* ``rig``: several cameras of the car that takes the drive, all at each instant; only if asked for.
* ``eval``: all cameras of the rig at ``stations`` between the places of ``train``.
"""

from __future__ import annotations

import re
import zlib
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.dataset.rig import RIG, mounts_named
from rfcore.errors import InvalidInput
from streetgen.geometry.layout import Layout
from streetgen.scene_file import Scene
from streetgen.trajectory import (
    CameraMotion,
    drive_motion,
    drive_pose,
    mounted,
    on_lane,
    rig_motion,
    rig_pose,
)

ENDS_M = 14.0
"""Distance that cars keep from the ends of the facades."""
STRIDE = 7
"""Step between the rig cameras taken one after the other; coprime to their number, 18."""
AHEAD_M, ASIDE_M, TURN_RAD = 0.3, 0.3, 0.03
STANDING = CameraMotion((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


class Split(StrEnum):
    """A part of the dataset; also its folder."""

    DRIVE = "drive"
    TRAIN = "train"
    EVAL = "eval"
    RIG = "rig"


@dataclass(frozen=True)
class Shot:
    """A picture to take."""

    split: Split
    index: int
    camera: Camera
    time_s: float = 0.0
    motion: CameraMotion = STANDING

    @property
    def name(self) -> str:
        """Its number in the folder."""
        return f"{self.index:06d}"

    @property
    def number(self) -> int:
        """A number that no shot of another split has, for what is random in each picture."""
        return self.index + 1_000_000 * list(Split).index(self.split)


def shots_of(scene: Scene, split: Split, size_px: tuple[int, int] | None = None) -> list[Shot]:
    """Return a split's shots, at ``size_px`` or the size that the scene names."""
    if split is Split.DRIVE:
        k = _intrinsics(size_px or scene.drive.size_px, scene.rig.fov_deg)
        return [_drive_shot(scene, i, k) for i in range(scene.drive.frames)]
    if split is Split.RIG:
        return _rig_shots(scene, _intrinsics(size_px or scene.drive.size_px, scene.rig.fov_deg))
    settings, poses = (
        (scene.train, _train_poses(scene))
        if split is Split.TRAIN
        else (scene.evaluation, _evaluation_poses(scene))
    )
    k = _intrinsics(size_px or settings.size_px, scene.rig.fov_deg)
    return [Shot(split, i, Camera(k, pose)) for i, pose in enumerate(poses)]


def thinned_indices(scene: Scene, rate_hz: float) -> range:
    """Return which frames of the drive a lower rate keeps."""
    return range(0, scene.drive.frames, round(scene.drive.rate_hz / rate_hz))


def _intrinsics(size_px: tuple[int, int], fov_deg: float) -> Intrinsics:
    width, height = size_px
    focal_px = width / (2 * float(np.tan(np.radians(fov_deg) / 2)))
    return Intrinsics(width, height, focal_px, focal_px, width / 2, height / 2)


def _drive_shot(scene: Scene, index: int, intrinsics: Intrinsics) -> Shot:
    time_s = index / scene.drive.rate_hz
    return Shot(
        split=Split.DRIVE,
        index=index,
        camera=Camera(intrinsics, drive_pose(scene.drive, time_s)),
        time_s=time_s,
        motion=drive_motion(scene.drive, time_s),
    )


def _rig_shots(scene: Scene, intrinsics: Intrinsics) -> list[Shot]:
    """Return the rig's shots, instant by instant, in the order of the cameras."""
    drive, mounts = scene.drive, mounts_named(scene.drive.rig)
    moments = [(i / drive.rate_hz, mount) for i in range(drive.frames) for mount in mounts]
    return [
        Shot(
            split=Split.RIG,
            index=index,
            camera=Camera(intrinsics, rig_pose(drive, mount, time_s)),
            time_s=time_s,
            motion=rig_motion(drive, mount, time_s),
        )
        for index, (time_s, mount) in enumerate(moments)
    ]


def _train_poses(scene: Scene) -> list[Pose]:
    rng = np.random.default_rng([scene.geometry.seed, zlib.crc32(b"train")])
    mounts = RIG[: scene.rig.cameras]
    poses = []
    for i, x_m in enumerate(_places(scene, scene.train.views)):
        ahead, left, turn = rng.uniform(-1, 1, 3) * (AHEAD_M, ASIDE_M, TURN_RAD)
        place, heading = on_lane(x_m + ahead, _direction(scene, i), left)
        mount = mounts[i // _directions(scene) * STRIDE % len(mounts)]
        poses.append(mounted(mount, place, heading + turn))
    return poses


def _evaluation_poses(scene: Scene) -> list[Pose]:
    poses = []
    for i, x_m in enumerate(_places(scene, scene.evaluation.stations)):
        place, heading = on_lane(x_m, _direction(scene, i), 0.0)
        poses += [mounted(mount, place, heading) for mount in RIG[: scene.rig.cameras]]
    return poses


def _places(scene: Scene, count: int) -> list[float]:
    """Return the middles of ``count`` equal stretches of the street."""
    layout = Layout(scene.geometry)
    ends = np.linspace(layout.start_m + ENDS_M, layout.end_m - ENDS_M, count + 1)
    return ((ends[1:] + ends[:-1]) / 2).tolist()  # type: ignore[no-any-return]


def _directions(scene: Scene) -> int:
    return 2 if scene.rig.directions == "both" else 1


def _direction(scene: Scene, index: int) -> int:
    return -1 if _directions(scene) == 2 and index % 2 else 1


@dataclass(frozen=True)
class Selection:
    """``splits`` and ``frames`` as the command line has them; raises ``InvalidInput``."""

    scene: Scene
    splits: str = "default"
    frames: str | None = None
    size_px: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        self.shots()

    def shots(self) -> list[Shot]:
        """Return the chosen shots in the order in which they are taken."""
        every = [
            shot for split in self._splits() for shot in shots_of(self.scene, split, self.size_px)
        ]
        chosen = every[self._slice(len(every))]
        if not chosen:
            raise InvalidInput("frames", f"'{self.frames}' leaves none of {len(every)} frames")
        return chosen

    def _splits(self) -> list[Split]:
        if self.splits == "all":
            return [split for split in Split if split is not Split.RIG]
        if self.splits == "default":
            own_field = self.scene.field == self.scene.name
            usual = (Split.DRIVE, Split.TRAIN, Split.EVAL)
            return [split for split in usual if own_field or split is not Split.TRAIN]
        names = self.splits.split(",")
        for name in names:
            if name not in list(Split):
                known = ", ".join(Split)
                raise InvalidInput("split", f"'{name}' is none of {known} and all")
        return [split for split in Split if split in names]

    def _slice(self, count: int) -> slice:
        if self.frames is None:
            return slice(None)
        match = re.fullmatch(r"(\d{0,9}):(\d{0,9})", self.frames, re.ASCII)
        if match is None:
            raise InvalidInput("frames", f"'{self.frames}' is not a:b, such as 0:8")
        return slice(int(match[1] or 0), int(match[2] or count))
