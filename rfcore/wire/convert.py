"""Messages from vehicle to server: protobuf to the values of ``rfcore.wire.messages`` and back.

Everything that comes from a peer is checked here, once: finite, unit quaternion, ranges, sizes,
names. A bad value raises ``InvalidInput`` with the dotted name of the field as in the proto; one
that concerns a single frame raises ``FrameRefused``, which holds the address to answer to.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from contextlib import contextmanager

from google.protobuf.message import DecodeError

from rfcore.camera import Pose
from rfcore.codec.h264.bitstream import StreamHeader
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.packet import DeltaPacket
from rfcore.errors import InvalidInput
from rfcore.field.quality import FULL
from rfcore.wire.messages import (
    CameraDescription,
    ClientMessage,
    Frame,
    FrameAddress,
    Hello,
    RendererContract,
)
from rfcore.wire.v1 import edge_pb2 as pb
from rfcore.wire.values import (
    FIELD_ID_PREFIX_BYTES,
    MAX_CAMERAS,
    MAX_FIELDS,
    MAX_LEVER_ARM_M,
    MAX_PAYLOAD_BYTES,
    MAX_RATE_HZ,
    MAX_TRANSLATION_M,
    check_absent_or,
    check_bytes,
    check_field_id,
    check_name,
    check_range,
    clock_from_wire,
    clock_to_wire,
    intrinsics_from_wire,
    intrinsics_to_wire,
    localisation_from_wire,
    localisation_to_wire,
    pose_from_wire,
    pose_to_wire,
    quality_from_wire,
    quality_to_wire,
    references_from_wire,
    references_to_wire,
)


class FrameRefused(InvalidInput):
    """One frame carries a value that cannot be; ``address`` says which frame."""

    def __init__(self, error: InvalidInput, address: FrameAddress) -> None:
        super().__init__(error.field, error.problem)
        self.address = address


def client_message_from_bytes(data: bytes) -> ClientMessage:
    """Parse and check what a vehicle sent.

    Raises ``FrameRefused`` for a frame with a bad value, ``InvalidInput`` for anything else.
    """
    request = pb.StreamRequest()
    try:
        request.ParseFromString(data)
    except DecodeError as error:
        raise InvalidInput("message", f"{len(data)} bytes are not a StreamRequest") from error
    return client_message_from_wire(request)


def client_message_from_wire(request: pb.StreamRequest) -> ClientMessage:
    """Check what a vehicle sent; raises as ``client_message_from_bytes``."""
    match request.WhichOneof("message"):
        case "hello":
            return _hello_from_wire(request.hello)
        case "frame":
            return _frame_or_refusal(request.frame)
    raise InvalidInput("message", "is neither hello nor frame")


def client_message_to_bytes(message: ClientMessage) -> bytes:
    """Serialise a vehicle's message; its length is the packet size."""
    return client_message_to_wire(message).SerializeToString()


def client_message_to_wire(message: ClientMessage) -> pb.StreamRequest:
    """Return a vehicle's message as protobuf."""
    if isinstance(message, Hello):
        return pb.StreamRequest(hello=_hello_to_wire(message))
    return pb.StreamRequest(frame=_frame_to_wire(message))


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


def _frame_or_refusal(frame: pb.Frame) -> Frame:
    try:
        return _frame_from_wire(frame)
    except InvalidInput as error:
        address = FrameAddress(frame.camera_id[:64], frame.epoch, frame.sequence)
        raise FrameRefused(error, address) from error


def _frame_from_wire(frame: pb.Frame) -> Frame:
    check_range("frame.capture_time_ns", frame.capture_time_ns, 0, 2**63 - 1)
    with _within("frame"):
        quality = quality_from_wire(frame.quality) if frame.HasField("quality") else FULL
    return Frame(
        check_name("frame.camera_id", frame.camera_id),
        frame.capture_time_ns,
        _pose_from_wire(frame),
        check_absent_or("frame.field_id_prefix", frame.field_id_prefix, FIELD_ID_PREFIX_BYTES),
        _packet_from_wire(frame),
        quality,
        clock_from_wire(frame.capture_clock),
        localisation_from_wire(frame.localisation),
        frame.instant,
    )


def _pose_from_wire(frame: pb.Frame) -> Pose | None:
    """Return a checked pose; ``Pose`` itself refuses what is not finite or not a rotation."""
    if not frame.HasField("pose") and not frame.pose_f32:
        return None
    if frame.HasField("pose"):
        check_range("frame.pose_f32", len(frame.pose_f32), 0, 0)
        checked = pose_from_wire(frame.pose)
    else:
        check_range("frame.pose_f32", len(frame.pose_f32), 7, 7)
        x_m, y_m, z_m, w, x, y, z = frame.pose_f32
        checked = Pose((x_m, y_m, z_m), (w, x, y, z))
    x_m, y_m, z_m = checked.translation_m
    check_range("pose.x_m", x_m, -MAX_TRANSLATION_M, MAX_TRANSLATION_M)
    check_range("pose.y_m", y_m, -MAX_TRANSLATION_M, MAX_TRANSLATION_M)
    check_range("pose.z_m", z_m, -MAX_TRANSLATION_M, MAX_TRANSLATION_M)
    return checked


def _packet_from_wire(frame: pb.Frame) -> DeltaPacket:
    check_range("frame.sequence", frame.sequence, 0, 2**63 - 1)
    try:
        return DeltaPacket(  # checks lengths and unsigned numbers itself
            epoch=frame.epoch,
            sequence=frame.sequence,
            render_digest=frame.render_digest,
            render_block_means=frame.render_block_means,
            reconstruction_digest=frame.reconstruction_digest,
            payload=check_bytes("frame.payload", frame.payload, 0, MAX_PAYLOAD_BYTES),
            crc32=frame.crc32,
            references=references_from_wire("frame.references", tuple(frame.references)),
            base_digest=frame.base_digest,
            photometric=tuple(frame.photometric),
            relit=frame.relit,
            light=frame.light,
        )
    except InvalidInput as error:
        raise InvalidInput(error.field.replace("packet.", "frame.", 1), error.problem) from error


def _frame_to_wire(frame: Frame) -> pb.Frame:
    packet = frame.packet
    message = pb.Frame(
        camera_id=frame.camera_id,
        epoch=packet.epoch,
        sequence=packet.sequence,
        capture_time_ns=frame.capture_time_ns,
        field_id_prefix=frame.field_id_prefix,
        references=references_to_wire(packet.references),
        render_digest=packet.render_digest,
        render_block_means=packet.render_block_means,
        reconstruction_digest=packet.reconstruction_digest,
        payload=packet.payload,
        crc32=packet.crc32,
        base_digest=packet.base_digest,
        photometric=packet.photometric,
        relit=packet.relit,
        light=packet.light,
        capture_clock=clock_to_wire(frame.clock),
        localisation=localisation_to_wire(frame.localisation),
        instant=frame.instant,
    )
    _add_pose(message, frame.pose)
    if frame.quality != FULL:
        message.quality.CopyFrom(quality_to_wire(frame.quality))
    return message


def _add_pose(message: pb.Frame, pose: Pose | None) -> None:
    """Put the pose in, if there is one, in 4 bytes a number if that keeps every bit."""
    if pose is None:
        return
    numbers = (*pose.translation_m, *pose.rotation)
    if tuple(array("f", numbers)) == numbers:
        message.pose_f32.extend(numbers)
        return
    message.pose.CopyFrom(pose_to_wire(pose))
