"""Read MCAP files and ROS 2 bags in a process without rights, which hands back plain records.

``python -m rfcore.bag_reader CONFINEMENT ASKED`` confines itself, says so with one byte,
and writes records to its standard output: the length of a line of JSON (32 bits, little-endian),
the line, and as many bytes as its key ``bytes`` says. ``ASKED`` is the JSON of ``Asked``; files are
open descriptors. A record has

* ``topic``, ``log_ns`` (when it was recorded), ``stamp_ns`` (when it was taken; 0: not stated),
  ``frame``, and ``kind``: image, still, video, camera, transforms, pose or fix; or it is
* ``topics``, the last one: what every topic holds, and whether the file was cut; or ``wrong``; or
* ``idle``: a file that grows has no more yet.

ROS 2 messages are read by the definitions in the file; bags of SQLite from before ROS 2 Iron have
none, and are read by those of Humble. Messages of Foxglove are read as protobuf.
"""

from __future__ import annotations

import json
import os
import sqlite3
import struct
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from importlib import import_module
from threading import Event
from typing import Any, BinaryIO

from rfcore.confinement.confine import Confinement, ProcessLimits, confine
from rfcore.confinement.start import READY
from rfcore.extras import needs

with needs("bags"):
    import lz4.frame  # noqa: F401 (MCAP's chunks; nothing can be imported in the sandbox)
    import zstandard
    from mcap.exceptions import McapError
    from mcap.records import Channel, Message, Schema
    from mcap.stream_reader import CRCValidationError, StreamReader
    from rosbags.serde import SerdeError
    from rosbags.typesys import (
        Stores,
        TypesysError,
        get_types_from_idl,
        get_types_from_msg,
        get_typestore,
    )

Head = dict[str, Any]
LENGTH = struct.Struct("<I")
READER_BYTES = 3 << 30
"""Address space of the reader, beside three times what a bag of SQLite takes: one is in memory."""
NS = 1_000_000_000
FOLLOW_EVERY_S, IDLE_EVERY = 0.02, 50
"""Pause at the end of a file that grows, and pauses after which a record says that it waits."""
IDR, SLICES = 5, (1, 5)
"""Types of NAL units of H.264: of a key frame, of any frame."""


@dataclass(frozen=True)
class Asked:
    """A request: ``files`` are descriptors and names, in order; ``None`` are all topics.

    ``data``: the pictures' bytes, too. ``follow``: wait at the end for what is written next.
    """

    files: list[tuple[int, str]]
    topics: list[str] | None = None
    data: bool = False
    follow: bool = False


class BagIsCut(Exception):
    """The file ends within a record."""


class CannotRead(Exception):
    """A bag or a message cannot be read; the text says why."""


@dataclass
class TopicSummary:
    """One topic: its type, its messages, the first and last log time; why it is not understood."""

    type: str
    count: int = 0
    first_ns: int = 0
    last_ns: int = 0
    refused: str = ""


@dataclass(frozen=True)
class RawMessage:
    """A message as it is stored; ``definition`` is its schema's text (``encoding`` says which)."""

    topic: str
    type: str
    form: str
    """cdr or protobuf, or what is not read."""
    log_ns: int
    data: bytes
    encoding: str = ""
    definition: bytes = b""


class ExactFile:
    """A file whose reads are whole; at its end it raises ``BagIsCut``, or waits for more."""

    def __init__(self, file: BinaryIO, follow: bool, idle: Callable[[], None]) -> None:
        self._file, self._follow, self._idle = file, follow, idle
        self._pauses = 0
        self._pause = Event()  # whose system call is allowed, where that of sleep is not

    def read(self, count: int) -> bytes:
        """Return ``count`` bytes."""
        data = self._file.read(count)
        while len(data) < count:
            if not self._follow:
                raise BagIsCut
            self._pause.wait(FOLLOW_EVERY_S)
            self._pauses += 1
            if self._pauses % IDLE_EVERY == 0:
                self._idle()
            data += self._file.read(count - len(data))
        return data


def mcap_messages(file: ExactFile) -> Iterator[RawMessage]:
    """Yield the messages of an MCAP file in the order of the file, which may still grow."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    try:
        for record in StreamReader(file, validate_crcs=True).records:
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                channel = channels[record.channel_id]
                schema = schemas.get(channel.schema_id) or Schema(0, b"", "", "")
                yield RawMessage(
                    *(channel.topic, schema.name, channel.message_encoding),
                    *(record.log_time, record.data, schema.encoding, schema.data),
                )
    except KeyError as error:
        raise CannotRead(f"a message names channel {error}, which is not declared") from error
    except (McapError, CRCValidationError, struct.error, UnicodeDecodeError) as error:
        raise CannotRead(f"is damaged: {type(error).__name__} {error}".strip()) from error
    except (zstandard.ZstdError, RuntimeError, ValueError) as error:
        raise CannotRead(f"a chunk cannot be unpacked: {error}") from error


WAL_AT, JOURNAL = slice(18, 20), b"\x01\x01"
"""Bytes of SQLite's header that ask for a file of the log, which a database in memory has not."""


def sqlite_messages(content: bytearray) -> Iterator[RawMessage]:
    """Yield the messages of a bag of SQLite in the order of their log times."""
    if content[WAL_AT] == b"\x02\x02":
        content[WAL_AT] = JOURNAL
    connection = sqlite3.connect(":memory:")
    try:
        connection.deserialize(bytes(content))
        content.clear()
        tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master")}
        definitions = {}
        if "message_definitions" in tables:
            rows = connection.execute(
                "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            )
            definitions = {
                name: (kind, text.encode()) for name, kind, text in _typed(rows, (str, str, str))
            }
        rows = connection.execute(
            "SELECT topics.name, topics.type, topics.serialization_format, timestamp, data "
            "FROM messages JOIN topics ON topics.id = topic_id ORDER BY timestamp, messages.id"
        )
        for topic, name, form, log_ns, data in _typed(rows, (str, str, str, int, bytes)):
            yield RawMessage(topic, name, form, log_ns, data, *definitions.get(name, ()))
    except sqlite3.Error as error:
        raise CannotRead(f"is no whole bag of SQLite: {error}") from error


def _typed(rows: Iterable[Any], types: tuple[type, ...]) -> Iterator[Any]:
    """Yield rows of these types: any column of SQLite may hold anything."""
    for row in rows:
        if tuple(map(type, row)) != types:
            raise CannotRead(f"is no whole bag of SQLite: {str(row)[:80]} is no row of it")
        yield row


class RosDecoder:
    """Decodes CDR by the definition that comes with a message, by Humble's where none does."""

    def __init__(self) -> None:
        self._stores: dict[tuple[str, bytes], Any] = {}

    def decode(self, message: RawMessage) -> Any:
        """Return a message with its fields as attributes."""
        key = (message.type, message.definition)
        try:
            if key not in self._stores:
                self._stores[key] = self._store(message)
            return self._stores[key].deserialize_cdr(message.data, message.type)
        except (TypesysError, SerdeError) as error:
            raise CannotRead(f"{message.type}: {error}") from error
        except (struct.error, IndexError, ValueError, KeyError, AssertionError) as error:
            raise CannotRead(
                f"{message.type}: its bytes do not fit its definition ({error})"
            ) from error

    @staticmethod
    def _store(message: RawMessage) -> Any:
        if not message.definition:
            return get_typestore(Stores.ROS2_HUMBLE)
        store = get_typestore(Stores.EMPTY)
        text = message.definition.decode(errors="replace")
        if message.encoding == "ros2idl":
            types = get_types_from_idl(text)
        else:
            types = get_types_from_msg(text, message.type)
        builtin = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
        store.register({name: kind for name, kind in types.items() if name not in builtin})
        return store


def protobuf_message(message: RawMessage) -> Any:
    """Return a message of Foxglove's."""
    from google.protobuf.message import DecodeError

    name = message.type.removeprefix("foxglove.")
    try:
        found = getattr(sys.modules[f"{FOXGLOVE}.{name}_pb2"], name)()
        found.ParseFromString(message.data)
    except DecodeError as error:
        raise CannotRead(f"{message.type}: {error}") from error
    return found


def _ns(stamp: Any) -> int:
    seconds = stamp.sec if hasattr(stamp, "sec") else stamp.seconds
    parts = stamp.nanosec if hasattr(stamp, "nanosec") else stamp.nanos
    return int(seconds) * NS + int(parts)


def _headed(message: Any) -> Head:
    """Return time and frame, which ROS has in a header and Foxglove in the message."""
    if hasattr(message, "header"):
        stamp, frame = message.header.stamp, message.header.frame_id
    else:
        stamp, frame = message.timestamp, message.frame_id
    return {"stamp_ns": _ns(stamp), "frame": frame.removeprefix("/")}


def _image(message: Any) -> tuple[Head, bytes]:
    head = {name: int(getattr(message, name)) for name in ("width", "height", "step")}
    return head | {"encoding": message.encoding}, bytes(message.data)


def _still(message: Any) -> tuple[Head, bytes]:
    return {"encoding": message.format}, bytes(message.data)


def _video(message: Any) -> tuple[Head, bytes]:
    data = bytes(message.data)
    return {"encoding": message.format, "key": IDR in nal_types(data)}, data


def nal_types(data: bytes) -> set[int]:
    """Return the types of the NAL units of H.264 in Annex B, up to the first slice's."""
    found: set[int] = set()
    at = data.find(b"\0\0\1")
    while 0 <= at < len(data) - 3 and not found & set(SLICES):
        found.add(data[at + 3] & 31)
        at = data.find(b"\0\0\1", at + 3)
    return found


def _camera(message: Any) -> tuple[Head, bytes]:
    def one(*names: str) -> Any:
        return next(getattr(message, name) for name in names if hasattr(message, name))

    head: Head = {name: int(getattr(message, name)) for name in ("width", "height")}
    head |= {name: [float(v) for v in one(name, name.upper())] for name in ("k", "d", "p")}
    head["model"] = message.distortion_model
    if hasattr(message, "roi"):
        roi = message.roi
        head["binning"] = [max(1, int(message.binning_x)), max(1, int(message.binning_y))]
        head["roi"] = [int(v) for v in (roi.x_offset, roi.y_offset, roi.width, roi.height)]
    return head, b""


def _placed(position: Any, rotation: Any) -> list[float]:
    """Return x, y, z in metres and a quaternion w, x, y, z."""
    names = ((position, "xyz"), (rotation, "wxyz"))
    return [float(getattr(of, name)) for of, parts in names for name in parts]


def _transforms(message: Any) -> tuple[Head, bytes]:
    found = []
    for one in getattr(message, "transforms", None) or [message]:
        if hasattr(one, "header"):
            parent, stamp, pose = one.header.frame_id, one.header.stamp, one.transform
        else:
            parent, stamp, pose = one.parent_frame_id, one.timestamp, one
        names = [name.removeprefix("/") for name in (parent, one.child_frame_id)]
        found.append([*names, _ns(stamp), *_placed(pose.translation, pose.rotation)])
    return {"transforms": found, "stamp_ns": found[0][2] if found else 0, "frame": ""}, b""


def _pose(message: Any) -> tuple[Head, bytes]:
    pose = message.pose
    covariance = [float(v) for v in getattr(pose, "covariance", ())]
    pose = getattr(pose, "pose", pose)
    rotation = pose.orientation
    child = getattr(message, "child_frame_id", "").removeprefix("/")
    return {
        "pose": _placed(pose.position, rotation),
        "child": child,
        "covariance": [covariance[i * 7] for i in range(6)] if len(covariance) == 36 else [],
    }, b""


def _fix(message: Any) -> tuple[Head, bytes]:
    names = ("latitude", "longitude", "altitude")
    head: Head = {name: float(getattr(message, name)) for name in names}
    is_known = message.position_covariance_type > 0
    head["covariance"] = [float(v) for v in message.position_covariance] if is_known else []
    status = getattr(message, "status", None)
    return head | {"has_fix": status is None or status.status >= 0}, b""


FOXGLOVE = "foxglove_schemas_protobuf"
KINDS: dict[str, tuple[str, Callable[[Any], tuple[Head, bytes]]]] = {
    "sensor_msgs/msg/Image": ("image", _image),
    "sensor_msgs/msg/CompressedImage": ("still", _still),
    "sensor_msgs/msg/CameraInfo": ("camera", _camera),
    "sensor_msgs/msg/NavSatFix": ("fix", _fix),
    "geometry_msgs/msg/PoseStamped": ("pose", _pose),
    "geometry_msgs/msg/PoseWithCovarianceStamped": ("pose", _pose),
    "nav_msgs/msg/Odometry": ("pose", _pose),
    "tf2_msgs/msg/TFMessage": ("transforms", _transforms),
    "foxglove_msgs/msg/CompressedVideo": ("video", _video),
    "foxglove.RawImage": ("image", _image),
    "foxglove.CompressedImage": ("still", _still),
    "foxglove.CompressedVideo": ("video", _video),
    "foxglove.CameraCalibration": ("camera", _camera),
    "foxglove.PoseInFrame": ("pose", _pose),
    "foxglove.FrameTransform": ("transforms", _transforms),
    "foxglove.FrameTransforms": ("transforms", _transforms),
    "foxglove.LocationFix": ("fix", _fix),
}
"""Messages that are understood: the kind of record, and how it is made of the message."""
PICTURES = ("image", "still", "video")


def load_everything() -> None:
    """Import what a sandbox cannot import later."""
    with needs("bags"):
        for name in KINDS:
            if name.startswith("foxglove."):
                import_module(f"{FOXGLOVE}.{name.removeprefix('foxglove.')}_pb2")
    humble = get_typestore(Stores.ROS2_HUMBLE)
    for name in KINDS:  # rosbags generates code, which imports, when a type is first read
        if name in humble.fielddefs:
            with suppress(SerdeError, struct.error, IndexError, ValueError):
                humble.deserialize_cdr(bytes([0, 1, 0, 0]), name)


@dataclass
class BagScan:
    """Makes records of messages, and counts the topics."""

    asked: Asked
    topics: dict[str, TopicSummary] = field(default_factory=dict)
    ros: RosDecoder = field(default_factory=RosDecoder)

    def record(self, message: RawMessage) -> tuple[Head, bytes] | None:
        """Return the record of a message, None for one that is not asked for or understood."""
        topic = self.topics.setdefault(message.topic, TopicSummary(message.type))
        if topic.type != message.type:
            raise CannotRead(
                f"{message.topic} holds {topic.type} and {message.type} "
                f"(log time {message.log_ns / NS:.3f} s)"
            )
        topic.first_ns = message.log_ns if not topic.count else topic.first_ns
        topic.count, topic.last_ns = topic.count + 1, message.log_ns
        form = "protobuf" if message.type.startswith("foxglove.") else "cdr"
        if message.type not in KINDS:
            topic.refused = "not used"
        elif message.form != form:
            topic.refused = f"encoded as {message.form or 'nothing stated'}, which is not read"
        is_asked = self.asked.topics is None or message.topic in self.asked.topics
        if topic.refused or not is_asked:
            return None
        kind, made = KINDS[message.type]
        try:
            is_ros = form == "cdr"
            decoded = self.ros.decode(message) if is_ros else protobuf_message(message)
            head = _headed(decoded) if kind != "transforms" else {}
            own, data = made(decoded)
        except (CannotRead, AttributeError, StopIteration) as error:
            raise CannotRead(
                f"{message.topic}, log time {message.log_ns / NS:.3f} s: {error or 'lacks a field'}"
            ) from error
        if not self.asked.data:
            own["size"], data = len(data), b""
        return {
            "topic": message.topic, "kind": kind, "log_ns": message.log_ns, **head, **own,
        }, data  # fmt: skip


@dataclass(frozen=True)
class OpenFile:
    """A file that was opened before the process gave up its rights, with its size then."""

    name: str
    file: BinaryIO
    size: int
    is_sqlite: bool

    @staticmethod
    def of(descriptor: int, name: str) -> OpenFile:
        """Open a descriptor."""
        file = os.fdopen(descriptor, "rb")
        is_sqlite = os.pread(descriptor, 6, 0) == b"SQLite"
        return OpenFile(name, file, os.fstat(descriptor).st_size, is_sqlite)

    def messages(self, follow: bool, idle: Callable[[], None]) -> Iterator[RawMessage]:
        """Return the messages; ``idle`` is called now and then while there are none yet."""
        if not self.is_sqlite:
            return mcap_messages(ExactFile(self.file, follow, idle))
        if follow:
            raise CannotRead("is a bag of SQLite; only MCAP is followed while it is written")
        return sqlite_messages(bytearray(self.file.read(self.size)))


def read(scan: BagScan, files: Sequence[OpenFile], write: Callable[[Head, bytes], None]) -> None:
    """Write the records of all files; the last one is ``topics`` or ``wrong``."""
    cut = []

    def idle() -> None:
        write({"kind": "idle"}, b"")  # fails, and ends the process, where nobody reads any more

    for file in files:
        messages = 0
        try:
            for message in file.messages(scan.asked.follow, idle):
                messages += 1
                if (record := scan.record(message)) is not None:
                    write(*record)
        except BagIsCut:
            cut.append(f"{file.name} is cut: its {messages} whole messages are taken")
        except (CannotRead, MemoryError) as error:
            text = str(error) or "needs more memory than its reader may take"
            write({"kind": "wrong", "text": f"{file.name}: {text}"}, b"")
            return
    topics = {name: asdict(topic) for name, topic in scan.topics.items()}
    write({"kind": "topics", "topics": topics, "cut": cut}, b"")


def main() -> None:
    """Read what is asked for, without rights."""
    confinement, text = sys.argv[1:]
    asked = Asked(**json.loads(text))
    load_everything()
    files = [OpenFile.of(*file) for file in asked.files]
    memory = READER_BYTES + 3 * sum(file.size for file in files if file.is_sqlite)
    scan, answer = BagScan(asked), sys.stdout.buffer
    confine(Confinement(confinement), ProcessLimits(memory, 16 + len(files)))

    def write(head: Head, data: bytes) -> None:
        line = json.dumps(head | {"bytes": len(data)}).encode()
        answer.write(LENGTH.pack(len(line)) + line)
        answer.write(data)
        if asked.follow:
            answer.flush()

    answer.write(READY)
    answer.flush()
    read(scan, files, write)
    answer.flush()
    os._exit(0)


if __name__ == "__main__":
    main()
