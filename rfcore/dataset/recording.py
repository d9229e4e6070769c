"""A recording of one's own: a video or a folder of pictures, a trajectory, and ``camera.toml``.

::

    [camera]
    model = "OPENCV"                # as COLMAP names them; PINHOLE is the default
    width_px = 1920
    height_px = 1080
    fx_px = 1050.0
    fy_px = 1050.0                  # default: fx_px
    cx_px = 960.0                   # default: the middle
    cy_px = 540.0
    k1 = -0.1                       # the lens: k1 k2 p1 p2 k3, or k1..k4 of OPENCV_FISHEYE

    [pictures]
    video = "drive.mp4"             # or folder = "frames", in the order of the names, with
    rate_hz = 10.0                  #   rate_hz, or times = "times.txt", a time in seconds a line
    every = 1                       # take each n-th picture

    [trajectory]
    file = "trajectory.txt"         # TUM, or CSV if named .csv
    time_offset_s = 0.0             # time in the trajectory = time of the picture + offset
    max_gap_s = 1.0                 # no interpolation between poses further apart
    outside = "refuse"              # or "drop": leave out pictures the trajectory does not cover
    body_from_cam = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]   # default: it is the camera's

    [points]                        # may be left out
    file = "lidar.ply"              # coloured surface points in the trajectory's world

The camera has OpenCV axes. A video's time starts at 0 with its first frame, a folder's with the
first picture (``rate_hz``) or where ``times`` says.

``Video`` reads the frames of a file by their number, with the times that the container states,
counted from the first one. A frame that does not state its colour matrix is taken as BT.709
from 720 lines up and as BT.601 below, as players do. A display rotation, which phones write, is
refused, since intrinsics would belong to the other orientation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from pathlib import Path
from threading import Lock

import av
from av.error import FFmpegError

from rfcore.camera import Intrinsics, Pose
from rfcore.dataset.keys import (
    POSE_SHAPES,
    anchor_at,
    blamed_on,
    filled_lines,
    lens_of,
    load_toml,
    pose_of_rows,
    table_at,
)
from rfcore.dataset.picture_file import SUFFIXES, check_size, inside, read_picture
from rfcore.dataset.source import Source, SourceCamera, SourcePicture, SourcePoints, read_points
from rfcore.dataset.trajectory import NS_PER_S, Trajectory, read_trajectory, time_ns
from rfcore.errors import DatasetError
from rfcore.image import Rgb, rgb_from_video_frame
from rfcore.tables import Range, Table


class Video:
    """A video file; frames are decoded when read, cheaply when they are read in order.

    Raises ``DatasetError``, naming the file, when it cannot be decoded or is of another size than
    the camera's.
    """

    def __init__(self, file: Path, intrinsics: Intrinsics) -> None:
        self.file = file
        self._lock = Lock()
        try:
            self._container = av.open(str(file))
            self._stream = self._container.streams.video[0]
            self._pts = self._presentation_times()
            if not self._pts:
                raise DatasetError(f"{file}: holds no frames")
            self._check_size(intrinsics)
        except (FFmpegError, OSError, IndexError, StopIteration) as error:
            raise DatasetError(f"{file}: not a readable video ({error})") from error
        self._frames = self._container.decode(self._stream)
        self._next = -1

    @property
    def times_ns(self) -> tuple[int, ...]:
        """Times at which the frames are shown, counted from the first one."""
        tick_s = self._stream.time_base or Fraction(1, 90_000)
        return tuple(round((pts - self._pts[0]) * tick_s * 1_000_000_000) for pts in self._pts)

    def read(self, index: int) -> Rgb:
        """Return frame ``index`` as uint8 [H, W, 3]."""
        with self._lock:
            try:
                return rgb_from_video_frame(self._frame(index))
            except (FFmpegError, StopIteration) as error:
                raise DatasetError(
                    f"{self.file}: frame {index} cannot be decoded ({error})"
                ) from error

    def _frame(self, index: int) -> av.VideoFrame:
        """Decode on to a frame, from the key frame before it unless it is the next one."""
        wanted = self._pts[index]
        if index != self._next:
            self._container.seek(wanted, stream=self._stream)
            self._frames = self._container.decode(self._stream)
        frame = next(self._frames)
        while frame.pts is None or frame.pts < wanted:
            frame = next(self._frames)
        if frame.pts != wanted:
            raise DatasetError(f"{self.file}: seeking to frame {index} ends at another frame")
        self._next = index + 1
        return frame

    def _presentation_times(self) -> list[int]:
        """Every frame's time in the stream's ticks, without decoding."""
        packets = self._container.demux(self._stream)
        return sorted({packet.pts for packet in packets if packet.pts is not None and packet.size})

    def _check_size(self, intrinsics: Intrinsics) -> None:
        if self._stream.codec_context is None:
            raise DatasetError(f"{self.file}: is of a codec that is not known")
        found = (self._stream.codec_context.width, self._stream.codec_context.height)
        if found != (intrinsics.width_px, intrinsics.height_px):
            raise DatasetError(
                f"{self.file}: video is {found[0]}x{found[1]} px, its camera says "
                f"{intrinsics.width_px}x{intrinsics.height_px}"
            )
        self._container.seek(self._pts[0], stream=self._stream)
        first = next(self._container.decode(self._stream), None)
        if first is None or first.rotation:
            turned = "nothing" if first is None else f"frames to be turned by {first.rotation}"
            raise DatasetError(f"{self.file}: holds {turned} degrees; encode it upright first")
        self._container.seek(self._pts[0], stream=self._stream)


SECTIONS = {
    "camera": "model width_px height_px fx_px fy_px cx_px cy_px k1 k2 k3 k4 p1 p2",
    "pictures": "video folder rate_hz times every",
    "trajectory": "file time_offset_s max_gap_s outside body_from_cam",
    "points": "file",
    "anchor": "latitude_deg longitude_deg height_m enu_from_world point_m",
}
REQUIRED = ("camera", "pictures", "trajectory")


@dataclass(frozen=True)
class RecordedPoses:
    """Poses over time: the section [trajectory].

    Times are the pictures' own, nanoseconds; ``offset_ns`` more is the trajectory's.
    """

    trajectory: Trajectory
    offset_ns: int
    max_gap_ns: int
    drop_outside: bool
    body_from_cam: Pose

    @staticmethod
    def of(file: Path, keys: Table) -> RecordedPoses:
        """Read what the section of ``file`` names; raise ``DatasetError`` naming file and key."""
        where = f"{file}: [trajectory]"
        outside = keys.choice("outside", ("refuse", "drop"), "refuse")
        body_from_cam = Pose.identity()
        if "body_from_cam" in keys:
            rows = keys.matrix("body_from_cam", POSE_SHAPES)
            body_from_cam = pose_of_rows(where, "body_from_cam", rows)
        offset_s = keys.number("time_offset_s", default=0.0)
        max_gap_s = keys.number("max_gap_s", Range(0.0), 1.0)
        return RecordedPoses(
            trajectory=read_trajectory(inside(where, file.parent, keys.text("file"))),
            offset_ns=round(offset_s * NS_PER_S),
            max_gap_ns=round(max_gap_s * NS_PER_S),
            drop_outside=outside == "drop",
            body_from_cam=body_from_cam,
        )

    def wanted(self, time_ns: int) -> bool:
        """Return whether a picture of that time is to be kept."""
        return not self.drop_outside or self.trajectory.covers(time_ns + self.offset_ns)

    def at(self, where: str, time_ns: int) -> Pose:
        """Return world_from_cam; raise ``DatasetError`` naming ``where`` if it is not known."""
        time_ns += self.offset_ns
        world_from_body = self.trajectory.pose_at(where, time_ns, self.max_gap_ns)
        return world_from_body.compose(self.body_from_cam)


@dataclass(frozen=True)
class RecordingCamera:
    """A ``camera.toml`` without its pictures: the camera, and its poses over time if it has any."""

    camera: SourceCamera
    poses: RecordedPoses | None = None


@dataclass(frozen=True)
class TimedPicture:
    """A picture before its pose is known; ``time_ns`` on the pictures' own clock."""

    name: str
    time_ns: int
    read: Callable[[], Rgb]


def read_recording_source(file: Path) -> Source:
    """Read a ``camera.toml`` and what it names. Raises ``DatasetError`` naming the file and key."""
    content = _load(file)
    where = f"{file}: [camera]"
    camera = _camera(where, content["camera"])
    timed = _timed_pictures(file, content["pictures"], camera.intrinsics)
    poses = RecordedPoses.of(file, content["trajectory"])
    pictures = tuple(
        SourcePicture(
            where=f"{file}: {picture.name}",
            name=picture.name,
            camera=camera,
            world_from_cam=poses.at(f"{file}: {picture.name}", picture.time_ns),
            read=picture.read,
            time_ns=picture.time_ns + poses.offset_ns,
        )
        for picture in timed
        if poses.wanted(picture.time_ns)
    )
    dropped = len(timed) - len(pictures)
    anchor = anchor_at(str(file), content["anchor"].values if "anchor" in content else None)
    return Source(file, pictures, _points(file, content), dropped, anchor=anchor)


def read_recording_camera(file: Path) -> RecordingCamera:
    """Read the sections [camera] and, if it is there, [trajectory] of a ``camera.toml``.

    For cameras that send now. Raises ``DatasetError`` naming the file and key.
    """
    content = _load(file, required=("camera",))
    poses = RecordedPoses.of(file, content["trajectory"]) if "trajectory" in content else None
    return RecordingCamera(_camera(f"{file}: [camera]", content["camera"]), poses)


def _load(file: Path, required: Sequence[str] = REQUIRED) -> dict[str, Table]:
    """Return the file's sections, each with no other keys than it may have."""
    content = load_toml(file)
    for section in content:
        if section not in SECTIONS:
            raise DatasetError(f"{file}: section [{section}] is none of {', '.join(SECTIONS)}")
    tables = {}
    for section, known in SECTIONS.items():
        if section in content:
            tables[section] = table_at(f"{file}: [{section}]", content[section])
            tables[section].require_known(known.split())
        elif section in required:
            raise DatasetError(f"{file}: section [{section}] is missing")
    return tables


def _points(file: Path, content: Mapping[str, Table]) -> SourcePoints | None:
    if "points" not in content:
        return None
    where = f"{file}: [points]"
    return read_points(inside(where, file.parent, content["points"].text("file")))


def _camera(where: str, keys: Table) -> SourceCamera:
    width_px, height_px = keys.whole("width_px"), keys.whole("height_px")
    fx_px = keys.number("fx_px")
    defaults = {"fy_px": fx_px, "cx_px": width_px / 2, "cy_px": height_px / 2}
    given = {key: keys.number(key, default=default) for key, default in defaults.items()}
    with blamed_on(where):
        intrinsics = Intrinsics(width_px, height_px, fx_px, **given)
    return SourceCamera(intrinsics, lens_of(where, keys.value("model", "PINHOLE"), keys))


def _timed_pictures(file: Path, keys: Table, intrinsics: Intrinsics) -> Sequence[TimedPicture]:
    where = f"{file}: [pictures]"
    if ("video" in keys) == ("folder" in keys):
        raise DatasetError(f"{where}: name either a 'video' or a 'folder'")
    every = keys.whole("every", Range(1), 1)
    timed = _video_pictures if "video" in keys else _folder_pictures
    return timed(where, file.parent, keys, intrinsics)[::every]


def _video_pictures(
    where: str, folder: Path, keys: Table, intrinsics: Intrinsics
) -> list[TimedPicture]:
    video = Video(inside(where, folder, keys.text("video")), intrinsics)
    stem = video.file.stem
    return [
        TimedPicture(f"{stem}_{i:06d}", time, partial(video.read, i))
        for i, time in enumerate(video.times_ns)
    ]


def _folder_pictures(
    where: str, folder: Path, keys: Table, intrinsics: Intrinsics
) -> list[TimedPicture]:
    pictures = inside(where, folder, keys.text("folder"))
    paths = sorted(path for path in pictures.glob("*") if path.suffix in SUFFIXES)
    if not paths:
        raise DatasetError(f"{where}: folder {pictures} holds no pictures ({', '.join(SUFFIXES)})")
    times_ns = _folder_times_ns(where, folder, keys, len(paths))
    for path in paths:
        check_size(path, intrinsics)
    return [
        TimedPicture(path.name, time, partial(read_picture, path, intrinsics))
        for path, time in zip(paths, times_ns, strict=True)
    ]


def _folder_times_ns(where: str, folder: Path, keys: Table, count: int) -> list[int]:
    if ("rate_hz" in keys) == ("times" in keys):
        raise DatasetError(f"{where}: a folder needs either 'rate_hz' or 'times'")
    if "rate_hz" in keys:
        rate_hz = keys.number("rate_hz")
        if rate_hz <= 0:
            raise keys.error("rate_hz", f"is {rate_hz}, must be above 0")
        return [round(i * NS_PER_S / rate_hz) for i in range(count)]
    file = inside(where, folder, keys.text("times"))
    lines = filled_lines(file)
    if len(lines) != count:
        raise DatasetError(f"{file}: holds {len(lines)} times for {count} pictures")
    return [time_ns(where, line) for where, line in lines]
