"""An MCAP file or a ROS 2 bag as a dataset: one camera's pictures at the poses of its transforms.

* **Time** is the header's stamp; the log time only where a whole topic states none.
* **Camera**: ``CameraInfo`` beside the pictures, its lens by name. ROS has pixel centres at whole
  numbers, so half a pixel is added to cx and cy. ROI and binning are applied. Of rectified pictures
  (a topic called ``image_rect...``) the matrix P counts, without a lens.
* **Poses**: the transforms from the pictures' frame up to ``map``, else ``odom``, else the root; or
  a topic of poses, where transforms do not lead there or one is named. ``PoseStamped`` does not say
  which frame it is of: ``body_from_cam`` of a camera.toml does.

Nothing is chosen among several: the topics that are meant are to be named. Pictures without a pose
are left out, which is said.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from pathlib import Path
from threading import Lock
from typing import Protocol

import av

from rfcore.bag_reader import NS, PICTURES, Head
from rfcore.camera import Intrinsics, Pose
from rfcore.dataset.bag_records import PictureDecoder, at_s, bag_records, check_encoding
from rfcore.dataset.bag_transforms import STEP_NS, FrameTree
from rfcore.dataset.keys import blamed_on, lens_of, pose_of_quaternion, table_at
from rfcore.dataset.source import Source, SourceCamera, SourcePicture
from rfcore.errors import DatasetError
from rfcore.image import Rgb, rgb_from_video_frame

MAX_GAP_NS = NS
LENSES = {
    "": ("PINHOLE", ()),
    "plumb_bob": ("OPENCV", ("k1", "k2", "p1", "p2", "k3")),
    "rational_polynomial": ("FULL_OPENCV", ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "equidistant": ("OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")),
    "kannala_brandt": ("OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")),
}
"""The model and the coefficients of D, by distortion_model."""


@dataclass(frozen=True)
class BagTopic:
    """A topic of a bag; ``refused``: why it is not understood, "" if it is."""

    name: str
    type: str
    count: int
    first_ns: int
    last_ns: int
    refused: str

    @property
    def rate_hz(self) -> float:
        """Mean rate by the log times; 0 for a single message."""
        return (self.count - 1) * NS / max(1, self.last_ns - self.first_ns)


@dataclass
class BagIndex:
    """Everything in a bag but the bytes of its pictures, by topic and kind, in the file's order."""

    path: Path
    topics: list[BagTopic]
    pictures: dict[str, list[Head]] = field(default_factory=dict)
    cameras: dict[str, list[Head]] = field(default_factory=dict)
    poses: dict[str, list[Head]] = field(default_factory=dict)
    fixes: dict[str, list[Head]] = field(default_factory=dict)
    tree: FrameTree = field(default_factory=FrameTree)
    notes: list[str] = field(default_factory=list)

    @staticmethod
    def of(path: Path, topics: Sequence[str] = ()) -> BagIndex:
        """Read a bag once; of pictures and poses only ``topics``, if any are named.

        Raises ``DatasetError`` by topic and time for what is wrong, and for a topic that is not
        there.
        """
        index = BagIndex(path, [])
        places = {"camera": index.cameras, "pose": index.poses, "fix": index.fixes}
        places |= dict.fromkeys(PICTURES, index.pictures)
        for head, _ in bag_records(path):
            kind, topic = head["kind"], str(head.get("topic"))
            if kind == "topics":
                index.topics = [BagTopic(name, **values) for name, values in head["topics"].items()]
                index.notes += head["cut"]
            elif kind == "transforms":
                for parent, child, stamp_ns, *pose in head["transforms"]:
                    index.tree.add(f"{path}: {topic}", parent, child, stamp_ns, pose)
            elif not topics or topic in topics or kind == "camera":
                places[kind].setdefault(topic, []).append(head)
        known = {topic.name for topic in index.topics}
        for name in topics:
            if name not in known:
                listed = ", ".join(sorted(known)) or "none"
                raise DatasetError(f"{path}: has no topic '{name}'; its topics: {listed}")
        for heads in (*index.pictures.values(), *index.poses.values(), *index.fixes.values()):
            index._settle_times(heads)
        return index

    def _settle_times(self, heads: list[Head]) -> None:
        """Take the log times where a topic states none; refuse clocks that go back."""
        topic = heads[0]["topic"]
        if not any(head["stamp_ns"] for head in heads):
            self.notes.append(f"{topic} states no times of capture: the log times are taken")
            for head in heads:
                head["stamp_ns"] = head["log_ns"]
        late_ns = heads[0]["log_ns"] - heads[0]["stamp_ns"]
        if abs(late_ns) > 10 * NS:
            self.notes.append(
                f"{topic} was recorded {late_ns / NS:.3f} s after its stamps: these are taken"
            )
        for before, after in pairwise(heads):
            step_ns = after["stamp_ns"] - before["stamp_ns"]
            drift_ns = step_ns - (after["log_ns"] - before["log_ns"])
            if step_ns <= 0 or abs(drift_ns) > 10 * STEP_NS:
                raise DatasetError(
                    f"{self.path}: {topic}, {at_s(after)}: the clock steps by {step_ns / NS:.3f} s "
                    f"after {at_s(before)}, while {(step_ns - drift_ns) / NS:.3f} s were recorded; "
                    "cut the bag there"
                )


@dataclass(frozen=True)
class BagChoice:
    """A camera.toml's choice in a bag: ``topics`` that are meant, and what stands in for its own
    camera and mounting."""

    topics: tuple[str, ...] = ()
    camera: SourceCamera | None = None
    body_from_cam: Pose | None = None


class PosesOverTime(Protocol):
    """Poses that a camera.toml names, instead of the bag's: ``RecordedPoses``."""

    def wanted(self, time_ns: int) -> bool:
        """Return whether a picture of that time is to be kept."""

    def at(self, where: str, time_ns: int) -> Pose:
        """Return world_from_cam."""


def read_bag_source(
    path: Path, choice: BagChoice = BagChoice(), poses: PosesOverTime | None = None
) -> Source:
    """Read a bag as a dataset. Raises ``DatasetError`` by topic and time."""
    index = BagIndex.of(path, choice.topics)
    heads = chosen_pictures(index)
    topic, where = heads[0]["topic"], f"{path}: {heads[0]['topic']}"
    changes = {check_encoding(f"{where}, {at_s(head)}", head) for head in heads}
    notes = [f"pictures of {topic} {change}" for change in sorted(changes) if change]
    reader = BagPictures(path, heads)
    if reader.first:
        notes.append(f"{reader.first} pictures of {topic} come before its first key frame")
    camera = choice.camera or bag_camera(index, heads, reader, notes)
    pose_of = (
        partial(_given_pose, poses, where) if poses else bag_poses(index, heads, choice, notes)
    )
    pictures, left_out = [], []
    for i, head in enumerate(heads[reader.first :], reader.first):
        pose = pose_of(head["stamp_ns"])
        if pose is None:
            left_out.append(head)
            continue
        place = f"{where}, {at_s(head)}"
        name = f"{topic.strip('/').replace('/', '_')}_{i:06d}"
        read = partial(reader.read, i)
        pictures.append(SourcePicture(place, name, camera, pose, read, head["stamp_ns"]))
    if left_out:
        said = f"{len(left_out)} of {len(heads)} pictures of {topic} have no pose within 1 s"
        said += f" (first {at_s(left_out[0])}, last {at_s(left_out[-1])})"
        if not pictures:
            raise DatasetError(f"{path}: {said}; {_covered(index)}")
        notes.append(f"{said}: left out")
    feeds = pose_feeds(index, notes)
    return Source(path, tuple(pictures), notes=(*index.notes, *notes), feeds=feeds)


def _given_pose(poses: PosesOverTime, where: str, time_ns: int) -> Pose | None:
    return poses.at(f"{where}, {time_ns / NS:.3f} s", time_ns) if poses.wanted(time_ns) else None


def _covered(index: BagIndex) -> str:
    moving = [(name, edge) for name, edge in index.tree.edges.items() if not edge.is_static]
    spans = [
        f"{name} in {edge.parent} by {edge.topic.rpartition(': ')[2]}: "
        f"{min(edge.samples) / NS:.3f}..{max(edge.samples) / NS:.3f} s"
        for name, edge in moving
    ]
    spans += [
        f"{topic}: {heads[0]['stamp_ns'] / NS:.3f}..{heads[-1]['stamp_ns'] / NS:.3f} s"
        for topic, heads in index.poses.items()
    ]
    return "poses are there of " + ("; ".join(spans) or "no time at all")


def chosen_pictures(index: BagIndex) -> list[Head]:
    """Return the records of the one camera; raise ``DatasetError`` for none, and for several."""
    path = index.path
    if not index.pictures:
        refused = "; ".join(f"{t.name} is {t.type}, {t.refused}" for t in index.topics if t.refused)
        raise DatasetError(f"{path}: holds no pictures that are read ({refused or 'no topics'})")
    if len(index.pictures) > 1:
        names = ", ".join(index.pictures)
        raise DatasetError(
            f"{path}: holds several cameras ({names}): name the topics of one, "
            f"--topics {next(iter(index.pictures))}"
        )
    (heads,) = index.pictures.values()
    first = heads[0]
    for head in heads:
        if head["frame"] != first["frame"]:
            raise DatasetError(
                f"{path}: {head['topic']}, {at_s(head)}: frame '{head['frame']}' after "
                f"'{first['frame']}': two cameras share the topic; record each in its own"
            )
        sizes = [(one.get("width"), one.get("height")) for one in (first, head)]
        if sizes[0] != sizes[1]:
            raise DatasetError(
                f"{path}: {head['topic']}, {at_s(head)}: {sizes[1][0]}x{sizes[1][1]} px after "
                f"{sizes[0][0]}x{sizes[0][1]} px: two cameras share the topic; "
                "record each in its own"
            )
    return heads


class BagPictures:
    """The pictures of one topic by their number; cheap in order, like the frames of a video."""

    def __init__(self, path: Path, heads: Sequence[Head]) -> None:
        self._path, self._heads = path, heads
        self._where = f"{path}: {heads[0]['topic']}"
        keys = [i for i, head in enumerate(heads) if head.get("key", True)]
        if not keys:
            raise DatasetError(f"{self._where}: holds no key frame, without which none is decoded")
        self._keys, self.first = keys, keys[0]
        self._lock = Lock()
        self._frames: Iterator[tuple[int, av.VideoFrame]] = iter(())
        self._next = len(heads)
        self._shape: tuple[int, ...] = ()

    def read(self, number: int) -> Rgb:
        """Return a picture as uint8 [H, W, 3]."""
        with self._lock:
            if number < self._next:
                self._frames, self._next = self._decoded(number), 0
            for i, frame in self._frames:
                self._next = i + 1
                if i == number:
                    return self._checked(i, rgb_from_video_frame(frame, self._where))
        raise DatasetError(f"{self._where}, {at_s(self._heads[number])}: is no longer there")

    def _checked(self, number: int, rgb: Rgb) -> Rgb:
        self._shape = self._shape or rgb.shape
        if rgb.shape != self._shape:
            raise DatasetError(
                f"{self._where}, {at_s(self._heads[number])}: {rgb.shape[1]}x{rgb.shape[0]} px, "
                f"the first one {self._shape[1]}x{self._shape[0]}: two cameras share the topic; "
                "record each in its own"
            )
        return rgb

    def size_px(self) -> tuple[int, int]:
        """Return width and height of the first picture."""
        if "width" in self._heads[0]:
            return self._heads[0]["width"], self._heads[0]["height"]
        height, width, _ = self.read(self.first).shape
        return width, height

    def _decoded(self, number: int) -> Iterator[tuple[int, av.VideoFrame]]:
        """Yield numbers and frames from ``number`` on; video from the key frame before it."""
        begin = max(key for key in self._keys if key <= number)
        decoder = PictureDecoder(self._where)
        count = 0
        numbers: dict[int, int] = {}
        for head, data in bag_records(self._path, [self._heads[0]["topic"]], data=True):
            if head["kind"] == "topics":
                frames = decoder.end()
            elif count < begin:
                count, frames = count + 1, iter(())
            else:
                numbers[id(head)] = count
                count, frames = count + 1, decoder.frames(head, data)
            for made_of, frame in frames:
                yield numbers.pop(id(made_of)), frame


def bag_camera(
    index: BagIndex, heads: Sequence[Head], reader: BagPictures, notes: list[str]
) -> SourceCamera:
    """Return the camera of a topic of pictures by its ``CameraInfo``."""
    topic, frame = str(heads[0]["topic"]), heads[0]["frame"]
    parts = topic.split("/")
    beside = ["/".join([*parts[:n], "camera_info"]) for n in range(len(parts) - 1, 0, -1)]
    of_frame = [name for name, infos in index.cameras.items() if infos[0]["frame"] == frame]
    found = [name for name in beside if name in index.cameras][:1] or of_frame
    if len(found) != 1:
        raise DatasetError(
            f"{index.path}: {topic}: {len(found)} topics state its camera, of frame '{frame}' "
            f"(there are: {', '.join(index.cameras) or 'none'}); give the camera in a camera.toml"
        )
    infos = index.cameras[found[0]]
    where = f"{index.path}: {found[0]}"
    for info in infos:
        if any(info[key] != infos[0][key] for key in ("width", "height", "k", "d", "p", "model")):
            raise DatasetError(f"{where}, {at_s(info)}: the camera changes; cut the bag there")
    rectified = any(part.startswith("image_rect") for part in parts)
    return camera_of_info(where, infos[0], reader.size_px(), rectified, notes)


def camera_of_info(
    where: str, info: Head, size_px: tuple[int, int], rectified: bool, notes: list[str]
) -> SourceCamera:
    """Return the camera of pictures of (width, height) px; what is applied goes to ``notes``."""
    k = info["p"][:3] + info["p"][4:7] if rectified else info["k"][:6]
    fx, skew, cx, _, fy, cy = k
    if not (fx > 0 and fy > 0) or skew:
        raise DatasetError(f"{where}: focal lengths {fx:g}, {fy:g}, skew {skew:g}: not calibrated")
    (x, y, width, height), (bin_x, bin_y) = info.get("roi", (0,) * 4), info.get("binning", (1, 1))
    full = (width or info["width"], height or info["height"])
    stated_px = (full[0] // bin_x, full[1] // bin_y)
    if stated_px != size_px:
        raise DatasetError(
            f"{where}: states {stated_px[0]}x{stated_px[1]} px, the pictures are "
            f"{size_px[0]}x{size_px[1]}"
        )
    if (x, y, bin_x, bin_y) != (0, 0, 1, 1):
        notes.append(f"{where}: ROI from {x}, {y} px and binning {bin_x}x{bin_y} are applied")
    with blamed_on(where):
        intrinsics = Intrinsics(
            *size_px, fx / bin_x, fy / bin_y, (cx + 0.5 - x) / bin_x, (cy + 0.5 - y) / bin_y
        )
    if rectified:
        notes.append(f"{where}: the pictures are rectified: P is taken, without a lens")
        return SourceCamera(intrinsics)
    d = info["d"]
    if info["model"] not in LENSES or (d and not info["model"]):
        names = ", ".join(name for name in LENSES if name)
        raise DatasetError(f"{where}: distortion_model '{info['model']}' is none of {names}")
    model, coefficients = LENSES[info["model"]]
    if any(d[len(coefficients) :]) or 0 < len(d) < min(4, len(coefficients)):
        raise DatasetError(f"{where}: D has {len(d)} values, {info['model']} {len(coefficients)}")
    keys = table_at(where, dict(zip(coefficients, d, strict=False)))
    return SourceCamera(intrinsics, lens_of(where, model, keys))


class PoseAt(Protocol):
    """world_from_cam at a time, None where it is not known."""

    def __call__(self, time_ns: int, /) -> Pose | None: ...


def bag_poses(
    index: BagIndex, heads: Sequence[Head], choice: BagChoice, notes: list[str]
) -> PoseAt:
    """Return the poses of a bag's camera; what they are goes to ``notes``."""
    frame, path = heads[0]["frame"], index.path
    named = [topic for topic in index.poses if topic in choice.topics]
    world = index.tree.world_above(frame) if not named else None
    if world is not None:
        notes.append(f"poses: transforms of '{frame}' in '{world}'")
        _note_axes(frame, choice, notes)
        own = choice.body_from_cam or Pose.identity()

        def by_tree(time_ns: int) -> Pose | None:
            pose = index.tree.pose(world, frame, time_ns, MAX_GAP_NS)
            return None if pose is None else pose.compose(own)

        return by_tree
    candidates = named or list(index.poses)
    if len(candidates) != 1:
        raise DatasetError(
            f"{path}: no transform that moves leads from '{frame}' up (frames above it: "
            f"{', '.join(index.tree.above(frame)[1:]) or 'none'}), and {len(candidates)} topics "
            f"state poses ({', '.join(candidates) or 'none'}): name one with --topics, or give a "
            "trajectory in a camera.toml"
        )
    return _poses_of_topic(index, candidates[0], frame, choice, notes)


def _poses_of_topic(
    index: BagIndex, topic: str, frame: str, choice: BagChoice, notes: list[str]
) -> PoseAt:
    first = index.poses[topic][0]
    world, child = first["frame"], first["child"]
    moving = FrameTree()
    for head in index.poses[topic]:
        at = f"{index.path}: {topic}"
        moving.add(at, head["frame"], head["child"] or "?", head["stamp_ns"], head["pose"])
    body_from_cam = choice.body_from_cam
    if body_from_cam is None and child == frame:
        body_from_cam = Pose.identity()
    if body_from_cam is None and child:
        body_from_cam = index.tree.pose(child, frame, first["stamp_ns"], MAX_GAP_NS)
    if body_from_cam is None:
        of = f"of '{child}', from which no transform leads to '{frame}'" if child else "of no frame"
        raise DatasetError(
            f"{index.path}: {topic}: its poses are {of}; state body_from_cam in a camera.toml"
        )
    mounted = body_from_cam
    notes.append(f"poses: {topic}, of '{child or 'a frame that is not stated'}' in '{world}'")

    def by_topic(time_ns: int) -> Pose | None:
        pose = moving.edges[child or "?"].at(time_ns, MAX_GAP_NS)
        return None if pose is None else pose.compose(mounted)

    return by_topic


def _note_axes(frame: str, choice: BagChoice, notes: list[str]) -> None:
    if "optical" not in frame and choice.body_from_cam is None:
        notes.append(
            f"frame '{frame}' is not called optical; its axes are taken as x right, y down, z "
            "forward. If it is a body's, state body_from_cam in a camera.toml"
        )


def pose_feeds(index: BagIndex, notes: list[str]) -> dict[str, list[str]]:
    """Return the lines of JSON of each pose feed in a bag, as ``cav-agent --pose-feed`` reads them.

    A pose is that of its vehicle's frame (x forward, y left, z up), a fix that of the antenna.
    """
    feeds = {}
    for topic, heads in index.fixes.items():
        fixes = [head for head in heads if head["has_fix"]]
        if len(fixes) < len(heads):
            notes.append(f"{topic}: {len(heads) - len(fixes)} messages without a fix are left out")
        feeds[topic] = [_fix_line(head) for head in fixes]
    for topic, heads in index.poses.items():
        feeds[topic] = [_pose_line(f"{index.path}: {topic}, {at_s(head)}", head) for head in heads]
    return {topic: lines for topic, lines in feeds.items() if lines}


def _fix_line(head: Head) -> str:
    height = {"height_m": head["altitude"]} if math.isfinite(head["altitude"]) else {}
    place = {"latitude_deg": head["latitude"], "longitude_deg": head["longitude"]}
    return _feed_line(head, place | height, head["covariance"][::4])


def _pose_line(where: str, head: Head) -> str:
    pose = pose_of_quaternion(where, head["pose"][:3], head["pose"][3:])
    place = dict(zip(("x_m", "y_m", "z_m"), pose.translation_m, strict=True))
    return _feed_line(head, place | {"quaternion": list(pose.rotation)}, head["covariance"][:3])


def _feed_line(head: Head, values: Mapping[str, object], variances: Sequence[float]) -> str:
    """Return a line; ROS leaves zeros where no covariance is known."""
    is_stated = len(variances) == 3 and all(math.isfinite(v) and v > 0 for v in variances)
    stated = {"covariance_m2": list(variances)} if is_stated else {}
    return json.dumps({"time_s": head["stamp_ns"] / NS, **values, **stated})
