"""What goes over the wire comes back equal; what cannot be is refused by name."""

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rfcore.camera import Intrinsics, Pose, camera_on_rig
from rfcore.codec.h264.config import EFFORTS
from rfcore.errors import InvalidInput, ProtocolError, RejectReason, RfedgeError
from rfcore.field import Quality
from rfcore.localise.estimate import LocalisationState
from rfcore.wire.convert import (
    FrameRefused,
    client_message_from_bytes,
    client_message_to_bytes,
)
from rfcore.wire.convert_answers import server_messages_from_bytes, server_messages_to_bytes
from rfcore.wire.messages import (
    Ack,
    Credit,
    DrainNotice,
    FieldNotice,
    Frame,
    FrameAddress,
    Hello,
    Nack,
    ServerMessage,
    StageTimes,
    Welcome,
)
from rfcore.wire.v1 import edge_pb2 as pb
from rfcore.wire.values import ClockKind

fixtures_are_frozen = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


def test_a_hello_survives_the_wire(hello: Hello) -> None:
    assert client_message_from_bytes(client_message_to_bytes(hello)) == hello


def test_a_frame_survives_the_wire(frame: Frame) -> None:
    assert client_message_from_bytes(client_message_to_bytes(frame)) == frame


def on_rig(hello: Hello, camera_from_rig: Pose) -> Hello:
    (camera,) = hello.cameras
    return replace(hello, cameras=(replace(camera, camera_from_rig=camera_from_rig),))


def test_extrinsics_and_instants_survive_the_wire(hello: Hello, frame: Frame) -> None:
    rig = on_rig(hello, Pose((0.1, -1.5, 2.0), (0.5, -0.5, 0.5, -0.5)))
    assert client_message_from_bytes(client_message_to_bytes(rig)) == rig
    later = replace(frame, instant=7)
    assert client_message_from_bytes(client_message_to_bytes(later)) == later


def test_both_ends_find_the_same_camera_on_the_rig(hello: Hello, frame: Frame) -> None:
    camera_from_rig = Pose((0.1, -1.5, 2.0), (0.6, 0.0, 0.8, 0.0))
    received = client_message_from_bytes(client_message_to_bytes(on_rig(hello, camera_from_rig)))
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
    request = pb.StreamRequest.FromString(client_message_to_bytes(rig))
    setattr(request.hello.cameras[0].camera_from_rig, field, value)
    with pytest.raises(InvalidInput, match=problem):
        client_message_from_bytes(request.SerializeToString())


ADDRESS = FrameAddress("front", 2, 7)


@pytest.mark.parametrize(
    "message",
    [
        Welcome("s-1", exact=True),
        Welcome("s-1", exact=False, rate_hz=2.5),
        Ack(ADDRESS, StageTimes(1, 2, 3, 4, 10), b"d" * 16),
        *[Nack(ADDRESS, reason, "why", count=2) for reason in RejectReason],
        Nack(ADDRESS, RejectReason.CRC_MISMATCH, "why", last_good_sequence=0, current_epoch=9),
        FieldNotice(("ab" * 32, "cd" * 32)),
        DrainNotice(),
        Credit("front", 12),
    ],
    ids=str,
)
def test_an_answer_survives_the_wire(message: ServerMessage) -> None:
    (data,) = server_messages_to_bytes([message])
    assert server_messages_from_bytes(data) == [message]


def test_a_credit_travels_with_the_answer_before_it() -> None:
    ack = Ack(ADDRESS, StageTimes(), b"d" * 16)
    messages = [ack, Credit("front", 3), Credit("rear", 4), ack]
    packets = server_messages_to_bytes(messages)
    assert len(packets) == 3
    assert [m for data in packets for m in server_messages_from_bytes(data)] == messages


@pytest.mark.parametrize("rate_hz", [-1.0, 1001.0, math.nan])
def test_a_rate_that_cannot_be_granted_is_refused(rate_hz: float) -> None:
    (data,) = server_messages_to_bytes([Welcome("s-1", exact=True, rate_hz=rate_hz)])
    with pytest.raises(ProtocolError, match="Hz"):
        server_messages_from_bytes(data)


Change = Callable[[pb.StreamRequest], object]


def _with_half_a_pose(message: pb.StreamRequest) -> None:
    message.frame.ClearField("pose")
    message.frame.pose_f32.extend([0.0] * 3)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda m: setattr(m.frame.pose, "x_m", math.nan), "pose.translation_m: .nan"),
        (lambda m: setattr(m.frame.pose, "y_m", math.inf), "pose.translation_m"),
        (lambda m: setattr(m.frame.pose, "z_m", 2e6), r"pose.z_m: 2000000.0 is outside"),
        (lambda m: setattr(m.frame.pose, "rotation_w", 0.9), "pose.rotation: quaternion of norm"),
        (_with_half_a_pose, "frame.pose_f32: 3 is outside 7..7"),
        (lambda m: m.frame.pose_f32.extend([0.0] * 7), "frame.pose_f32: 7 is outside 0..0"),
        (lambda m: setattr(m.frame, "camera_id", "../etc"), "frame.camera_id: '../etc'"),
        (lambda m: setattr(m.frame, "camera_id", "a" * 65), "frame.camera_id"),
        (lambda m: setattr(m.frame, "payload", b"x" * 1_000_001), "frame.payload: 1000001 bytes"),
        (lambda m: setattr(m.frame, "render_digest", b"x"), "frame.render_digest: 1 bytes"),
        (
            lambda m: setattr(m.frame, "render_block_means", b"x"),
            "frame.render_block_means: 1 bytes",
        ),
        (lambda m: setattr(m.frame, "reconstruction_digest", b""), "frame.reconstruction_digest"),
        (
            lambda m: setattr(m.frame, "field_id_prefix", b"x"),
            "frame.field_id_prefix: 1 bytes, expected 0 or 8",
        ),
        (lambda m: m.frame.references.append(77), "frame.references: 77"),
        (lambda m: setattr(m.frame, "sequence", 2**63), "frame.sequence"),
        (lambda m: setattr(m.frame, "capture_time_ns", 2**64 - 1), "frame.capture_time_ns"),
    ],
)
def test_a_bad_value_refuses_the_frame_by_name(frame: Frame, change: Change, named: str) -> None:
    request = pb.StreamRequest.FromString(client_message_to_bytes(frame))
    change(request)
    with pytest.raises(FrameRefused, match=named) as caught:
        client_message_from_bytes(request.SerializeToString())
    address = caught.value.address
    assert (address.epoch, address.sequence) == (3, request.frame.sequence)


def test_a_frame_whose_camera_is_lost_has_no_pose_and_shows_nothing(frame: Frame) -> None:
    lost = replace(frame, pose=None)
    message = client_message_to_bytes(lost)
    assert len(message) < len(client_message_to_bytes(frame))
    assert client_message_from_bytes(message) == lost
    assert lost.camera(Intrinsics(4, 2, 1.0, 1.0, 2.0, 1.0)) is None


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
    ],
)
def test_a_bad_hello_is_refused_by_name(hello: Hello, change: Change, named: str) -> None:
    request = pb.StreamRequest.FromString(client_message_to_bytes(hello))
    change(request)
    with pytest.raises(InvalidInput, match=named):
        client_message_from_bytes(request.SerializeToString())


@given(data=st.binary(max_size=400))
def test_arbitrary_bytes_from_a_vehicle_raise_our_errors_only(data: bytes) -> None:
    with suppress(InvalidInput):
        client_message_from_bytes(data)


@given(data=st.binary(max_size=200))
def test_arbitrary_bytes_from_a_server_raise_our_errors_only(data: bytes) -> None:
    with suppress(ProtocolError):
        server_messages_from_bytes(data)


def test_untrusted_text_is_escaped_and_cut_short_in_messages(frame: Frame) -> None:
    request = pb.StreamRequest.FromString(client_message_to_bytes(frame))
    request.frame.camera_id = "\n\x1b" * 50_000
    with pytest.raises(FrameRefused) as caught:
        client_message_from_bytes(request.SerializeToString())
    assert len(str(caught.value)) < 700
    assert str(caught.value).isprintable()


@fixtures_are_frozen
@given(
    edits=st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 255)), min_size=1, max_size=8),
    cut=st.integers(0, 500),
)
def test_a_damaged_frame_is_a_frame_or_a_refusal(
    frame: Frame, edits: list[tuple[int, int]], cut: int
) -> None:
    data = bytearray(client_message_to_bytes(frame))
    for position, value in edits:
        data[position % len(data)] = value
    try:
        message = client_message_from_bytes(bytes(data[: len(data) - cut]))
    except RfedgeError:
        return
    if isinstance(message, Frame):
        assert math.isfinite(sum(message.pose.translation_m))


@fixtures_are_frozen
@given(turn=st.tuples(*[st.floats(-1, 1)] * 4), away=st.tuples(*[st.floats(-1e6, 1e6)] * 3))
def test_a_pose_keeps_every_bit(
    frame: Frame,
    turn: tuple[float, float, float, float],
    away: tuple[float, float, float],
) -> None:
    norm = math.sqrt(sum(v * v for v in turn))
    w, x, y, z = (v / norm for v in turn) if norm > 0.1 else (1.0, 0.0, 0.0, 0.0)
    sent = Frame("front", 0, Pose(away, (w, x, y, z)), frame.field_id_prefix, frame.packet)
    got = client_message_from_bytes(client_message_to_bytes(sent))
    assert isinstance(got, Frame)
    assert (got.pose.translation_m, got.pose.rotation) == (away, (w, x, y, z))


@pytest.mark.parametrize(
    "quality",
    [
        Quality(),
        Quality(0.5),
        Quality(0.25, 0),
        Quality(0.1, 3),
        Quality(samples_per_ray=4096),
        Quality(0.5, 1, 16, 0.5),
    ],
    ids=str,
)
def test_a_quality_survives_the_wire_and_full_quality_costs_nothing(
    frame: Frame, quality: Quality
) -> None:
    sent = replace(frame, quality=quality)
    data = client_message_to_bytes(sent)
    assert client_message_from_bytes(data) == sent
    more = len(data) - len(client_message_to_bytes(frame))
    assert more == 0 if quality == Quality() else 0 < more <= 14


@pytest.mark.parametrize(
    ("knobs", "named"),
    [
        ({"detail_percent": 30}, r"frame\.quality\.detail: 0\.3 is none of"),
        ({"sh_degree": 4}, r"frame\.quality\.sh_degree: 4"),
        ({"samples_per_ray": 5000}, r"frame\.quality\.samples_per_ray: 5000"),
        ({"scale_percent": 25}, r"frame\.quality\.scale: 0\.25"),
    ],
)
def test_a_quality_off_the_ladder_spoils_its_frame_alone(
    frame: Frame, knobs: dict[str, int], named: str
) -> None:
    request = pb.StreamRequest.FromString(client_message_to_bytes(frame))
    request.frame.quality.CopyFrom(pb.Quality(**knobs))
    with pytest.raises(FrameRefused, match=named):
        client_message_from_bytes(request.SerializeToString())


@pytest.mark.parametrize("effort", EFFORTS)
def test_every_effort_survives_the_wire(hello: Hello, effort: str) -> None:
    camera = hello.cameras[0]
    config = replace(camera.codec.config, effort=effort)
    sent = replace(hello, cameras=(replace(camera, codec=replace(camera.codec, config=config)),))
    assert client_message_from_bytes(client_message_to_bytes(sent)) == sent


@pytest.mark.parametrize("effort", ["", "extreme", "x264-placebo"])
def test_a_coder_that_is_not_known_here_is_refused_by_name(hello: Hello, effort: str) -> None:
    request = pb.StreamRequest.FromString(client_message_to_bytes(hello))
    request.hello.cameras[0].codec.effort = effort
    with pytest.raises(InvalidInput, match=f"effort: '{effort}' is none of fast"):
        client_message_from_bytes(request.SerializeToString())


@pytest.mark.parametrize("clock", [None, *ClockKind])
@pytest.mark.parametrize("localisation", [None, *LocalisationState])
def test_clock_and_localisation_survive_the_wire(
    frame: Frame, clock: ClockKind | None, localisation: LocalisationState | None
) -> None:
    said = replace(frame, clock=clock, localisation=localisation)
    assert client_message_from_bytes(client_message_to_bytes(said)) == said


def test_a_number_of_a_newer_peer_counts_as_not_said(frame: Frame) -> None:
    request = pb.StreamRequest.FromString(client_message_to_bytes(frame))
    request.frame.capture_clock = 99  # type: ignore[assignment]
    request.frame.localisation = 99  # type: ignore[assignment]
    assert client_message_from_bytes(request.SerializeToString()) == frame
