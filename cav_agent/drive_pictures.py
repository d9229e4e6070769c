"""The pictures of a vehicle's cameras as streams take them: by their place, posed for one tile."""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from cav_agent.frames import Capture
from rfcore.camera import Intrinsics, Pose
from rfcore.codec.h264.qp_map import MaskSettings
from rfcore.dataset.rig import Rig, RigInstant
from rfcore.views import PosedPicture

__all__ = [
    "CameraPictures",
    "OneCamera",
    "RecordedPictures",
    "RecordedRig",
    "VehicleCamera",
    "VehiclePictures",
]


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


class VehiclePictures(Protocol):
    """What a vehicle's cameras see; ``cav_agent.live.rig`` has those of a live rig."""

    @property
    def cameras(self) -> tuple[VehicleCamera, ...]:
        """The cameras, the one by which poses are known first."""

    def __len__(self) -> int:
        """Return how many places there are on the drive."""

    def take(self, index: int) -> tuple[Capture, ...]:
        """Take the pictures at place ``index`` now, of every camera that has one."""


class CameraPictures(Protocol):
    """A single camera's pictures; ``cav_agent.live.camera`` has those of a live one."""

    @property
    def intrinsics(self) -> Intrinsics:
        """Of every picture."""

    def __len__(self) -> int:
        """Return how many places there are on the drive."""

    def capture(self, index: int) -> Capture:
        """Take the picture at place ``index`` now."""


class OneCamera:
    """A vehicle with one camera."""

    def __init__(self, camera_id: str, pictures: CameraPictures, masking: MaskSettings) -> None:
        self._pictures = pictures
        self.cameras = (VehicleCamera(camera_id, pictures.intrinsics, masking),)

    def __len__(self) -> int:
        """Return how many places there are on the drive."""
        return len(self._pictures)

    def take(self, index: int) -> tuple[Capture, ...]:
        """Take the picture at place ``index`` now."""
        captured = self._pictures.capture(index)
        return (replace(captured, camera_id=self.cameras[0].camera_id),)


class RecordedPictures:
    """A dataset's pictures; one is captured when it is taken."""

    def __init__(self, pictures: Sequence[PosedPicture]) -> None:
        self._pictures = tuple(pictures)

    @property
    def intrinsics(self) -> Intrinsics:
        """Of every picture."""
        return self._pictures[0].camera.intrinsics

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self._pictures)

    def capture(self, index: int) -> Capture:
        """Take picture ``index`` now."""
        return Capture(index, self._pictures[index], time.monotonic(), time.time_ns())


class RecordedRig:
    """The drives of a rig; ``numbers`` counts instants over all tiles of the drive."""

    def __init__(
        self, rig: Rig, instants: Sequence[RigInstant], numbers: itertools.count[int]
    ) -> None:
        self._instants = tuple(instants)
        self._numbers = numbers
        first = self._instants[0].pictures
        self.cameras = tuple(
            VehicleCamera(
                camera.name,
                first[camera.name].camera.intrinsics,
                MaskSettings(camera.mask),
                camera.camera_from_rig,
                camera.priority,
            )
            for camera in rig.cameras
        )

    def __len__(self) -> int:
        """Return how many instants there are."""
        return len(self._instants)

    def take(self, index: int) -> tuple[Capture, ...]:
        """Take the pictures of instant ``index`` now."""
        instant, number = self._instants[index], next(self._numbers)
        now_s, now_ns = time.monotonic(), time.time_ns()
        return tuple(
            Capture(
                index,
                picture,
                now_s,
                now_ns,
                camera_id=camera_id,
                instant=number,
                world_from_rig=instant.world_from_rig,
            )
            for camera_id, picture in instant.pictures.items()
        )
