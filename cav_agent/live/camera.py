"""A live source as the camera of a drive: its pictures posed for a tile, and when they are coded.

The pose comes from the pose feed, or from the trajectory of ``camera.toml`` at the picture's time:
Unix time for a camera, time from the first frame on for a file. Only a trajectory tells which tiles
lie ahead.
"""

from __future__ import annotations

import bisect
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from cav_agent.capture_schedule import ROUNDING_S
from cav_agent.frames import Capture, FrameResult
from cav_agent.live.address import SourceKind
from cav_agent.live.settings import LiveSettings, ReaderSettings
from cav_agent.live.source import LiveFrame, LiveSource, ReaderProcess, SourceObserver, SourceThread
from rfcore.camera import Camera, Intrinsics, Pose, TileOrigin, Vec3
from rfcore.dataset.recording import RecordedPoses, RecordingCamera, read_recording_camera
from rfcore.dataset.undistort import pinhole_of, undistorted
from rfcore.errors import DatasetError, InvalidInput, RfedgeError
from rfcore.image import Rgb
from rfcore.localise.prior import PoseMeasurement
from rfcore.views import PosedPicture

__all__ = ["LiveCamera", "LivePictures", "LiveSchedule", "TrajectoryPoses", "open_camera"]

TRAJECTORY_STD_M, TRAJECTORY_STD_DEG = 0.5, 1.0
"""A trajectory stands in for a sensor as good as that where poses are looked for in the field."""
NOWHERE = ((0.0, 0.0),)


class TrajectoryPoses:
    """Where the camera is in one tile, by the trajectory of its ``camera.toml``."""

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
            pose = self._pose(capture)
        except DatasetError:
            return []
        std_m = (TRAJECTORY_STD_M,) * 3
        time_ns = self.time_ns(capture)
        return [
            PoseMeasurement(time_ns, pose.translation_m, std_m, pose.rotation, TRAJECTORY_STD_DEG)
        ]

    def localised(self, time_ns: int, position_m: Vec3) -> None:
        """Do nothing: a trajectory's offset is in its file."""

    def offset_s(self) -> float | None:
        """Return None: nothing is to be learnt."""

    def _pose(self, capture: Capture) -> Pose:
        picture = capture.picture
        return self._origin.localise(self._poses.at(picture.name, picture.time_ns))


class LivePictures:
    """The newest frame of a source, undistorted when it is read."""

    def __init__(self, source: LiveSource, camera: RecordingCamera, *, is_file: bool) -> None:
        self._source, self._is_file = source, is_file
        self._distorted, self._lens = camera.camera.intrinsics, camera.camera.lens
        lens = self._lens
        self.intrinsics: Intrinsics = (
            self._distorted if lens is None else pinhole_of(self._distorted, lens)
        )
        self._count = 0

    def __len__(self) -> int:
        """Return 1: there is always one picture, the newest."""
        return 1

    def time_ns(self, frame: LiveFrame) -> int:
        """Return a frame's time as poses know it."""
        return (frame.pts_ns or 0) if self._is_file else frame.time_ns

    def capture(self, index: int) -> Capture:  # noqa: ARG002
        """Take the newest frame; ``LiveSchedule`` says that there is one."""
        frame = self._source.take()
        if frame is None:
            raise InvalidInput("source", "has no new frame")
        self._count += 1
        camera = Camera(self.intrinsics, Pose.identity())
        name, read = f"live_{self._count:06d}", partial(self._read, frame.rgb)
        picture = PosedPicture(name, camera, read, self.time_ns(frame))
        times = (frame.taken_s, frame.time_ns, frame.clock, frame.received_s)
        return Capture(self._count, picture, *times)

    def _read(self, rgb: Rgb) -> Rgb:
        return rgb if self._lens is None else undistorted(rgb, self._distorted, self._lens)


class LiveSchedule:
    """A picture whenever the source has a new one, no more often than the server's limit allows.

    Its index is the place on the trajectory; without one there is a single place.
    """

    def __init__(self, source: LiveSource, place: Callable[[LiveFrame], int]) -> None:
        self._source, self._place = source, place
        self._period_s = 0.0
        self._open_s = float("-inf")

    def next_capture(self, now: float) -> int | None:
        """Return the place of the newest frame, if there is a new one and it may be captured."""
        frame = self._source.newest
        if frame is None or now < self._open_s - ROUNDING_S:
            return None
        self._open_s = max(self._open_s, now - self._period_s) + self._period_s
        return self._place(frame)

    def ended(self, result: FrameResult) -> None:
        """Do nothing: a camera does not wait."""

    def limit(self, rate_hz: float) -> None:
        """Capture no more than ``rate_hz`` pictures per second on average."""
        self._period_s = 1.0 / rate_hz if rate_hz else 0.0

    def get_timer(self) -> float | None:
        """Return when the limit allows the frame that waits."""
        return self._open_s if self._source.newest is not None else None

    @property
    def finished(self) -> bool:
        """Whether a file has come to its end."""
        return self._source.is_over and self._source.newest is None


@dataclass(frozen=True)
class LiveCamera:
    """An open source: how its pictures are taken and where they are along the drive.

    ``positions``: (east, north) in metres of the trajectory's poses, or a single one that says
    nothing where there is no trajectory.
    """

    source: LiveSource
    pictures: LivePictures
    schedule: LiveSchedule
    positions: tuple[tuple[float, float], ...]
    trajectory: RecordedPoses | None
    thread: SourceThread
    place: Callable[[LiveFrame], int]
    """A frame's place on the trajectory, 0 without one."""

    @property
    def knows_route(self) -> bool:
        """Whether it can be said which tiles the vehicle passes."""
        return self.trajectory is not None

    def poses(self, origin: TileOrigin) -> TrajectoryPoses | None:
        """Return the trajectory's poses in a tile, if there is one."""
        return None if self.trajectory is None else TrajectoryPoses(self.trajectory, origin)

    def close(self) -> None:
        """End the source's thread and process."""
        self.thread.close()


def open_camera(
    settings: LiveSettings,
    rate_hz: float,
    observer: SourceObserver,
    *,
    has_feed: bool,
    repeats: bool = False,
    arrived: Callable[[], None] = lambda: None,
) -> LiveCamera:
    """Read ``camera.toml`` and begin to open the source; ``arrived`` is called on its thread.

    Raises ``RfedgeError`` for a file that is wrong, or where nothing says where the camera is.
    """
    camera = read_recording_camera(_camera_file(settings))
    poses = None if has_feed else camera.poses
    if poses is None and not has_feed:
        raise RfedgeError(
            f"{settings.camera_file}: has no [trajectory], and there is no --pose-feed: nothing "
            "says where the camera is"
        )
    k = camera.camera.intrinsics
    size_px = (k.width_px, k.height_px)
    address = settings.opened_for(size_px)
    is_file = address.kind is SourceKind.FILE
    if is_file and not Path(address.url).is_file():
        raise InvalidInput("source", f"{address.url} is no file")
    told = ReaderSettings(address, settings.source_timeout_s, rate_hz)
    source = LiveSource(
        partial(ReaderProcess, told),
        size_px,
        observer,
        timeout_s=settings.source_timeout_s,
        repeats=repeats,
        arrived=arrived,
    )
    pictures = LivePictures(source, camera, is_file=is_file)
    place = _places(pictures, poses)
    schedule = LiveSchedule(source, place)
    positions = NOWHERE if poses is None else _positions(poses)
    return LiveCamera(source, pictures, schedule, positions, poses, SourceThread(source), place)


def _camera_file(settings: LiveSettings) -> Path:
    file = settings.camera_file or Path()
    return file / "camera.toml" if file.is_dir() else file


def _positions(poses: RecordedPoses) -> tuple[tuple[float, float], ...]:
    world = (pose.compose(poses.body_from_cam) for pose in poses.trajectory.poses)
    return tuple(pose.translation_m[:2] for pose in world)


def _places(pictures: LivePictures, poses: RecordedPoses | None) -> Callable[[LiveFrame], int]:
    """Return what finds a frame's place: the first pose of the trajectory after it."""
    if poses is None:
        return lambda _: 0
    times_ns, offset_ns = poses.trajectory.times_ns, poses.offset_ns

    def place(frame: LiveFrame) -> int:
        after = bisect.bisect_left(times_ns, pictures.time_ns(frame) + offset_ns)
        return min(after, len(times_ns) - 1)

    return place
