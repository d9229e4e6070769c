"""Bags for tests, written by public libraries: rosbags (ROS 2) and mcap (Foxglove's schemas)."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from rfcore.bag_reader import Asked, BagScan, Head, OpenFile, load_everything, read
from rfcore.camera import Pose, TileOrigin
from rfcore.dataset.bag_records import checked
from rfcore.views import PosedPicture

STORE = get_typestore(Stores.ROS2_HUMBLE)
T0_NS, PERIOD_NS, LATE_NS = 1_767_225_600_000_000_000, 100_000_000, 20_000_000
OPTICAL = "front_optical_frame"
BASE_FROM_CAM = Pose.from_matrix([[0, 0, 1, 1.2], [-1, 0, 0, 0.1], [0, -1, 0, 1.4]])
"""A camera that looks along the vehicle's x."""


def made(name: str, *args: Any, **keys: Any) -> Any:
    return STORE.types[name](*args, **keys)


def header(ns: int, frame: str) -> Any:
    stamp = made("builtin_interfaces/msg/Time", ns // 10**9, ns % 10**9)
    return made("std_msgs/msg/Header", stamp, frame)


def transform(ns: int, parent: str, child: str, pose: Pose) -> Any:
    w, x, y, z = pose.rotation
    placed = made(
        "geometry_msgs/msg/Transform",
        made("geometry_msgs/msg/Vector3", *pose.translation_m),
        made("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
    )
    return made("geometry_msgs/msg/TransformStamped", header(ns, parent), child, placed)


def transforms(*those: Any) -> Any:
    return made("tf2_msgs/msg/TFMessage", list(those))


def pose_of(pose: Pose) -> Any:
    w, x, y, z = pose.rotation
    position = made("geometry_msgs/msg/Point", *pose.translation_m)
    return made(
        "geometry_msgs/msg/Pose", position, made("geometry_msgs/msg/Quaternion", x, y, z, w)
    )


def pose_stamped(ns: int, frame: str, pose: Pose) -> Any:
    return made("geometry_msgs/msg/PoseStamped", header(ns, frame), pose_of(pose))


def odometry(ns: int, frame: str, child: str, pose: Pose, variance: float = 0.0) -> Any:
    zero = made("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
    covariance = np.diag([variance] * 6).ravel()
    return made(
        *("nav_msgs/msg/Odometry", header(ns, frame), child),
        made("geometry_msgs/msg/PoseWithCovariance", pose_of(pose), covariance),
        made(
            "geometry_msgs/msg/TwistWithCovariance",
            made("geometry_msgs/msg/Twist", zero, zero),
            np.zeros(36),
        ),
    )


def fix(ns: int, latitude: float, longitude: float, altitude: float, status: int = 0) -> Any:
    state = made("sensor_msgs/msg/NavSatStatus", status, 1)
    covariance = np.diag([0.25, 0.25, 1.0]).ravel()
    return made(
        *("sensor_msgs/msg/NavSatFix", header(ns, "antenna"), state),
        *(latitude, longitude, altitude, covariance, 2),
    )


def image(ns: int, data: np.ndarray, encoding: str, size_px: tuple[int, int], **keys: Any) -> Any:
    """Return an Image of rows ``data`` [H, step], uint8."""
    return made(
        "sensor_msgs/msg/Image",
        header=header(ns, keys.get("frame", OPTICAL)),
        height=size_px[1],
        width=size_px[0],
        encoding=encoding,
        is_bigendian=0,
        step=data.shape[1],
        data=np.ascontiguousarray(data).ravel(),
    )


def rgb_image(ns: int, rgb: np.ndarray, frame: str = OPTICAL) -> Any:
    height, width, _ = rgb.shape
    return image(ns, rgb.reshape(height, -1), "rgb8", (width, height), frame=frame)


def still(ns: int, data: bytes, name: str) -> Any:
    content = np.frombuffer(data, np.uint8)
    return made("sensor_msgs/msg/CompressedImage", header(ns, OPTICAL), name, content)


def camera_info(ns: int, size_px: tuple[int, int], **keys: Any) -> Any:
    """Return the CameraInfo of fx = 20, fy = 21, cx = 7.5, cy = 5.5 where ``keys`` say no other."""
    k = np.array(keys.get("k", (20, 0, 7.5, 0, 21, 5.5, 0, 0, 1)), float)
    p = np.array(keys.get("p", (*k[:3], 0, *k[3:6], 0, *k[6:], 0)), float)
    return made(
        "sensor_msgs/msg/CameraInfo",
        header=header(ns, keys.get("frame", OPTICAL)),
        height=size_px[1],
        width=size_px[0],
        distortion_model=keys.get("model", "plumb_bob"),
        d=np.array(keys.get("d", (0, 0, 0, 0, 0)), float),
        k=k,
        r=np.eye(3).ravel(),
        p=p,
        binning_x=keys.get("binning", 0),
        binning_y=keys.get("binning", 0),
        roi=made("sensor_msgs/msg/RegionOfInterest", *keys.get("roi", (0, 0, 0, 0)), False),
    )


@dataclass
class Recording:
    """Messages to be written: (topic, log time, message)."""

    messages: list[tuple[str, int, Any]] = field(default_factory=list)

    def add(self, topic: str, message: Any, log_ns: int) -> None:
        self.messages.append((topic, log_ns, message))

    def write(self, folder: Path, storage: StoragePlugin = StoragePlugin.MCAP) -> Path:
        """Write a bag of ROS 2, which states its definitions."""
        with Writer(folder, version=9, storage_plugin=storage) as bag:
            connections = {}
            for topic, log_ns, message in self.messages:
                name = message.__msgtype__
                if topic not in connections:
                    connections[topic] = bag.add_connection(topic, name, typestore=STORE)
                bag.write(connections[topic], log_ns, STORE.serialize_cdr(message, name))
        return folder


SIZE_PX = (16, 12)


def rgb(number: int, size_px: tuple[int, int] = SIZE_PX) -> np.ndarray:
    rng = np.random.default_rng(number)
    return rng.integers(0, 256, (size_px[1], size_px[0], 3), np.uint8)


def time_ns(number: float) -> int:
    return T0_NS + round(number * PERIOD_NS)


def map_from_base(number: float) -> Pose:
    """A straight drive, 1 m a picture."""
    return Pose((100.0 + number, 50.0, 2.0), (0.8, 0.0, 0.0, 0.6))


def drive(count: int = 4, *, with_pictures: bool = True, info: Any = None) -> Recording:
    """Return a camera on a vehicle: transforms at the beginning and the end of each period."""
    made_of = Recording()
    mount = transform(T0_NS, "base_link", OPTICAL, BASE_FROM_CAM)
    made_of.add("/tf_static", transforms(mount), T0_NS - PERIOD_NS)
    for i in range(count):
        ns = time_ns(i)
        for at in (i - 0.5, i + 0.5):
            moved = transform(time_ns(at), "map", "base_link", map_from_base(at))
            made_of.add("/tf", transforms(moved), ns + LATE_NS)
        if with_pictures:
            made_of.add("/front/camera_info", info or camera_info(ns, SIZE_PX), ns + LATE_NS)
            made_of.add("/front/image_raw", rgb_image(ns, rgb(i)), ns + LATE_NS)
    return made_of


def protobuf_schema(message: Any) -> bytes:
    """Return the FileDescriptorSet of a message's class and what it imports."""
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


def foxglove_mcap(path: Path, messages: list[tuple[str, int, Any]], **keys: Any) -> Path:
    """Write messages of Foxglove's as MCAP by the reference library."""
    with path.open("wb") as file:
        writer = McapWriter(file, compression=keys.get("compression", CompressionType.LZ4))
        writer.start()
        channels: dict[str, int] = {}
        for topic, log_ns, message in messages:
            if topic not in channels:
                name = message.DESCRIPTOR.full_name
                schema = writer.register_schema(name, "protobuf", protobuf_schema(message))
                channels[topic] = writer.register_channel(topic, "protobuf", schema)
            data = message.SerializeToString()
            writer.add_message(channels[topic], log_ns, data, publish_time=log_ns)
        writer.finish()
    return path


def in_small_chunks(folder: Path) -> Path:
    """Write a bag of ROS 2 again as an MCAP file with a chunk a message, not compressed."""
    path = folder.with_suffix(".mcap")
    (source,) = folder.glob("*.mcap")
    with source.open("rb") as file, path.open("wb") as out:
        writer = McapWriter(out, chunk_size=1, compression=CompressionType.NONE)
        writer.start("ros2")
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(file).iter_messages():
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, "cdr", number)
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.publish_time
            )
        writer.finish()
    return path


def video_message(ns: int, data: bytes, name: str = "h264") -> CompressedVideo:
    message = CompressedVideo(frame_id=OPTICAL, data=data, format=name)
    message.timestamp.FromNanoseconds(ns)
    return message


def records_here(_, files: list[Any], asked: Asked) -> Iterator[tuple[Head, bytes]]:
    """Stand in for the reader's process: the same code, here."""
    records: list[tuple[Head, bytes]] = []
    load_everything()
    opened = [OpenFile.of(os.dup(file.fileno()), file.name) for file in files]

    def write(head: Head, data: bytes) -> None:
        records.append((head | {"bytes": len(data)}, data))

    read(BagScan(asked), opened, write)
    for file in opened:
        file.file.close()
    yield from checked(records)


def of_pictures(pictures: Sequence[PosedPicture], origin: TileOrigin) -> Recording:
    """Return posed pictures as a vehicle's camera would have recorded them."""
    made_of = Recording()
    mount = transform(T0_NS, "base_link", OPTICAL, BASE_FROM_CAM)
    made_of.add("/tf_static", transforms(mount), T0_NS)
    for picture in pictures:
        ns, k = T0_NS + picture.time_ns, picture.camera.intrinsics
        world_from_cam = origin.globalise(picture.camera.world_from_cam)
        world_from_base = world_from_cam.compose(BASE_FROM_CAM.inverse())
        moved = transform(ns, "map", "base_link", world_from_base)
        made_of.add("/tf", transforms(moved), ns + LATE_NS)
        matrix = (k.fx_px, 0, k.cx_px - 0.5, 0, k.fy_px, k.cy_px - 0.5, 0, 0, 1)
        info = camera_info(ns, (k.width_px, k.height_px), k=matrix)
        made_of.add("/front/camera_info", info, ns + LATE_NS)
        made_of.add("/front/image_raw", rgb_image(ns, picture.read()), ns + LATE_NS)
    return made_of
