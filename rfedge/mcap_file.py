"""Write what vehicles show as MCAP, in Foxglove's published protobuf schemas, for any viewer of it.

Topics, for each camera: ``/VEHICLE/CAMERA/video`` (CompressedVideo: H.264 in Annex B without B
pictures, parameter sets before each key frame), ``.../calibration`` (CameraCalibration) and
``.../metrics`` (JSON). For all: ``/tf`` (FrameTransform), ``/objects`` (SceneUpdate), ``/field``
(PointCloud). Message times are those of capture, log times those of writing.

A camera's frame is ``VEHICLE/CAMERA_optical``, with OpenCV axes. Its parent is ``map``, the world
of the drives, where the field is at hand, which says where it is there; else ``field-ID``, the
field's axes.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager
from dataclasses import astuple, dataclass, replace
from fractions import Fraction
from importlib import import_module
from pathlib import Path
from types import TracebackType
from typing import Any

import av
import numpy as np
from av.video.codeccontext import VideoCodecContext

from rfcore.camera import Intrinsics, Pose, Vec3
from rfcore.extras import needs
from rfcore.field import RadianceField, SplatField
from rfcore.harmonics import SH_DC
from rfcore.image import I420, rgb_from_colour
from rfcore.perception.objects import StreetObject
from rfcore.vertical import Z_UP, upright_from
from rfedge.video import X264_SIGNAL, even_frame, tag_as_bt709

with needs("bags"):
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from mcap.writer import Writer

NS = 1_000_000_000
KEY_EVERY = 30
"""Pictures from one key frame to the next: a viewer that jumps waits for one."""
CRF = "18"
LEAST_OPACITY_LOGIT = -2.0
"""Splats fainter than 0.12 are no points."""
GONE_NS = NS
"""Objects are shown for so long, unless they are seen again."""
POINT_FIELDS = (("x", 0, 7), ("y", 4, 7), ("z", 8, 7), *zip(("red", "green", "blue", "alpha"), range(12, 16), (1,) * 4, strict=True))  # fmt: skip  # noqa: E501
"""Name, offset and type (7: float32, 1: uint8) of each value of a point."""


def foxglove(schema: str, /, **values: Any) -> Any:
    """Return a message of Foxglove's; ``timestamp`` is in nanoseconds."""
    message = getattr(import_module(f"foxglove_schemas_protobuf.{schema}_pb2"), schema)()
    if "timestamp" in values:
        message.timestamp.FromNanoseconds(values.pop("timestamp"))
    for key, value in values.items():
        field = getattr(message, key)
        if isinstance(value, list | tuple):
            field.extend(value)
        elif hasattr(field, "CopyFrom"):
            field.CopyFrom(value)
        else:
            setattr(message, key, value)
    return message


def _vector(name: str, xyz: Iterable[float]) -> Any:
    return foxglove(name, **dict(zip("xyz", map(float, xyz), strict=True)))


def _quaternion(wxyz: Iterable[float]) -> Any:
    return foxglove("Quaternion", **dict(zip("wxyz", map(float, wxyz), strict=True)))


def _pose(pose: Pose) -> Any:
    position = _vector("Vector3", pose.translation_m)
    return foxglove("Pose", position=position, orientation=_quaternion(pose.rotation))


def schema_of(message: Any) -> bytes:
    """Return the definition of a message and all that it imports, as MCAP has it."""
    found: dict[str, Any] = {}

    def add(file: Any) -> None:
        for other in file.dependencies:
            add(other)
        found[file.name] = file

    add(message.DESCRIPTOR.file)
    files = FileDescriptorSet()
    for file in found.values():
        file.CopyToProto(files.file.add())
    return files.SerializeToString()


class VideoEncoder:
    """Codes one camera's pictures of one size; each is complete when it is returned."""

    def __init__(self, size_px: tuple[int, int]) -> None:
        context = av.CodecContext.create("libx264", "w")
        assert isinstance(context, VideoCodecContext)
        context.width, context.height = (side // 2 * 2 for side in size_px)
        context.thread_count = 1  # more would hold pictures back
        context.time_base = Fraction(1, KEY_EVERY)
        tag_as_bt709(context)
        context.options = {
            "crf": CRF,
            "preset": "veryfast",
            "tune": "zerolatency",
            "bf": "0",
            "g": str(KEY_EVERY),
            "x264-params": f"{X264_SIGNAL}:repeat-headers=1:sliced-threads=0",
        }
        self._context, self._count = context, 0

    def encode(self, picture: I420) -> bytes:
        """Return the picture's access unit; an odd last row or column is cut off."""
        (packet,) = self._context.encode(even_frame(picture, self._count))
        self._count += 1
        return bytes(packet)


@dataclass(frozen=True)
class ShownPicture:
    """A picture and where it was taken, in the axes of its field; ``metrics`` are numbers."""

    vehicle_id: str
    camera_id: str
    time_ns: int
    planes: I420
    intrinsics: Intrinsics
    pose: Pose | None
    field_id: str
    metrics: Mapping[str, float]

    @property
    def name(self) -> str:
        """Vehicle and camera."""
        return f"{self.vehicle_id}/{self.camera_id}"

    @property
    def frame_id(self) -> str:
        """The camera's frame, called as REP 103 has it."""
        return f"{self.name}_optical"


class McapFile(AbstractContextManager["McapFile"]):
    """A file of MCAP that is complete once it is closed; a reader may follow it before.

    ``field`` is shown as points, and says where its axes are in the world. May be called from
    several threads.
    """

    def __init__(self, path: Path, field: RadianceField | None = None) -> None:
        self._path, self._field = path, field
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("wb")
        self._writer = Writer(self._file)
        self._writer.start(library="rfedge")
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._videos: dict[tuple[str, Intrinsics], VideoEncoder] = {}
        self._newest_ns: dict[str, int] = {}
        self._lock = threading.Lock()
        self._shows_field = False
        self.late = 0
        """Pictures left out so far: not taken later than the one before of their camera."""

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with self._lock:
            self._writer.finish()
            self._file.close()

    def show(self, picture: ShownPicture, now_ns: int) -> None:
        """Add a picture with its calibration, pose and metrics."""
        name, time_ns = picture.name, picture.time_ns
        with self._lock:
            if time_ns <= self._newest_ns.get(name, -1):
                self.late += 1
                return
            self._newest_ns[name] = time_ns
            if not self._shows_field:
                self._shows_field = True
                self._show_field(time_ns, now_ns)
            if picture.pose is not None:
                self._write("/tf", _transform(picture, *self._placed(picture)), now_ns)
            calibration = _calibration(picture)
            self._write(f"/{name}/calibration", calibration, now_ns)
            key = (name, picture.intrinsics)
            if key not in self._videos:
                self._videos[key] = VideoEncoder(picture.planes.size_px)
            data = self._videos[key].encode(picture.planes)
            keys = {"timestamp": time_ns, "frame_id": picture.frame_id, "format": "h264"}
            video = foxglove("CompressedVideo", **keys, data=data)
            self._write(f"/{name}/video", video, now_ns)
            self._write_json(f"/{name}/metrics", picture.metrics, now_ns)

    def show_objects(
        self, field_id: str, objects: Iterable[StreetObject], time_ns: int, now_ns: int
    ) -> None:
        """Add the objects of one moment, as boxes that stand upright."""
        field = self._field
        up = field.metadata.vertical if field is not None else Z_UP
        turn = upright_from(up).inverse()
        with self._lock:
            if self._file.closed:
                return
            frame, origin = self._frame_of(field_id)
            entities = [_entity(frame, origin, one, time_ns, up, turn) for one in objects]
            self._write("/objects", foxglove("SceneUpdate", entities=entities), now_ns)

    def _placed(self, picture: ShownPicture) -> tuple[str, Pose]:
        assert picture.pose is not None
        frame, origin = self._frame_of(picture.field_id)
        x, y, z = picture.pose.translation_m
        moved = (x + origin[0], y + origin[1], z + origin[2])
        return frame, replace(picture.pose, translation_m=moved)

    def _frame_of(self, field_id: str) -> tuple[str, Vec3]:
        """Return the frame of what is placed in a field, and the origin of its axes there."""
        if self._field is not None and self._field.field_id == field_id:
            east, north, up = astuple(self._field.metadata.tile_origin)
            return "map", (east, north, up)
        return f"field-{field_id[:8]}", (0.0, 0.0, 0.0)

    def _show_field(self, time_ns: int, now_ns: int) -> None:
        if not isinstance(self._field, SplatField):
            return
        splats = self._field.gaussians
        shown = splats.opacity_logits > LEAST_OPACITY_LOGIT
        points = np.empty(int(shown.sum()), [("xyz", "<f4", 3), ("rgba", "u1", 4)])
        points["xyz"] = splats.means[shown]
        points["rgba"][:, :3] = rgb_from_colour(splats.sh[shown, 0] * SH_DC + 0.5)
        points["rgba"][:, 3] = 255
        frame, origin = self._frame_of(self._field.field_id)
        fields = [
            foxglove("PackedElementField", name=name, offset=offset, type=kind)
            for name, offset, kind in POINT_FIELDS
        ]
        cloud = foxglove(
            "PointCloud",
            timestamp=time_ns,
            frame_id=frame,
            pose=_pose(Pose(origin, (1.0, 0.0, 0.0, 0.0))),
            point_stride=points.itemsize,
            fields=fields,
            data=points.tobytes(),
        )
        self._write("/field", cloud, now_ns)

    def _write(self, topic: str, message: Any, now_ns: int) -> None:
        name = message.DESCRIPTOR.full_name
        if topic not in self._channels:
            if name not in self._schemas:
                definition = schema_of(message)
                self._schemas[name] = self._writer.register_schema(name, "protobuf", definition)
            schema = self._schemas[name]
            self._channels[topic] = self._writer.register_channel(topic, "protobuf", schema)
        channel, data = self._channels[topic], message.SerializeToString()
        self._writer.add_message(channel, now_ns, data, publish_time=now_ns)

    def _write_json(self, topic: str, values: Mapping[str, float], now_ns: int) -> None:
        if topic not in self._channels:
            kinds = {name: {"type": "number"} for name in values}
            definition = json.dumps({"type": "object", "properties": kinds}).encode()
            schema = self._writer.register_schema("rfedge.Metrics", "jsonschema", definition)
            self._channels[topic] = self._writer.register_channel(topic, "json", schema)
        data = json.dumps(dict(values)).encode()
        self._writer.add_message(self._channels[topic], now_ns, data, publish_time=now_ns)


def _transform(picture: ShownPicture, parent: str, pose: Pose) -> Any:
    return foxglove(
        "FrameTransform",
        timestamp=picture.time_ns,
        parent_frame_id=parent,
        child_frame_id=picture.frame_id,
        translation=_vector("Vector3", pose.translation_m),
        rotation=_quaternion(pose.rotation),
    )


def _calibration(picture: ShownPicture) -> Any:
    """Return the pinhole of a video's pictures; pixel centres are at whole numbers there."""
    k = picture.intrinsics
    cx, cy = k.cx_px - 0.5, k.cy_px - 0.5
    return foxglove(
        "CameraCalibration",
        timestamp=picture.time_ns,
        frame_id=picture.frame_id,
        width=k.width_px // 2 * 2,
        height=k.height_px // 2 * 2,
        K=(k.fx_px, 0, cx, 0, k.fy_px, cy, 0, 0, 1),
        R=(1, 0, 0, 0, 1, 0, 0, 0, 1),
        P=(k.fx_px, 0, cx, 0, 0, k.fy_px, cy, 0, 0, 0, 1, 0),
    )


def _entity(frame: str, origin: Vec3, one: StreetObject, time_ns: int, up: Vec3, turn: Pose) -> Any:
    parts = zip(origin, one.at_m, up, strict=True)
    x, y, z = (at + foot + 0.5 * one.height_m * along for at, foot, along in parts)
    alpha = 0.3 if one.is_doubtful else 0.7
    cube = foxglove(
        "CubePrimitive",
        pose=_pose(Pose((x, y, z), turn.rotation)),
        size=_vector("Vector3", (one.width_m, one.width_m, one.height_m)),
        color=foxglove("Color", r=1.0, g=0.6, b=0.0, a=alpha),
    )
    speed = {name: f"{value:.3f}" for name, value in zip("xyz", one.velocity_mps, strict=True)}
    values = {
        "confidence": f"{one.confidence:.2f}",
        "label": one.label,
        **{f"velocity_{name}_mps": value for name, value in speed.items()},
    }
    entity = foxglove(
        "SceneEntity",
        timestamp=time_ns,
        frame_id=frame,
        id=str(one.object_id),
        cubes=[cube],
        metadata=[foxglove("KeyValuePair", key=k, value=v) for k, v in values.items() if v],
    )
    entity.lifetime.FromNanoseconds(GONE_NS)
    return entity
