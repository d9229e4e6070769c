"""The rig file: which cameras a vehicle carries, where on it, and where their pictures come from.

::

    reference = "front"             # the camera whose poses place the rig; default: the first

    [[camera]]
    name = "front"
    drive = "front"                 # a dataset in time order, beside this file
    # or, of a camera that sends now:
    # source = "rtsp://10.0.0.2/front"      # as cav-agent --source
    # camera_file = "front/camera.toml"     # its size, intrinsics and lens (docs/how-to/data.md)
    camera_from_rig = [[0, -1, 0, 0], [0, 0, -1, 1.5], [1, 0, 0, 0]]   # extrinsics, 3x4 or 4x4
    priority = 1.0                  # weight of its quality in the division of bits, 0.1..10
    mask = "front_mask.png"         # where its frames are coded finer (as cav-agent --mask)

    [[camera]]
    name = "rear"
    ...

The rig's own axes are free; the camera's are OpenCV's. A drive states the intrinsics of its camera.
Picture i of every drive was taken at the same instant.

The 18 cameras of a car (``MOUNTS``) serve the CARLA recorder and streetgen: three rows of six,
whose heights, reach and tilts follow the published method's later recorder (Maftej/rfdvc).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rfcore.camera import Pose, TileOrigin, camera_on_rig
from rfcore.dataset.keys import POSE_SHAPES, load_toml, pose_of_rows, table_at
from rfcore.dataset.picture_name import inside
from rfcore.dataset.read import read_dataset
from rfcore.errors import DatasetError, InvalidInput
from rfcore.files import write_whole
from rfcore.tables import Range, Table
from rfcore.views import PosedPicture

RIG_FILE = "rig.toml"

MAX_RIG_CAMERAS = 32
"""Number of cameras that one Hello may name (``rfcore.wire.values.MAX_CAMERAS``)."""

FARTHEST_M = 100.0
"""A camera further from the rig's origin is on another vehicle."""

AGREE_M, AGREE_RAD = 0.1, math.radians(1.0)
"""Largest difference between a drive's pose and the one that extrinsics and reference give."""

KEYS = ("name", "drive", "source", "camera_file", "camera_from_rig", "priority", "mask")


@dataclass(frozen=True)
class RigCamera:
    """One camera: either ``drive`` or ``source`` with ``camera_file`` says what it sees."""

    name: str
    camera_from_rig: Pose
    drive: Path | None = None
    source: str | None = None
    camera_file: Path | None = None
    priority: float = 1.0
    mask: Path | None = None


@dataclass(frozen=True)
class Rig:
    """The cameras of a vehicle, the reference first."""

    cameras: tuple[RigCamera, ...]

    @property
    def reference(self) -> RigCamera:
        """The camera whose poses place the rig."""
        return self.cameras[0]

    @property
    def is_live(self) -> bool:
        """Whether the cameras send now; otherwise they are recorded drives."""
        return self.reference.source is not None


@dataclass(frozen=True)
class RigInstant:
    """The pictures of one instant by camera, each at the pose that ``world_from_rig`` gives it."""

    world_from_rig: Pose
    pictures: dict[str, PosedPicture]


def read_rig(path: Path) -> Rig:
    """Read a rig file, or the ``rig.toml`` of a folder.

    Raises ``DatasetError`` that names file, camera and key.
    """
    file = path / RIG_FILE if path.is_dir() else path
    top = table_at(str(file), load_toml(file))
    top.require_known(("reference", "camera"))
    entries = top.items("camera")
    if not 1 <= len(entries) <= MAX_RIG_CAMERAS:
        raise top.error("camera", f"has {len(entries)} cameras, outside 1..{MAX_RIG_CAMERAS}")
    cameras = tuple(_camera(file, i, values) for i, values in enumerate(entries))
    _check_names(file, cameras)
    if len({camera.source is None for camera in cameras}) > 1:
        raise DatasetError(f"{file}: cameras have either all a 'drive' or all a 'source'")
    name = top.choice("reference", [camera.name for camera in cameras], cameras[0].name)
    return Rig(tuple(sorted(cameras, key=lambda camera: camera.name != name)))


def _camera(file: Path, index: int, values: object) -> RigCamera:
    keys = table_at(f"{file}: [[camera]] {index}", values)
    name = keys.text("name")
    where = f"{file}: camera '{name}'"
    keys = table_at(where, values)
    keys.require_known(KEYS)
    if ("drive" in keys) == ("source" in keys):
        raise DatasetError(f"{where}: name either a 'drive' or a 'source'")
    if "source" in keys and "camera_file" not in keys:
        raise keys.error("camera_file", "is missing: a source needs a camera.toml")
    pose = pose_of_rows(where, "camera_from_rig", keys.matrix("camera_from_rig", POSE_SHAPES))
    if max(map(abs, pose.translation_m)) > FARTHEST_M:
        raise keys.error("camera_from_rig", f"is beyond {FARTHEST_M:g} m from the rig's origin")
    return RigCamera(
        name=name,
        camera_from_rig=pose,
        drive=_path(where, file, keys, "drive"),
        source=keys.text("source") if "source" in keys else None,
        camera_file=_path(where, file, keys, "camera_file"),
        priority=keys.number("priority", Range(0.1, 10.0), 1.0),
        mask=_path(where, file, keys, "mask"),
    )


def _path(where: str, file: Path, keys: Table, key: str) -> Path | None:
    return inside(where, file.parent, keys.text(key)) if key in keys else None


def _check_names(file: Path, cameras: Sequence[RigCamera]) -> None:
    name, count = Counter(camera.name for camera in cameras).most_common(1)[0]
    if count > 1:
        raise DatasetError(f"{file}: {count} cameras are named '{name}'")


def read_rig_drive(rig: Rig, origin: TileOrigin | None = None) -> tuple[RigInstant, ...]:
    """Read the drives of a rig; return its instants in time order, posed relative to ``origin``.

    The rig's pose is that of the reference's picture less its extrinsics, rounded as it is sent;
    the other cameras' poses follow by theirs. Raises ``DatasetError`` where a drive has another
    number of pictures, or its poses are not those (0.1 m, 1 degree): then the extrinsics are wrong.
    """
    drives = {camera.name: _drive(camera, origin) for camera in rig.cameras}
    reference = rig.reference
    count = len(drives[reference.name])
    for name, pictures in drives.items():
        if len(pictures) != count:
            raise DatasetError(
                f"the drive of camera '{name}' has {len(pictures)} pictures, that of "
                f"'{reference.name}' {count}; picture i of each is of one instant"
            )
    return tuple(_instant(rig, {n: drives[n][i] for n in drives}) for i in range(count))


def _drive(camera: RigCamera, origin: TileOrigin | None) -> tuple[PosedPicture, ...]:
    if camera.drive is None:
        raise InvalidInput("rig", f"camera '{camera.name}' has no drive")
    pictures = read_dataset(camera.drive, tile_origin=origin).pictures
    for picture in pictures:
        if picture.camera.intrinsics != pictures[0].camera.intrinsics:
            raise DatasetError(
                f"{camera.drive}: {picture.name} has other intrinsics than {pictures[0].name}; "
                "a drive is one camera"
            )
    return pictures


def _instant(rig: Rig, pictures: dict[str, PosedPicture]) -> RigInstant:
    reference = rig.reference
    world_from_cam = pictures[reference.name].camera.world_from_cam
    world_from_rig = world_from_cam.compose(reference.camera_from_rig).rounded()
    posed = {}
    for camera in rig.cameras:
        picture = pictures[camera.name]
        pose = camera_on_rig(world_from_rig, camera.camera_from_rig)
        _check_agrees(camera, picture, pose)
        posed[camera.name] = replace(picture, camera=replace(picture.camera, world_from_cam=pose))
    return RigInstant(world_from_rig, posed)


def _check_agrees(camera: RigCamera, picture: PosedPicture, pose: Pose) -> None:
    apart = picture.camera.world_from_cam.inverse().compose(pose)
    metres = math.hypot(*apart.translation_m)
    radians = 2 * math.acos(min(1.0, abs(apart.rotation[0])))
    if metres > AGREE_M or radians > AGREE_RAD:
        raise DatasetError(
            f"camera '{camera.name}': its drive has {picture.name} {metres:.2f} m and "
            f"{math.degrees(radians):.2f} degrees from where camera_from_rig puts it; at most "
            f"{AGREE_M:g} m and {math.degrees(AGREE_RAD):g} degrees"
        )


def write_rig(path: Path, rig: Rig) -> None:
    """Write a rig of drives; their paths are written relative to the file's folder."""
    lines = [f'reference = "{rig.reference.name}"']
    for camera in rig.cameras:
        if camera.drive is None:
            raise InvalidInput("rig", f"camera '{camera.name}' has no drive")
        turn, at = camera.camera_from_rig.rotation_matrix(), camera.camera_from_rig.translation_m
        rows = [[*row, metres] for row, metres in zip(turn, at, strict=True)]
        lines += ["", "[[camera]]", f'name = "{camera.name}"']
        lines.append(f'drive = "{camera.drive.relative_to(path.parent).as_posix()}"')
        lines += ["camera_from_rig = [", *(f"    {row!r}," for row in rows), "]"]
        if camera.priority != 1.0:
            lines.append(f"priority = {camera.priority!r}")
    write_whole(path, "\n".join(lines) + "\n")


@dataclass(frozen=True)
class Mount:
    """A camera on the car, in CARLA's vehicle axes: x forward, y right, z up, metres, degrees."""

    name: str
    x_m: float
    y_m: float
    z_m: float
    pitch_deg: float
    yaw_deg: float


ROWS = (("low", 5.5, 0.5, 15.0), ("mid", 2.5, 2.5, 0.0), ("high", 2.5, 5.5, -15.0))
"""Name, reach before the car's middle, height, pitch."""


def _row(name: str, reach_m: float, z_m: float, pitch_deg: float) -> tuple[Mount, ...]:
    def mount(side: str, x_m: float, y_m: float, yaw_deg: float) -> Mount:
        return Mount(f"{name}_{side}", x_m, y_m, z_m, pitch_deg, yaw_deg)

    return (
        mount("front", reach_m, 0.0, 0.0),
        mount("front_left", reach_m, 0.0, -45.0),
        mount("front_right", reach_m, 0.0, 45.0),
        mount("left", 0.0, -1.0, -90.0),
        mount("right", 0.0, 1.0, 90.0),
        mount("back", -reach_m, 0.0, 180.0),
    )


RIG = tuple(mount for row in ROWS for mount in _row(*row))


def mounts_named(names: str) -> tuple[Mount, ...]:
    """Return ``all`` mounts or those of a comma-separated list."""
    if names == "all":
        return RIG
    known = {mount.name: mount for mount in RIG}
    for name in names.split(","):
        if name not in known:
            raise InvalidInput("cameras", f"'{name}' is none of {', '.join(known)}")
    return tuple(known[name] for name in names.split(","))
