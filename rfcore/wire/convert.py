"""The vehicle's Hello: protobuf to the values of ``rfcore.wire.messages`` and back.

Everything that comes from a peer is checked here, once: finite, unit quaternion, ranges, sizes,
names. A bad value raises ``InvalidInput`` with the dotted name of the field as in the proto. Frames
are read by ``rfcore.wire.head``.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from google.protobuf.message import DecodeError

from rfcore.camera import Pose, PoseLattice
from rfcore.codec.h264.bitstream import StreamHeader
from rfcore.codec.h264.config import CodecConfig
from rfcore.errors import InvalidInput
from rfcore.wire.messages import CameraDescription, Hello, PackedFrame, RendererContract
from rfcore.wire.v1 import edge_pb2 as pb
from rfcore.wire.values import (
    MAX_CAMERAS,
    MAX_FIELDS,
    MAX_LEVER_ARM_M,
    MAX_RATE_HZ,
    check_bytes,
    check_field_id,
    check_name,
    check_range,
    intrinsics_from_wire,
    intrinsics_to_wire,
    pose_from_wire,
    pose_to_wire,
)


def client_message_from_bytes(data: bytes) -> Hello | PackedFrame:
    """Return the Hello that a vehicle sent, or a packed frame (``rfcore.wire.head``).

    Raises ``InvalidInput`` for anything else, and for a Hello with a bad value.
    """
    request = pb.StreamRequest()
    try:
        request.ParseFromString(data)
    except DecodeError as error:
        raise InvalidInput("message", f"{len(data)} bytes are not a StreamRequest") from error
    return client_message_from_wire(request)


def client_message_from_wire(request: pb.StreamRequest) -> Hello | PackedFrame:
    """Return what a vehicle sent; raises as ``client_message_from_bytes``."""
    match request.WhichOneof("message"):
        case "hello":
            return _hello_from_wire(request.hello)
        case "frame":
            return PackedFrame(request.frame)
        case "pose_ahead":
            return PackedFrame(request.pose_ahead, is_ahead=True)
    raise InvalidInput("message", "is neither hello nor frame nor pose_ahead")


def hello_to_bytes(hello: Hello) -> bytes:
    """Return the message of a Hello."""
    return pb.StreamRequest(hello=_hello_to_wire(hello)).SerializeToString(deterministic=True)


@contextmanager
def _within(field: str) -> Iterator[None]:
    """Name the field of an ``InvalidInput`` as a part of ``field``."""
    try:
        yield
    except InvalidInput as error:
        raise InvalidInput(f"{field}.{error.field}", error.problem) from error


def _hello_from_wire(hello: pb.Hello) -> Hello:
    check_range("hello.cameras", len(hello.cameras), 1, MAX_CAMERAS)
    check_range("hello.field_ids", len(hello.field_ids), 1, MAX_FIELDS)
    cameras = tuple(
        _camera_from_wire(f"hello.cameras[{i}]", camera) for i, camera in enumerate(hello.cameras)
    )
    if len({camera.camera_id for camera in cameras}) != len(cameras):
        raise InvalidInput("hello.cameras", "two cameras have the same camera_id")
    return Hello(
        check_name("hello.vehicle_id", hello.vehicle_id),
        cameras,
        tuple(check_field_id(f"hello.field_ids[{i}]", f) for i, f in enumerate(hello.field_ids)),
        RendererContract(
            check_name("hello.renderer.name", hello.renderer.name), hello.renderer.exact
        ),
        hello.allow_recording,
        hello.take_notices,
        PoseLattice(hello.lattice.steps_per_m, hello.lattice.rotation_steps),
    )


def _camera_from_wire(field: str, camera: pb.CameraDescription) -> CameraDescription:
    k, header = camera.intrinsics, camera.codec
    with _within(field):
        intrinsics = intrinsics_from_wire(k)
        codec = _codec_from_wire(header)
    for side in ("width_px", "height_px"):
        if getattr(header, side) != getattr(k, side):
            raise InvalidInput(
                f"{field}.codec.{side}",
                f"{getattr(header, side)} px, but intrinsics.{side} is {getattr(k, side)} px",
            )
    return CameraDescription(
        check_name(f"{field}.camera_id", camera.camera_id),
        intrinsics,
        codec,
        check_range(f"{field}.rate_hz", camera.rate_hz, 0.0, MAX_RATE_HZ),
        _extrinsics_from_wire(f"{field}.camera_from_rig", camera),
    )


def _extrinsics_from_wire(field: str, camera: pb.CameraDescription) -> Pose | None:
    if not camera.HasField("camera_from_rig"):
        return None
    with _within(field):
        pose = pose_from_wire(camera.camera_from_rig)
    for axis, metres in zip("xyz", pose.translation_m, strict=True):
        check_range(f"{field}.{axis}_m", metres, -MAX_LEVER_ARM_M, MAX_LEVER_ARM_M)
    return pose


def _codec_from_wire(header: pb.StreamHeader) -> StreamHeader:
    return StreamHeader(
        CodecConfig(header.width_px, header.height_px, header.effort, header.crf),
        check_bytes("codec.sps", header.sps, 4, 1024),
        check_bytes("codec.pps", header.pps, 2, 1024),
    )


def _hello_to_wire(hello: Hello) -> pb.Hello:
    return pb.Hello(
        vehicle_id=hello.vehicle_id,
        cameras=[_camera_to_wire(camera) for camera in hello.cameras],
        field_ids=hello.field_ids,
        renderer=pb.RendererContract(name=hello.renderer.name, exact=hello.renderer.exact),
        allow_recording=hello.allow_recording,
        take_notices=hello.take_notices,
        lattice=pb.PoseLattice(**vars(hello.lattice)),
    )


def _camera_to_wire(camera: CameraDescription) -> pb.CameraDescription:
    config = camera.codec.config
    return pb.CameraDescription(
        camera_id=camera.camera_id,
        intrinsics=intrinsics_to_wire(camera.intrinsics),
        codec=pb.StreamHeader(
            width_px=config.width_px,
            height_px=config.height_px,
            effort=config.effort,
            crf=config.crf,
            sps=camera.codec.sps,
            pps=camera.codec.pps,
        ),
        rate_hz=camera.rate_hz,
        camera_from_rig=pose_to_wire(camera.camera_from_rig) if camera.camera_from_rig else None,
    )
