"""The live cameras of a vehicle: their newest frames, posed for a tile, and when they are coded.

Poses come from the pose feed, or from the trajectory in ``camera.toml`` at the picture's time: Unix
time for a camera, time from the first frame on for a video file. Only a trajectory says which tiles
lie ahead.

Cameras of a rig that are not synchronised send at the same rate with different phases. An instant
is due when every camera that has sent lately has a new frame, or half a period after the first of
them. So its pictures were taken within a period, and a camera that is lost, or late, delays the
others by no more than that half period, once. Every picture keeps its own time of capture. A camera
that is alone is due whenever it has a new frame.
"""

from __future__ import annotations

import bisect
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path

from cav_agent.camera_poses import PoseSource, stand_in_measurement
from cav_agent.cameras import Position, VehicleCamera, instant_numbers
from cav_agent.capture_schedule import ROUNDING_S, RateLimit
from cav_agent.config import AgentConfig
from cav_agent.frames import Capture, FrameResult
from cav_agent.live.settings import LiveSettings, ReaderSettings, SourceKind
from cav_agent.live.source import LiveFrame, LiveSource, ReaderProcess, SourceObserver, SourceThread
from rfcore.camera import Camera, Intrinsics, Pose, TileOrigin
from rfcore.dataset.recording import RecordedPoses, RecordingCamera, read_recording_camera
from rfcore.dataset.rig import Rig
from rfcore.dataset.undistort import pinhole_of, undistorted
from rfcore.errors import DatasetError, InvalidInput, RfedgeError
from rfcore.extras import require
from rfcore.image import Rgb
from rfcore.localise.estimate import PoseMeasurement
from rfcore.views import PosedPicture

SILENT_PERIODS = 3.0
"""A camera that gave no frame for so many periods is not waited for."""
NOWHERE: tuple[Position, ...] = ((0.0, 0.0),)


class TrajectoryPoses(PoseSource):
    """The camera's poses in one tile, by the trajectory of its ``camera.toml``."""

    def __init__(self, poses: RecordedPoses, origin: TileOrigin) -> None:
        self._poses, self._origin = poses, origin

    def time_ns(self, capture: Capture) -> int:
        """Return a picture's time on the trajectory's clock, less the offset."""
        return capture.picture.time_ns

    def camera(self, capture: Capture) -> Camera:
        """Return the picture's camera, rounded as it is sent.

        Raises ``DatasetError`` where the trajectory does not say.
        """
        return Camera(capture.picture.camera.intrinsics, self._pose(capture)).rounded()

    def measurements(self, capture: Capture) -> list[PoseMeasurement]:
        """Return the pose of the picture itself, if the trajectory has it."""
        try:
            return [stand_in_measurement(self.time_ns(capture), self._pose(capture))]
        except DatasetError:
            return []

    def _pose(self, capture: Capture) -> Pose:
        picture = capture.picture
        return self._origin.localise(self._poses.at(picture.name, picture.time_ns))


class LiveCamera:
    """One open source; its pictures are undistorted when they are read."""

    def __init__(self, source: LiveSource, recording: RecordingCamera, *, is_file: bool) -> None:
        self.source = source
        self._thread = SourceThread(source)
        self._is_file = is_file
        self._distorted, self._lens = recording.camera.intrinsics, recording.camera.lens
        self._count = 0
        lens = self._lens
        self.intrinsics: Intrinsics = (
            self._distorted if lens is None else pinhole_of(self._distorted, lens)
        )
        """The pinhole camera of the undistorted pictures."""

    def time_ns(self, frame: LiveFrame) -> int:
        """Return a frame's time on the clock of the poses."""
        return (frame.pts_ns or 0) if self._is_file else frame.time_ns

    def capture(self, camera: VehicleCamera, index: int, instant: int) -> Capture:
        """Take the newest frame; the schedule has checked that there is one."""
        frame = self.source.take()
        if frame is None:
            raise InvalidInput("source", "has no new frame")
        self._count += 1
        picture = PosedPicture(
            f"live_{self._count:06d}",
            Camera(camera.intrinsics, Pose.identity()),
            partial(self._read, frame.rgb),
            self.time_ns(frame),
        )
        times = (frame.taken_s, frame.time_ns, frame.clock, frame.received_s)
        return Capture(camera.camera_id, index, picture, *times, instant=instant)

    def close(self) -> None:
        """End the source's thread and process."""
        self._thread.close()

    def _read(self, rgb: Rgb) -> Rgb:
        return rgb if self._lens is None else undistorted(rgb, self._distorted, self._lens)


class InstantClock:
    """Decides when the cameras of a rig are due, from which of them have a new frame.

    ``rate_hz``: the rate at which they are coded.
    """

    def __init__(self, cameras: int, rate_hz: float) -> None:
        self._period_s = 1.0 / rate_hz
        self._heard_s = [float("-inf")] * cameras

    def due_s(self, received_s: Sequence[float | None]) -> float | None:
        """Return when an instant of the frames that were received at these times is due.

        A camera without a new frame has ``None``. Returns ``None`` without any frame.
        """
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
        """Note that the frames that were received at these times were taken."""
        for i, at in enumerate(received_s):
            if at is not None:
                self._heard_s[i] = at


class LiveSchedule:
    """Captures an instant whenever the cameras are due and the server's limit allows it.

    Its index is ``place`` of one of its frames: the place on the reference camera's trajectory.
    """

    def __init__(
        self, sources: Sequence[LiveSource], rate_hz: float, place: Callable[[LiveFrame], int]
    ) -> None:
        self._sources = tuple(sources)
        self._place = place
        self._clock = InstantClock(len(sources), rate_hz)
        self._limit = RateLimit()

    def next_capture(self, now: float) -> int | None:
        """Return the place of the instant that is due, if one is and may be captured."""
        due_s = self.get_timer()
        if due_s is None or now < due_s - ROUNDING_S:
            return None
        self._limit.captured(now)
        self._clock.taken(self._received_s())
        newest = (source.newest for source in self._sources)
        return next(self._place(frame) for frame in newest if frame is not None)

    def ended(self, result: FrameResult) -> None:
        """Do nothing: a camera does not wait."""

    def limit(self, rate_hz: float) -> None:
        """Capture no more than ``rate_hz`` instants per second on average."""
        self._limit.set_hz(rate_hz)

    def get_timer(self) -> float | None:
        """Return when the frames that wait are due."""
        due_s = self._clock.due_s(self._received_s())
        return None if due_s is None else max(due_s, self._limit.open_s)

    @property
    def finished(self) -> bool:
        """Return whether every camera is a file that has come to its end."""
        return all(source.is_over and source.newest is None for source in self._sources)

    def _received_s(self) -> list[float | None]:
        newest = (source.newest for source in self._sources)
        return [None if frame is None else frame.received_s for frame in newest]


class LiveCameras:
    """The open cameras of a vehicle, the reference first; a ``VehicleCameras``."""

    def __init__(
        self,
        cameras: tuple[VehicleCamera, ...],
        live: tuple[LiveCamera, ...],
        rate_hz: float,
        trajectory: RecordedPoses | None,
        numbers: Iterator[int],
    ) -> None:
        self.cameras = cameras
        self._live = live
        self._trajectory = trajectory
        self._numbers = numbers
        self.schedule = LiveSchedule([camera.source for camera in live], rate_hz, self._place)

    def __len__(self) -> int:
        """Return 1: there is always one place, the present."""
        return 1

    def take(self, index: int) -> tuple[Capture, ...]:
        """Take the newest frame of every camera that has one."""
        instant = next(self._numbers)
        captures = tuple(
            live.capture(camera, index, instant)
            for camera, live in zip(self.cameras, self._live, strict=True)
            if live.source.newest is not None
        )
        if not captures:
            raise InvalidInput("source", "no camera has a new frame")
        return captures

    @property
    def knows_route(self) -> bool:
        """Return whether it is known which tiles the vehicle passes."""
        return self._trajectory is not None

    @property
    def positions(self) -> tuple[Position, ...]:
        """The positions of the reference camera's trajectory; a single one means nothing."""
        if self._trajectory is None:
            return NOWHERE
        body_from_cam = self._trajectory.body_from_cam
        world = (pose.compose(body_from_cam) for pose in self._trajectory.trajectory.poses)
        return tuple(pose.translation_m[:2] for pose in world)

    def poses(self, origin: TileOrigin) -> TrajectoryPoses | None:
        """Return the poses of the trajectory in a tile, if there is one."""
        return None if self._trajectory is None else TrajectoryPoses(self._trajectory, origin)

    def close(self) -> None:
        """End the threads and processes of every camera."""
        with ExitStack() as stack:
            for camera in self._live:
                stack.callback(camera.close)

    def _place(self, frame: LiveFrame) -> int:
        """Return a frame's place on the trajectory: the first pose after it; 0 without one."""
        if self._trajectory is None:
            return 0
        times_ns = self._trajectory.trajectory.times_ns
        time_ns = self._live[0].time_ns(frame) + self._trajectory.offset_ns
        return min(bisect.bisect_left(times_ns, time_ns), len(times_ns) - 1)


def open_live_cameras(
    config: AgentConfig,
    rig: Rig | None,
    observer: SourceObserver,
    arrived: Callable[[], None] = lambda: None,
) -> LiveCameras:
    """Read each ``camera.toml`` and begin to open its source, or those of ``rig``.

    ``arrived`` is called on the sources' threads. Raises ``RfedgeError`` for a file that is wrong,
    or where nothing says where the cameras are; then nothing stays open.
    """
    given = [(config.camera, config.live)]
    if rig is not None:
        given = [
            (c.name, replace(config.live, source=c.source, camera_file=c.camera_file))
            for c in rig.cameras
        ]
    recordings = [read_recording_camera(_camera_file(settings)) for _, settings in given]
    has_feed = config.feed.source is not None
    trajectory = None if has_feed else recordings[0].poses
    if trajectory is None and not has_feed:
        raise RfedgeError(
            f"{given[0][1].camera_file}: has no [trajectory], and there is no --pose-feed: nothing "
            "says where the camera is"
        )
    with ExitStack() as stack:
        live = []
        for (name, settings), recording in zip(given, recordings, strict=True):
            live.append(_open(config, name, settings, recording, observer, arrived))
            stack.callback(live[-1].close)
        stack.pop_all()
    cameras = [VehicleCamera(config.camera, live[0].intrinsics, config.masking)]
    if rig is not None:
        pairs = zip(rig.cameras, live, strict=True)
        cameras = [VehicleCamera.on_rig(camera, opened.intrinsics) for camera, opened in pairs]
    return LiveCameras(
        tuple(cameras), tuple(live), config.rate, trajectory, instant_numbers(config)
    )


def _open(
    config: AgentConfig,
    name: str,
    settings: LiveSettings,
    recording: RecordingCamera,
    observer: SourceObserver,
    arrived: Callable[[], None],
) -> LiveCamera:
    k = recording.camera.intrinsics
    size_px = (k.width_px, k.height_px)
    address = settings.opened_for(size_px)
    is_file = address.is_file
    if is_file and not Path(address.url).is_file():
        raise InvalidInput("source", f"{address.url} is no file")
    if address.kind is SourceKind.BAG:
        require("bags", "mcap", "rosbags", "foxglove_schemas_protobuf")
    reader = ReaderSettings(address, settings.source_timeout_s, config.rate)
    source = LiveSource(
        partial(ReaderProcess, reader),
        name,
        size_px,
        observer,
        timeout_s=settings.source_timeout_s,
        repeats=config.loop,
        arrived=arrived,
    )
    return LiveCamera(source, recording, is_file=is_file)


def _camera_file(settings: LiveSettings) -> Path:
    file = settings.camera_file or Path()
    return file / "camera.toml" if file.is_dir() else file
