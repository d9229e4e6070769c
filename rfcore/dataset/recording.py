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
    k1 = -0.1                       # the lens: k1 k2 p1 p2 k3 (k4 k5 k6 of FULL_OPENCV)
                                    #   or k1..k4 of OPENCV_FISHEYE

    [pictures]
    video = "drive.mp4"             # or folder = "frames", in the order of the names, with
    rate_hz = 10.0                  #   rate_hz, or times = "times.txt", a time in seconds a line
                                    # or bag = "drive.mcap", an MCAP file or ROS 2 bag, with
                                    #   topics = ["/front/image", "/odom"] if it has several
    every = 1                       # take each n-th picture

    [trajectory]
    file = "trajectory.txt"         # TUM, or CSV if named .csv
    time_offset_s = 0.0             # time in the trajectory = time of the picture + offset
    max_gap_s = 1.0                 # no interpolation between poses further apart
    outside = "refuse"              # or "drop": leave out pictures the trajectory does not cover
    body_from_cam = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]   # default: it is the camera's

    [points]                        # may be left out
    file = "lidar.ply"              # coloured surface points in the trajectory's world

With a bag, [camera] and [trajectory] may be left out: they are the bag's (``rfcore.dataset.bag``).
A [trajectory] without a file is the bag's poses, of a body; ``body_from_cam`` is the camera on it.

The camera has OpenCV axes. A video's time starts at 0 with its first frame, a folder's with the
first picture (``rate_hz``) or where ``times`` says.

A video that phones mark as turned by 90 degrees is turned. ``width_px`` and ``height_px`` say
whether the camera is that of the frames as shown, or as stored: then it is turned with them. A
video that is turned by 180 degrees or mirrored is taken as shown.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

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
from rfcore.dataset.picture_file import PictureFile, picture_paths
from rfcore.dataset.picture_name import inside
from rfcore.dataset.source import Source, SourceCamera, SourcePicture, SourcePoints, read_points
from rfcore.dataset.trajectory import NS_PER_S, Trajectory, read_trajectory, time_ns
from rfcore.dataset.video import Video
from rfcore.errors import DatasetError
from rfcore.image import Rgb
from rfcore.tables import Range, Table
from rfcore.views import Mask

SECTIONS = {
    "camera": "model width_px height_px fx_px fy_px cx_px cy_px k1 k2 k3 k4 k5 k6 p1 p2",
    "pictures": "video folder rate_hz times every bag topics",
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
    mask: Callable[[], Mask] | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class TimedPictures:
    """The pictures of a recording and their camera.

    ``turn`` is composed after the trajectory's poses. ``notes`` says in a line each what is done.
    """

    pictures: Sequence[TimedPicture]
    camera: SourceCamera
    turn: Pose
    notes: tuple[str, ...] = ()


def read_recording_source(file: Path) -> Source:
    """Read a ``camera.toml`` and what it names. Raises ``DatasetError`` naming the file and key."""
    content = _load(file, required=("pictures",))
    if "bag" in content["pictures"]:
        return _bag_source(file, content)
    for section in REQUIRED:
        if section not in content:
            raise DatasetError(f"{file}: section [{section}] is missing")
    where = f"{file}: [camera]"
    camera = _camera(where, content["camera"])
    timed = _timed_pictures(file, content["pictures"], camera)
    poses = RecordedPoses.of(file, content["trajectory"])
    pictures = tuple(
        SourcePicture(
            where=f"{file}: {picture.name}",
            name=picture.name,
            camera=timed.camera,
            world_from_cam=poses.at(f"{file}: {picture.name}", picture.time_ns).compose(timed.turn),
            read=picture.read,
            time_ns=picture.time_ns + poses.offset_ns,
            mask=picture.mask,
            notes=picture.notes,
        )
        for picture in timed.pictures
        if poses.wanted(picture.time_ns)
    )
    dropped = len(timed.pictures) - len(pictures)
    anchor = anchor_at(str(file), content["anchor"].values if "anchor" in content else None)
    return Source(file, pictures, _points(file, content), dropped, anchor=anchor, notes=timed.notes)


def _bag_source(file: Path, content: Mapping[str, Table]) -> Source:
    from rfcore.dataset.bag import BagChoice, read_bag_source

    keys, where = content["pictures"], f"{file}: [pictures]"
    if other := [key for key in ("video", "folder", "rate_hz", "times") if key in keys]:
        raise DatasetError(f"{where}: a bag and '{other[0]}' exclude each other")
    topics = keys.items("topics") if "topics" in keys else []
    if not all(isinstance(topic, str) for topic in topics):
        raise keys.error("topics", f"is {topics}, not names of topics")
    camera = _camera(f"{file}: [camera]", content["camera"]) if "camera" in content else None
    poses, body_from_cam = None, None
    if "trajectory" in content and "file" in content["trajectory"]:
        poses = RecordedPoses.of(file, content["trajectory"])
    elif "trajectory" in content:
        content["trajectory"].require_known(["body_from_cam"])
        rows = content["trajectory"].matrix("body_from_cam", POSE_SHAPES)
        body_from_cam = pose_of_rows(f"{file}: [trajectory]", "body_from_cam", rows)
    choice = BagChoice(tuple(topics), camera, body_from_cam)
    found = read_bag_source(inside(where, file.parent, keys.text("bag")), choice, poses)
    anchor = anchor_at(str(file), content["anchor"].values if "anchor" in content else None)
    pictures = found.pictures[:: keys.whole("every", Range(1), 1)]
    return replace(found, pictures=pictures, points=_points(file, content), anchor=anchor)


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


def _timed_pictures(file: Path, keys: Table, camera: SourceCamera) -> TimedPictures:
    where = f"{file}: [pictures]"
    if ("video" in keys) == ("folder" in keys):
        raise DatasetError(f"{where}: name a 'video', a 'folder' or a 'bag'")
    every = keys.whole("every", Range(1), 1)
    timed = _video_pictures if "video" in keys else _folder_pictures
    found = timed(where, file.parent, keys, camera)
    return replace(found, pictures=found.pictures[::every])


def _video_pictures(where: str, folder: Path, keys: Table, camera: SourceCamera) -> TimedPictures:
    video = Video(inside(where, folder, keys.text("video")))
    index, k = video.index, camera.intrinsics
    stated_px, turn = (k.width_px, k.height_px), Pose.identity()
    notes = [f"{video.file.name}: {note}" for note in index.notes]
    if stated_px != video.size_px and stated_px == index.size_px:
        turn, camera = index.orientation.stored_from_shown, index.orientation.camera(camera)
        notes.append(f"{video.file.name}: its camera is turned with it")
    elif stated_px != video.size_px:
        raise DatasetError(
            f"{video.file}: video is {video.size_px[0]}x{video.size_px[1]} px, its camera says "
            f"{k.width_px}x{k.height_px}"
        )
    pictures = [
        TimedPicture(f"{video.file.stem}_{i:06d}", time, partial(video.read, i))
        for i, time in enumerate(index.times_ns)
    ]
    return TimedPictures(pictures, camera, turn, tuple(notes))


def _folder_pictures(where: str, folder: Path, keys: Table, camera: SourceCamera) -> TimedPictures:
    pictures = inside(where, folder, keys.text("folder"))
    paths = picture_paths(pictures)
    times_ns = _folder_times_ns(where, folder, keys, len(paths))
    opened = [PictureFile.of(path, camera.intrinsics) for path in paths]
    timed = [
        TimedPicture(picture.path.name, time, picture.read, picture.mask, picture.notes)
        for picture, time in zip(opened, times_ns, strict=True)
    ]
    return TimedPictures(timed, camera, Pose.identity())


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
