"""The cameras of a vehicle, and the pictures that they take along a drive.

Streams take pictures from a ``VehicleCameras``: ``RecordedCameras`` plays datasets back,
``cav_agent.live_cameras`` has the cameras that send now. A vehicle has one camera, or a rig of
several whose pictures of one instant belong together.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import structlog

from cav_agent.capture_schedule import CaptureSchedule, recorded_schedule
from cav_agent.config import AgentConfig
from cav_agent.frames import Capture
from rfcore.camera import Intrinsics, Pose, TileOrigin
from rfcore.codec.h264.qp_map import MaskSettings
from rfcore.dataset import read_dataset
from rfcore.dataset.rig import RigCamera, RigInstant, read_rig, read_rig_drive
from rfcore.errors import InvalidInput
from rfcore.views import PosedPicture

Position = tuple[float, float]
"""(east, north) in metres, in the drive's own global frame."""


@dataclass(frozen=True)
class VehicleCamera:
    """One of a vehicle's cameras; ``camera_from_rig``: its extrinsics, ``None`` where it is alone.

    ``priority``: weight of its quality in the division of bits.
    """

    camera_id: str
    intrinsics: Intrinsics
    masking: MaskSettings
    camera_from_rig: Pose | None = None
    priority: float = 1.0

    @staticmethod
    def on_rig(camera: RigCamera, intrinsics: Intrinsics) -> VehicleCamera:
        """Return a camera of a rig file."""
        masking = MaskSettings(camera.mask)
        extrinsics = camera.camera_from_rig
        return VehicleCamera(camera.name, intrinsics, masking, extrinsics, camera.priority)


class VehicleCameras(Protocol):
    """The cameras of a vehicle."""

    @property
    def cameras(self) -> tuple[VehicleCamera, ...]:
        """The cameras; the first is the one by which poses are known."""

    @property
    def positions(self) -> tuple[Position, ...]:
        """Positions of the vehicle at each place of the drive."""

    @property
    def schedule(self) -> CaptureSchedule:
        """Schedule of the captures."""

    def __len__(self) -> int:
        """Return the number of places on the drive."""

    def take(self, index: int) -> tuple[Capture, ...]:
        """Take the pictures at place ``index`` now, of every camera that has one."""


class RecordedCameras:
    """Plays back the drives of a vehicle's cameras: a picture is captured when it is taken.

    ``numbers`` gives each instant that is taken its number, over all tiles of a drive.
    """

    def __init__(
        self,
        config: AgentConfig,
        cameras: tuple[VehicleCamera, ...],
        instants: Sequence[RigInstant],
        numbers: Iterator[int],
    ) -> None:
        self.cameras = cameras
        self.schedule = recorded_schedule(config, len(instants), len(cameras))
        self._instants = tuple(instants)
        self._numbers = numbers

    def __len__(self) -> int:
        """Return how many instants there are."""
        return len(self._instants)

    @property
    def pictures(self) -> list[PosedPicture]:
        """The pictures of all cameras, in order of their instants."""
        return [picture for instant in self._instants for picture in instant.pictures.values()]

    @property
    def positions(self) -> tuple[Position, ...]:
        """Return where the vehicle was at each instant."""
        return tuple(instant.world_from_rig.translation_m[:2] for instant in self._instants)

    def take(self, index: int) -> tuple[Capture, ...]:
        """Take the pictures of instant ``index`` now."""
        instant, number = self._instants[index], next(self._numbers)
        now_s, now_ns = time.monotonic(), time.time_ns()
        return tuple(
            Capture(
                camera_id,
                index,
                picture,
                now_s,
                now_ns,
                instant=number,
                world_from_rig=instant.world_from_rig,
            )
            for camera_id, picture in instant.pictures.items()
        )


def instant_numbers(config: AgentConfig) -> Iterator[int]:
    """Return the numbers of a rig's instants; 0 for ever for a camera that is alone."""
    return itertools.repeat(0) if config.rig is None else itertools.count(1)


def recorded_cameras(
    config: AgentConfig, origin: TileOrigin, numbers: Iterator[int]
) -> RecordedCameras:
    """Read the drive of ``config``, posed relative to ``origin``.

    Poses are rounded as on the wire before anything is rendered at them, so that both ends render
    at the same one. Raises ``RfedgeError`` for a drive that cannot be read, and unless all pictures
    of it are of one camera.
    """
    if config.rig is not None:
        rig = read_rig(config.rig)
        instants = read_rig_drive(rig, origin)
        first = instants[0].pictures
        cameras = (
            VehicleCamera.on_rig(camera, first[camera.name].camera.intrinsics)
            for camera in rig.cameras
        )
        return RecordedCameras(config, tuple(cameras), instants, numbers)
    pictures = _read_drive(config, origin)
    camera = VehicleCamera(config.camera, pictures[0].camera.intrinsics, config.masking)
    alone = [
        RigInstant(picture.camera.world_from_cam, {config.camera: picture}) for picture in pictures
    ]
    return RecordedCameras(config, (camera,), alone, numbers)


def _read_drive(config: AgentConfig, origin: TileOrigin) -> list[PosedPicture]:
    if config.drive is None:
        raise InvalidInput("drive", "is missing")
    dataset = read_dataset(config.drive, tile_origin=origin)
    for change in dataset.changes:
        structlog.get_logger().info("drive read", note=change)
    pictures = dataset.pictures
    first = pictures[0]
    for picture in pictures:
        if picture.camera.intrinsics != first.camera.intrinsics:
            raise InvalidInput(
                "drive",
                f"{picture.name} has other intrinsics than {first.name}; one stream is one camera",
            )
    return [replace(picture, camera=picture.camera.rounded()) for picture in pictures]
