"""The live cameras of a rig: their newest frames, taken together as one instant.

Cameras that are not synchronised send at the same rate with different phases. An instant is due
when every camera that has sent lately has a new frame, or half a period after the first of them:
so its pictures were taken within a period, and a camera that is lost, or late, delays the others by
no more than that half period, once. Every picture keeps its own time of capture.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace

from cav_agent.capture_schedule import ROUNDING_S
from cav_agent.drive_pictures import VehicleCamera
from cav_agent.frames import Capture, FrameResult
from cav_agent.live.camera import LiveCamera, TrajectoryPoses, open_camera
from cav_agent.live.settings import LiveSettings
from cav_agent.live.source import LiveFrame, SourceObserver
from rfcore.camera import TileOrigin
from rfcore.codec.h264.qp_map import MaskSettings
from rfcore.dataset.rig import Rig, RigCamera
from rfcore.errors import InvalidInput

__all__ = ["LiveRig", "LiveSources", "RigObserver", "RigSchedule", "open_rig"]

SILENT_PERIODS = 3.0
"""A camera that gave no frame for so many periods is not waited for."""


class RigObserver(SourceObserver):
    """Hears what happens to the sources of a rig, each under its camera's name."""

    def of_camera(self, camera_id: str) -> SourceObserver:
        """Return what hears of one camera."""
        raise NotImplementedError


class LiveSources:
    """When the cameras of a rig are due, from which of them have a new frame; without clock.

    ``rate_hz``: at which they are coded.
    """

    def __init__(self, cameras: int, rate_hz: float) -> None:
        self._period_s = 1.0 / rate_hz
        self._heard_s = [float("-inf")] * cameras

    def due_s(self, received_s: Sequence[float | None]) -> float | None:
        """Return when an instant of the frames received then is due; ``None``: a camera's newest
        was taken already, or it has none. None without any frame."""
        new = [at for at in received_s if at is not None]
        if not new:
            return None
        first_s = min(new)
        patience_s = SILENT_PERIODS * self._period_s
        waited_for = (
            at is None and first_s - heard <= patience_s
            for at, heard in zip(received_s, self._heard_s, strict=True)
        )
        return first_s + 0.5 * self._period_s if any(waited_for) else first_s

    def taken(self, received_s: Sequence[float | None]) -> None:
        """The frames received then were taken."""
        for i, at in enumerate(received_s):
            if at is not None:
                self._heard_s[i] = at


class RigSchedule:
    """An instant whenever the cameras are due, no more often than the server's limit allows."""

    def __init__(self, cameras: Sequence[LiveCamera], rate_hz: float) -> None:
        self._cameras = tuple(cameras)
        self._sources = LiveSources(len(cameras), rate_hz)
        self._period_s = 0.0
        self._open_s = float("-inf")

    def next_capture(self, now: float) -> int | None:
        """Return the place of the instant that is due, if one is and may be captured."""
        due_s = self.get_timer()
        if due_s is None or now < due_s - ROUNDING_S:
            return None
        self._open_s = max(self._open_s, now - self._period_s) + self._period_s
        newest = [camera.source.newest for camera in self._cameras]
        self._sources.taken([_received_s(frame) for frame in newest])
        reference = self._cameras[0]
        return next(reference.place(frame) for frame in newest if frame is not None)

    def ended(self, result: FrameResult) -> None:
        """Do nothing: a camera does not wait."""

    def limit(self, rate_hz: float) -> None:
        """Capture no more than ``rate_hz`` instants per second on average."""
        self._period_s = 1.0 / rate_hz if rate_hz else 0.0

    def get_timer(self) -> float | None:
        """Return when the frames that wait are due."""
        due_s = self._sources.due_s([_received_s(c.source.newest) for c in self._cameras])
        return None if due_s is None else max(due_s, self._open_s)

    @property
    def finished(self) -> bool:
        """Whether every camera is a file that has come to its end."""
        return all(camera.schedule.finished for camera in self._cameras)


def _received_s(frame: LiveFrame | None) -> float | None:
    return None if frame is None else frame.received_s


@dataclass(frozen=True)
class LiveRig:
    """The open cameras of a rig, the reference first; a ``cav_agent.drive_pictures`` source."""

    cameras: tuple[VehicleCamera, ...]
    live: tuple[LiveCamera, ...]
    schedule: RigSchedule
    numbers: itertools.count[int]

    def __len__(self) -> int:
        """Return 1: there is always one place, the present."""
        return 1

    def take(self, index: int) -> tuple[Capture, ...]:
        """Take the newest frame of every camera that has one."""
        instant = next(self.numbers)
        captures = tuple(
            replace(live.pictures.capture(index), camera_id=camera.camera_id, instant=instant)
            for camera, live in zip(self.cameras, self.live, strict=True)
            if live.source.newest is not None
        )
        if not captures:
            raise InvalidInput("rig", "has no new frame")
        return captures

    @property
    def positions(self) -> tuple[tuple[float, float], ...]:
        """(east, north) in metres of the reference camera's trajectory."""
        return self.live[0].positions

    @property
    def knows_route(self) -> bool:
        """Whether it can be said which tiles the vehicle passes."""
        return self.live[0].knows_route

    def poses(self, origin: TileOrigin) -> TrajectoryPoses | None:
        """Return the reference camera's trajectory in a tile, if there is one."""
        return self.live[0].poses(origin)

    def close(self) -> None:
        """End the threads and processes of every camera."""
        with ExitStack() as stack:
            for camera in self.live:
                stack.callback(camera.close)


def open_rig(
    rig: Rig,
    settings: LiveSettings,
    rate_hz: float,
    observer: RigObserver,
    *,
    has_feed: bool,
    repeats: bool = False,
    arrived: Callable[[], None] = lambda: None,
) -> LiveRig:
    """Begin to open every source of ``rig``; ``settings`` has what holds for all of them.

    Raises what ``open_camera`` does; then nothing stays open.
    """
    with ExitStack() as stack:
        live = []
        for camera in rig.cameras:
            opened = open_camera(
                replace(settings, source=camera.source, camera_file=camera.camera_file),
                rate_hz,
                observer.of_camera(camera.name),
                has_feed=has_feed or camera is not rig.reference,
                repeats=repeats,
                arrived=arrived,
            )
            stack.callback(opened.close)
            live.append(opened)
        cameras = tuple(_described(c, opened) for c, opened in zip(rig.cameras, live, strict=True))
        stack.pop_all()
    return LiveRig(cameras, tuple(live), RigSchedule(live, rate_hz), itertools.count(1))


def _described(camera: RigCamera, live: LiveCamera) -> VehicleCamera:
    masking, extrinsics = MaskSettings(camera.mask), camera.camera_from_rig
    k = live.pictures.intrinsics
    return VehicleCamera(camera.name, k, masking, extrinsics, camera.priority)
