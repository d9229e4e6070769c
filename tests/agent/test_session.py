"""The vehicle's conversation: newest picture first, credits kept, losses answered by an epoch."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from cav_agent.config import AgentLimits
from cav_agent.frames import (
    Capture,
    EncodedFrame,
    EncodeJob,
    EndReason,
    FrameResult,
    Outcome,
    StreamEnd,
)
from cav_agent.session import AgentSession, LinkState, OutgoingMessage
from rfcore.errors import InvalidInput, RejectReason, RfedgeError
from rfcore.wire.messages import (
    Ack,
    Credit,
    FieldNotice,
    Frame,
    FrameAddress,
    Hello,
    Nack,
    StageTimes,
    Welcome,
)

MakeCapture = Callable[..., Capture]
Encode = Callable[..., EncodedFrame]

UNAVAILABLE = StreamEnd(EndReason.STREAM_LOST, "UNAVAILABLE: connection reset")


def send(session: AgentSession, capture: Capture, encode: Encode, now: float = 1.0) -> Frame:
    """Offer, encode and send one picture; return the frame as the server would get it."""
    session.offer(capture)
    job = session.job_to_start(0.0)
    assert job is not None
    session.encoded(encode(job), now)
    (outgoing,) = session.messages_to_send(now)
    assert isinstance(outgoing.message, Frame)
    return outgoing.message


def ack(frame: Frame, total_ns: int = 0) -> Ack:
    return Ack(frame.address, StageTimes(total_ns=total_ns), b"d" * 16)


def outcomes(results: list[FrameResult]) -> list[tuple[int, str]]:
    return [(result.capture.index, str(result.outcome)) for result in results]


# --- greeting


def test_a_connection_begins_with_hello_and_streams_after_welcome(hello: Hello) -> None:
    session = AgentSession(hello)
    session.connected(0.0)
    assert session.messages_to_send(0.0) == [OutgoingMessage.of(hello)]
    assert session.state is LinkState.GREETING
    session.receive(Welcome("s-7", exact=True), 0.1)
    assert (session.state, session.session_id) == (LinkState.STREAMING, "s-7")


def test_a_server_that_does_not_welcome_is_given_up(hello: Hello) -> None:
    session = AgentSession(hello, AgentLimits(greeting_s=2.0))
    session.connected(10.0)
    assert session.get_timer() == 12.0
    session.handle_timer(11.9)
    assert session.broken is None
    session.handle_timer(12.0)
    assert session.broken == StreamEnd(EndReason.NO_WELCOME, "no Welcome within 2 s")


def test_nothing_is_encoded_before_welcome_and_credit(
    hello: Hello, make_capture: MakeCapture
) -> None:
    session = AgentSession(hello)
    session.offer(make_capture(0))
    assert session.job_to_start(0.0) is None
    session.connected(0.0)
    assert session.job_to_start(0.0) is None
    session.receive(Welcome("s-1", exact=True), 0.0)
    assert session.job_to_start(0.0) is None
    session.receive(Credit("rear", 2), 0.0)
    assert session.job_to_start(0.0) is None
    session.receive(Credit("front", 2), 0.0)
    assert session.job_to_start(0.0) is not None


# --- pictures and credits


def test_the_newest_picture_wins_and_the_older_is_reported_dropped(
    session: AgentSession, make_capture: MakeCapture
) -> None:
    for index in range(4):
        session.offer(make_capture(index))
    job = session.job_to_start(0.0)
    assert job is not None
    assert job.capture.index == 3
    assert outcomes(session.take_results()) == [(0, "dropped"), (1, "dropped"), (2, "dropped")]


def test_credit_bounds_what_is_sent_and_answers_free_it(
    session: AgentSession, make_capture: MakeCapture, encode: Encode
) -> None:
    first = send(session, make_capture(0), encode)
    send(session, make_capture(1), encode)
    session.offer(make_capture(2))
    assert session.job_to_start(0.0) is None
    session.receive(ack(first), 2.0)
    session.receive(Credit("front", 3), 2.0)
    assert session.job_to_start(0.0) is not None


def test_credit_never_falls(
    session: AgentSession, make_capture: MakeCapture, encode: Encode
) -> None:
    session.receive(Credit("front", 1), 0.0)
    send(session, make_capture(0), encode)
    send(session, make_capture(1), encode)


def test_an_ack_ends_a_picture_with_its_sizes_and_times(
    session: AgentSession, make_capture: MakeCapture, encode: Encode
) -> None:
    frame = send(session, make_capture(0, captured_s=0.5), encode, now=1.0)
    session.receive(ack(frame, total_ns=250_000_000), 2.0)
    (result,) = session.take_results()
    assert result.outcome is Outcome.ACKED
    assert result.packet == frame.packet
    assert result.packet_bytes > len(frame.packet.payload)
    assert (result.latency_s, result.link_s) == (1.5, 0.75)
    assert result.server_digest == frame.packet.reconstruction_digest
    assert session.is_idle


@pytest.mark.parametrize(
    "order",
    [
        pytest.param([0, 0, 1], id="duplicated"),
        pytest.param([1, 0], id="reordered"),
        pytest.param([1, 1, 0, 0], id="both"),
    ],
)
def test_answers_in_any_order_end_each_picture_once(
    session: AgentSession, make_capture: MakeCapture, encode: Encode, order: list[int]
) -> None:
    frames = [send(session, make_capture(i), encode) for i in range(2)]
    for number in order:
        session.receive(ack(frames[number]), 2.0)
    assert sorted(outcomes(session.take_results())) == [(0, "acked"), (1, "acked")]


def test_an_answer_to_a_frame_never_sent_is_ignored(session: AgentSession) -> None:
    session.receive(Ack(FrameAddress("front", 9, 9), StageTimes(), b""), 1.0)
    session.receive(FieldNotice(("cd" * 32,)), 1.0)
    assert session.take_results() == []


# --- recovery


def test_after_a_nack_the_next_packet_begins_a_new_epoch(
    session: AgentSession, make_capture: MakeCapture, encode: Encode
) -> None:
    frame = send(session, make_capture(0), encode)
    session.receive(Nack(frame.address, RejectReason.CRC_MISMATCH, "crc"), 2.0)
    (result,) = session.take_results()
    assert result.outcome is Outcome.NACKED
    assert (result.reason, result.problem) == (RejectReason.CRC_MISMATCH, "crc")
    after = send(session, make_capture(1), encode)
    assert (after.packet.epoch, after.packet.sequence) == (1, 0)


def test_a_server_in_a_later_epoch_is_overtaken(
    session: AgentSession, make_capture: MakeCapture, encode: Encode
) -> None:
    frame = send(session, make_capture(0), encode)
    nack = Nack(frame.address, RejectReason.STALE_EPOCH, "epoch 0 is over", current_epoch=700)
    session.receive(nack, 2.0)
    assert send(session, make_capture(1), encode).packet.epoch == 701


def test_a_nack_of_a_gap_covers_all_its_sequences(
    session: AgentSession, make_capture: MakeCapture, encode: Encode
) -> None:
    frames = [send(session, make_capture(i), encode) for i in range(2)]
    session.receive(Nack(frames[0].address, RejectReason.SEQUENCE_GAP, "lost", count=2), 2.0)
    assert outcomes(session.take_results()) == [(0, "nacked"), (1, "nacked")]


def test_an_overloaded_server_loses_the_frame_without_judging_it(
    session: AgentSession, make_capture: MakeCapture, encode: Encode
) -> None:
    frame = send(session, make_capture(0), encode)
    session.receive(Nack(frame.address, RejectReason.OVERLOADED, "shutting down"), 2.0)
    assert outcomes(session.take_results()) == [(0, "lost")]


def test_a_lost_connection_loses_what_was_unanswered_and_the_next_starts_afresh(
    session: AgentSession, make_capture: MakeCapture, encode: Encode
) -> None:
    send(session, make_capture(0), encode)
    session.connection_lost(UNAVAILABLE, 2.0)
    assert outcomes(session.take_results()) == [(0, "lost")]
    session.connected(3.0)
    session.messages_to_send(3.0)
    session.receive(Welcome("s-2", exact=True), 3.0)
    session.offer(make_capture(1))
    assert session.job_to_start(0.0) is None, "credit is granted anew"
    session.receive(Credit("front", 2), 3.0)
    job = session.job_to_start(0.0)
    assert job is not None
    assert job.epoch == 1


def test_a_failed_first_connection_costs_no_epoch(hello: Hello) -> None:
    session = AgentSession(hello)
    session.connection_lost(UNAVAILABLE, 0.5)
    session.connected(1.0)
    session.receive(Welcome("s-1", exact=True), 1.0)
    session.receive(Credit("front", 2), 1.0)
    assert session.epoch == 0


def test_a_picture_encoded_for_a_lost_connection_is_lost(
    session: AgentSession, make_capture: MakeCapture, encode: Encode
) -> None:
    session.offer(make_capture(0))
    job = session.job_to_start(0.0)
    assert job is not None
    session.connection_lost(UNAVAILABLE, 1.0)
    session.connected(1.1)
    session.receive(Welcome("s-2", exact=True), 1.1)
    session.encoded(encode(job), 1.2)
    assert outcomes(session.take_results()) == [(0, "lost")]
    assert not any(isinstance(m.message, Frame) for m in session.messages_to_send(1.2))


def test_an_answer_that_does_not_come_breaks_the_stream(
    session: AgentSession, make_capture: MakeCapture, encode: Encode
) -> None:
    send(session, make_capture(0), encode, now=1.0)
    assert session.get_timer() == 6.0
    session.handle_timer(5.9)
    assert session.broken is None
    session.handle_timer(6.0)
    assert session.broken == StreamEnd(EndReason.NO_ANSWER, "no answer to a frame within 5 s")


def test_a_picture_that_cannot_be_coded_uses_no_credit(
    session: AgentSession, make_capture: MakeCapture, encode: Encode
) -> None:
    for index in range(3):
        session.offer(make_capture(index))
        assert session.job_to_start(0.0) is not None
        session.encoding_failed(RfedgeError("not a readable picture"))
    assert outcomes(session.take_results()) == [(i, "dropped") for i in range(3)]
    assert send(session, make_capture(3), encode).packet.sequence == 0


def test_a_payload_no_server_would_take_is_dropped_here(
    session: AgentSession, make_capture: MakeCapture, encode: Encode
) -> None:
    session.offer(make_capture(0))
    job = session.job_to_start(0.0)
    assert isinstance(job, EncodeJob)
    session.encoded(encode(job, 1_000_001), 1.0)
    assert session.messages_to_send(1.0) == []
    (result,) = session.take_results()
    assert result.outcome is Outcome.DROPPED
    assert result.reason is EndReason.OVERSIZE
    assert result.problem.startswith("1000001 bytes of payload exceed")


def test_loading_a_picture_is_no_part_of_its_latency(
    session: AgentSession, make_capture: MakeCapture, encode: Encode
) -> None:
    def encode_slowly_read(job: EncodeJob) -> EncodedFrame:
        return replace(encode(job), read_s=0.25)

    frame = send(session, make_capture(0, captured_s=0.5), encode_slowly_read)
    session.receive(ack(frame), 2.0)
    (result,) = session.take_results()
    assert result.latency_s == 1.25
    assert result.stage_s == {"read": 0.25, "render": 0.01, "encode": 0.02}
    assert result.encoded is not None
    assert result.encoded.sender_s == pytest.approx(0.03)


def test_a_frame_refused_before_it_was_written_is_still_written(
    session: AgentSession, make_capture: MakeCapture, encode: Encode
) -> None:
    """It has used its credit; a Nack of something unreadable ended it meanwhile."""
    session.offer(make_capture(0))
    job = session.job_to_start(0.0)
    assert job is not None
    session.encoded(encode(job), 1.0)
    session.receive(Nack(FrameAddress("", 0, 0), RejectReason.INVALID_ARGUMENT, "garbage"), 1.1)
    (outgoing,) = session.messages_to_send(1.2)
    assert isinstance(outgoing.message, Frame)
    session.receive(ack(outgoing.message), 2.0)
    assert outcomes(session.take_results()) == [(0, "nacked")], "it ends once"


def test_an_abandoned_session_ends_every_picture_it_took(
    hello: Hello, make_capture: MakeCapture, encode: Encode
) -> None:
    session = AgentSession(hello)
    session.connected(0.0)
    session.receive(Welcome("s-1", exact=True), 0.0)
    session.receive(Credit("front", 3), 0.0)
    session.messages_to_send(0.0)
    send(session, make_capture(0), encode)
    session.offer(make_capture(1))
    assert session.job_to_start(1.0) is not None
    session.offer(make_capture(2))
    session.abandon(StreamEnd(EndReason.ABANDONED, "its stream was given up"), 2.0)
    results = session.take_results()
    assert sorted(outcomes(results)) == [(0, "lost"), (1, "lost"), (2, "lost")]
    assert {result.reason for result in results} == {EndReason.ABANDONED}
    assert session.is_idle


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"greeting_s": 0.0}, "limits.greeting_s"),
        ({"answer_s": float("nan")}, "limits.answer_s"),
        ({"give_up_s": -1.0}, "limits.give_up_s"),
        ({"slot_frames": 3}, "limits.slot_frames: 3"),
    ],
)
def test_bad_limits_are_refused_by_name(change: dict[str, float], named: str) -> None:
    with pytest.raises(InvalidInput, match=named):
        AgentLimits(**change)  # type: ignore[arg-type]
