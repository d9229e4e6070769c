"""Messages come back equal from the wire; impossible ones are refused by name."""

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rfcore.camera import Pose, camera_on_rig
from rfcore.codec.h264.config import EFFORTS
from rfcore.errors import InvalidInput, ProtocolError, RejectReason
from rfcore.wire.convert import client_message_from_bytes, hello_to_bytes
from rfcore.wire.convert_answers import AnswerReader, AnswerWriter
from rfcore.wire.messages import (
    Ack,
    Credit,
    DrainNotice,
    FieldNotice,
    Frame,
    FrameAddress,
    Hello,
    Nack,
    PackedFrame,
    ServerMessage,
    StageTimes,
    Welcome,
)
from rfcore.wire.v1 import edge_pb2 as pb

fixtures_are_frozen = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


def test_a_hello_survives_the_wire(hello: Hello) -> None:
    assert client_message_from_bytes(hello_to_bytes(hello)) == hello


def on_rig(hello: Hello, camera_from_rig: Pose) -> Hello:
    (camera,) = hello.cameras
    return replace(hello, cameras=(replace(camera, camera_from_rig=camera_from_rig),))


def test_extrinsics_survive_the_wire(hello):
    rig = on_rig(hello, Pose((0.1, -1.5, 2.0), (0.5, -0.5, 0.5, -0.5)))
    assert client_message_from_bytes(hello_to_bytes(rig)) == rig


def test_both_ends_find_the_same_camera_on_the_rig(hello: Hello, frame: Frame) -> None:
    camera_from_rig = Pose((0.1, -1.5, 2.0), (0.6, 0.0, 0.8, 0.0))
    received = client_message_from_bytes(hello_to_bytes(on_rig(hello, camera_from_rig)))
    assert isinstance(received, Hello)
    assert frame.pose is not None
    posed = received.cameras[0].posed(frame)
    assert posed == replace(frame, pose=camera_on_rig(frame.pose, camera_from_rig))
    assert posed.pose is not None
    point = (3.0, 4.0, 5.0)
    in_camera = posed.pose.inverse().apply(point)
    in_rig = frame.pose.inverse().apply(point)
    assert in_camera == pytest.approx(camera_from_rig.apply(in_rig))


def test_without_extrinsics_a_frame_has_the_pose_of_its_camera(hello: Hello, frame: Frame) -> None:
    assert hello.cameras[0].posed(frame) is frame
    lost = replace(frame, pose=None)
    rig = on_rig(hello, Pose((0.1, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)))
    assert rig.cameras[0].posed(lost) is lost


@pytest.mark.parametrize(
    ("field", "value", "problem"),
    [
        ("x_m", 101.0, r"cameras\[0\].camera_from_rig.x_m: 101.0 is outside -100..100"),
        ("z_m", math.nan, "camera_from_rig.pose.translation_m: .* finite"),
        ("rotation_w", 3.0, "camera_from_rig.pose.rotation: quaternion of norm"),
    ],
)
def test_extrinsics_that_cannot_be_are_refused(
    hello: Hello, field: str, value: float, problem: str
) -> None:
    rig = on_rig(hello, Pose((0.1, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)))
    request = pb.StreamRequest.FromString(hello_to_bytes(rig))
    setattr(request.hello.cameras[0].camera_from_rig, field, value)
    with pytest.raises(InvalidInput, match=problem):
        client_message_from_bytes(request.SerializeToString())


CAMERAS = ("rear", "front")
ADDRESS = FrameAddress("front", 2, 7)
STEPS = StageTimes(10_000, 20_000, 30_000, 40_000, 100_000, 70_000)


@pytest.mark.parametrize(
    "message",
    [
        Welcome("s-1", exact=True),
        Welcome("s-1", exact=False, rate_hz=2.5),
        Ack(ADDRESS, STEPS, b"d" * 16),
        *[Nack(ADDRESS, reason, "why", count=2) for reason in RejectReason],
        Nack(ADDRESS, RejectReason.CRC_MISMATCH, "why", last_good_sequence=0, current_epoch=9),
        FieldNotice(("ab" * 32, "cd" * 32)),
        DrainNotice(),
        Credit("front", 12),
    ],
    ids=str,
)
def test_an_answer_survives_the_wire(message: ServerMessage) -> None:
    (data,) = AnswerWriter(CAMERAS).messages([message])
    assert AnswerReader(CAMERAS).messages(data) == [message]


def test_acks_and_credits_survive_in_order_and_a_credit_travels_with_its_ack() -> None:
    def ack(camera_id: str, epoch: int, sequence: int) -> Ack:
        return Ack(FrameAddress(camera_id, epoch, sequence), STEPS, b"digest")

    said: list[list[ServerMessage]] = [
        [Credit("rear", 2), Credit("front", 2)],
        [ack("front", 0, 0), Credit("front", 3)],
        [ack("front", 0, 1), ack("rear", 3, 9), Credit("front", 4), Credit("rear", 3)],
        [ack("front", 0, 3), Credit("front", 9), Credit("rear", 99)],
        [ack("front", 70_000, 2**40), ack("rear", 3, 10)],
    ]
    writer, reader = AnswerWriter(CAMERAS), AnswerReader(CAMERAS)
    sent = [writer.messages(messages) for messages in said]
    assert list(map(len, sent)) == [2, 1, 2, 2, 2]
    for messages, packets in zip(said, sent, strict=True):
        heard = [message for data in packets for message in reader.messages(data)]
        assert sorted(map(repr, heard)) == sorted(map(repr, messages))


def test_the_usual_ack_with_its_credit_is_small() -> None:
    """The camera of a name, its epoch, sequence and credit took 59 bytes as protobuf fields."""
    writer = AnswerWriter(CAMERAS)
    times = StageTimes(612_345, 12_712_345, 1_212_345, 3_212_345, 19_412_345, 9_000_000)
    for sequence in range(3):
        address = FrameAddress("front", 0, sequence)
        messages = [Ack(address, times, bytes(6)), Credit("front", sequence + 3)]
        (data,) = writer.messages(messages)
    assert len(data) <= 20


@pytest.mark.parametrize(
    "data", [b"", b"\xff" * 30, bytes((0b11111000, 0, 0)), bytes((0b1000101,))]
)
def test_an_ack_that_cannot_be_is_an_error_of_the_protocol(data: bytes) -> None:
    message = pb.StreamResponse(ack=data).SerializeToString()
    with pytest.raises(ProtocolError):
        AnswerReader(["front"]).messages(message)


@pytest.mark.parametrize("rate_hz", [-1.0, 1001.0, math.nan])
def test_a_rate_that_cannot_be_granted_is_refused(rate_hz: float) -> None:
    (data,) = AnswerWriter().messages([Welcome("s-1", exact=True, rate_hz=rate_hz)])
    with pytest.raises(ProtocolError, match="Hz"):
        AnswerReader(CAMERAS).messages(data)


Change = Callable[[pb.StreamRequest], object]


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda m: m.hello.ClearField("cameras"), "hello.cameras: 0"),
        (lambda m: m.hello.cameras.extend([m.hello.cameras[0]] * 32), "hello.cameras: 33"),
        (lambda m: m.hello.cameras.extend([m.hello.cameras[0]]), "same camera_id"),
        (lambda m: setattr(m.hello, "vehicle_id", ""), "hello.vehicle_id: ''"),
        (lambda m: setattr(m.hello, "vehicle_id", ".hidden"), "hello.vehicle_id"),
        (lambda m: m.hello.ClearField("field_ids"), "hello.field_ids: 0"),
        (lambda m: m.hello.field_ids.append("AB" * 32), r"hello.field_ids\[1\]"),
        (
            lambda m: setattr(m.hello.cameras[0].codec, "width_px", 640),
            r"hello.cameras\[0\].codec.width_px: 640 px, but intrinsics.width_px is 32 px",
        ),
        (
            lambda m: setattr(m.hello.cameras[0].intrinsics, "width_px", 9000),
            r"hello.cameras\[0\].intrinsics.width_px: 9000 px",
        ),
        (
            lambda m: setattr(m.hello.cameras[0].intrinsics, "fx_px", math.nan),
            r"hello.cameras\[0\].intrinsics.fx_px: nan",
        ),
        (lambda m: setattr(m.hello.cameras[0].codec, "crf", math.nan), "codec.crf: nan"),
        (lambda m: setattr(m.hello.cameras[0].codec, "sps", b""), "codec.sps: 0 bytes"),
        (lambda m: setattr(m.hello.cameras[0].codec, "pps", b"x" * 2000), "codec.pps: 2000"),
        (lambda m: setattr(m.hello.lattice, "steps_per_m", 0), "lattice.steps_per_m: 0"),
    ],
)
def test_a_bad_hello_is_refused_by_name(hello: Hello, change: Change, named: str) -> None:
    request = pb.StreamRequest.FromString(hello_to_bytes(hello))
    change(request)
    with pytest.raises(InvalidInput, match=named):
        client_message_from_bytes(request.SerializeToString())


@given(data=st.binary(max_size=400))
def test_arbitrary_bytes_from_a_vehicle_raise_our_errors_only(data: bytes) -> None:
    with suppress(InvalidInput):
        client_message_from_bytes(data)


def test_a_frame_comes_as_its_bytes():
    message = pb.StreamRequest(frame=b"head and payload").SerializeToString()
    assert client_message_from_bytes(message) == PackedFrame(b"head and payload")
    message = pb.StreamRequest(pose_ahead=b"head").SerializeToString()
    assert client_message_from_bytes(message) == PackedFrame(b"head", is_ahead=True)


@given(data=st.binary(max_size=200))
def test_arbitrary_bytes_from_a_server_raise_our_errors_only(data: bytes) -> None:
    with suppress(ProtocolError):
        AnswerReader(CAMERAS).messages(data)


@pytest.mark.parametrize("effort", EFFORTS)
def test_every_effort_survives_the_wire(hello: Hello, effort: str) -> None:
    camera = hello.cameras[0]
    config = replace(camera.codec.config, effort=effort)
    sent = replace(hello, cameras=(replace(camera, codec=replace(camera.codec, config=config)),))
    assert client_message_from_bytes(hello_to_bytes(sent)) == sent


@pytest.mark.parametrize("effort", ["", "extreme", "x264-placebo"])
def test_a_coder_that_is_not_known_here_is_refused_by_name(hello: Hello, effort: str) -> None:
    request = pb.StreamRequest.FromString(hello_to_bytes(hello))
    request.hello.cameras[0].codec.effort = effort
    with pytest.raises(InvalidInput, match=f"effort: '{effort}' is none of fast"):
        client_message_from_bytes(request.SerializeToString())
