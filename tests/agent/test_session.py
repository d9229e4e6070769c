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
    Outcome,
    StreamEnd,
)
from cav_agent.session import AgentSession, LinkState, OutgoingMessage
from rfcore.camera import Pose
from rfcore.errors import InvalidInput, ProtocolError, RejectReason, RfedgeError
from rfcore.wire.convert import hello_to_bytes
from rfcore.wire.messages import (
    MAX_EPOCH_STEP,
    Ack,
    Credit,
    FieldNotice,
    Frame,
    FrameAddress,
    Hello,
    Nack,
    PoseAhead,
    StageTimes,
    Welcome,
)

MakeCapture = Callable[..., Capture]
Encode = Callable[..., EncodedFrame]

UNAVAILABLE = StreamEnd(EndReason.STREAM_LOST, "UNAVAILABLE: connection reset")
UNREADABLE = Nack(FrameAddress("", 0, 0), RejectReason.INVALID_ARGUMENT, "garbage")


class Sender:
    """A vehicle's session with plenty of credit; sends pictures and remembers their jobs."""

    def __init__(self, session: AgentSession, make_capture: MakeCapture, encode: Encode) -> None:
        self.session = session
        self.jobs: list[EncodeJob] = []
        self._make_capture = make_capture
        self._encode = encode
        session.receive(Credit("front", 99), 0.0)

    def connect(self, session_id: str, *, exact: bool = True) -> None:
        """Connect again, be welcomed and get some credit."""
        self.session.connected(3.0)
        self.session.messages_to_send(3.0)
        self.session.receive(Welcome(session_id, exact=exact), 3.0)
        self.session.receive(Credit("front", 99), 3.0)

    def start(self, captured_s: float = 0.0) -> EncodeJob:
        """Offer the next picture, which is encoded at once."""
        self.session.offer(self._make_capture(len(self.jobs), captured_s))
        job = self.session.job_to_start(0.0)
        assert job is not None
        self.jobs.append(job)
        return job

    def finish(self, payload_bytes: int = 100, now: float = 1.0, read_s: float = 0.0) -> None:
        """Have the encoder be done."""
        encoded = self._encode(self.jobs[-1], payload_bytes)
        self.session.encoded(replace(encoded, read_s=read_s), now)

    def written(self, now: float = 1.0) -> list[Frame]:
        """Return the frames that are to be written to the stream."""
        outgoing = self.session.messages_to_send(now)
        self.sent_bytes = sum(len(entry.data) for entry in outgoing)
        return [entry.message for entry in outgoing if isinstance(entry.message, Frame)]

    def send(self, captured_s: float = 0.0, now: float = 1.0, read_s: float = 0.0) -> Frame:
        """Offer, encode and send one picture; return the frame as the server would get it."""
        self.start(captured_s)
        self.finish(now=now, read_s=read_s)
        (frame,) = self.written(now)
        return frame

    def acked(self, frame: Frame, digest: bytes = b"digest", total_ns: int = 0) -> None:
        """Acknowledge a frame at second 2."""
        self.session.receive(Ack(frame.address, StageTimes(total_ns=total_ns), digest), 2.0)

    def nacked(self, frame: Frame, reason: RejectReason, **more: int) -> None:
        """Refuse a frame at second 2."""
        self.session.receive(Nack(frame.address, reason, "problem", **more), 2.0)

    def outcomes(self) -> list[tuple[int, str]]:
        """Return how pictures ended since this was asked last."""
        results = self.session.take_results()
        return [(result.capture.index, str(result.outcome)) for result in results]


@pytest.fixture
def sender(session: AgentSession, make_capture: MakeCapture, encode: Encode) -> Sender:
    return Sender(session, make_capture, encode)


# --- greeting


def test_a_connection_begins_with_hello_and_streams_after_welcome(hello: Hello) -> None:
    session = AgentSession(hello)
    session.connected(0.0)
    assert session.messages_to_send(0.0) == [OutgoingMessage(hello, hello_to_bytes(hello))]
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


def test_what_a_picture_waits_for_is_known(hello: Hello, make_capture: MakeCapture) -> None:
    session = AgentSession(hello)
    assert session.waits_for == "", "no connection is the connection's to tell"
    session.connected(0.0)
    assert "welcome" in session.waits_for
    session.receive(Welcome("s-1", exact=True), 0.0)
    assert session.waits_for == "", "there is no picture"
    session.offer(make_capture(0))
    assert "credit" in session.waits_for
    session.receive(Credit("front", 2), 0.0)
    assert session.job_to_start(0.0) is not None
    assert "encoder" in session.waits_for


# --- pictures and credits


def test_the_newest_picture_wins_and_the_older_is_reported_dropped(
    session: AgentSession, make_capture: MakeCapture
) -> None:
    for index in range(4):
        session.offer(make_capture(index))
    job = session.job_to_start(0.0)
    assert job is not None
    assert job.capture.index == 3
    assert [r.capture.index for r in session.take_results()] == [0, 1, 2]


def test_credit_bounds_what_is_sent_and_never_falls(
    session: AgentSession, make_capture: MakeCapture, encode: Encode
) -> None:
    session.receive(Credit("front", 1), 0.0)
    for index in range(2):
        session.offer(make_capture(index))
        job = session.job_to_start(0.0)
        assert job is not None
        session.encoded(encode(job), 1.0)
    session.offer(make_capture(2))
    assert session.job_to_start(0.0) is None
    session.receive(Credit("front", 3), 2.0)
    assert session.job_to_start(0.0) is not None


def test_an_ack_ends_a_picture_with_its_sizes_and_times(sender: Sender) -> None:
    frame = sender.send(captured_s=0.5)
    sender.acked(frame, total_ns=250_000_000)
    (result,) = sender.session.take_results()
    assert result.outcome is Outcome.ACKED
    assert result.packet == frame.packet
    assert result.packet_bytes == sender.sent_bytes
    assert (result.latency_s, result.link_s) == (1.5, 0.75)
    assert result.server_digest == frame.packet.reconstruction_digest
    assert sender.session.is_idle


@pytest.mark.parametrize(
    "order",
    [
        pytest.param([0, 0, 1], id="duplicated"),
        pytest.param([1, 0], id="reordered"),
        pytest.param([1, 1, 0, 0], id="both"),
    ],
)
def test_answers_in_any_order_end_each_picture_once(sender: Sender, order: list[int]) -> None:
    frames = [sender.send() for _ in range(2)]
    for number in order:
        sender.acked(frames[number])
    assert sorted(sender.outcomes()) == [(0, "acked"), (1, "acked")]


def test_an_answer_to_a_frame_never_sent_is_ignored(session: AgentSession) -> None:
    session.receive(Ack(FrameAddress("front", 9, 9), StageTimes(), b""), 1.0)
    session.receive(FieldNotice(("cd" * 32,)), 1.0)
    assert session.take_results() == []


# --- recovery


def test_after_a_nack_the_next_packet_begins_a_new_epoch(sender: Sender) -> None:
    sender.nacked(sender.send(), RejectReason.CRC_MISMATCH)
    (result,) = sender.session.take_results()
    assert result.outcome is Outcome.NACKED
    assert (result.reason, result.problem) == (RejectReason.CRC_MISMATCH, "problem")
    after = sender.send()
    assert (after.packet.epoch, after.packet.sequence) == (1, 0)


def test_a_server_in_a_later_epoch_is_overtaken(sender: Sender) -> None:
    sender.nacked(sender.send(), RejectReason.STALE_EPOCH, current_epoch=700)
    assert sender.send().packet.epoch == 701


@pytest.mark.parametrize("epoch", [2**32 - 1, 2**32 - 2, MAX_EPOCH_STEP + 1])
def test_an_epoch_that_no_server_can_have_ends_the_stream(sender: Sender, epoch: int) -> None:
    with pytest.raises(ProtocolError, match=f"epoch {epoch}, and this vehicle is in 0"):
        sender.nacked(sender.send(), RejectReason.STALE_EPOCH, current_epoch=epoch)


def test_a_problem_of_any_length_is_cut(sender: Sender) -> None:
    nack = Nack(sender.send().address, RejectReason.CRC_MISMATCH, "x" * 900_000)
    sender.session.receive(nack, 2.0)
    assert len(sender.session.take_results()[0].problem) < 1000


def test_a_nack_of_a_gap_covers_all_its_sequences(sender: Sender) -> None:
    first, _ = sender.send(), sender.send()
    sender.nacked(first, RejectReason.SEQUENCE_GAP, count=2)
    assert sender.outcomes() == [(0, "nacked"), (1, "nacked")]


def test_an_overloaded_server_loses_the_frame_without_judging_it(sender: Sender) -> None:
    sender.nacked(sender.send(), RejectReason.OVERLOADED)
    assert sender.outcomes() == [(0, "lost")]


def test_a_lost_connection_loses_what_was_unanswered_and_the_next_starts_afresh(
    sender: Sender, make_capture: MakeCapture
) -> None:
    session = sender.session
    sender.send()
    session.connection_lost(UNAVAILABLE, 2.0)
    assert sender.outcomes() == [(0, "lost")]
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


def test_a_picture_encoded_for_a_lost_connection_is_lost(sender: Sender) -> None:
    sender.start()
    sender.session.connection_lost(UNAVAILABLE, 1.0)
    sender.connect("s-2")
    sender.finish(now=3.2)
    assert sender.outcomes() == [(0, "lost")]
    assert sender.written() == []


def test_an_answer_that_does_not_come_breaks_the_stream(sender: Sender) -> None:
    sender.send()
    session = sender.session
    assert session.get_timer() == 6.0
    session.handle_timer(5.9)
    assert session.broken is None
    session.handle_timer(6.0)
    assert session.broken == StreamEnd(EndReason.NO_ANSWER, "no answer to a frame within 5 s")


def test_a_picture_that_cannot_be_coded_uses_no_credit(sender: Sender) -> None:
    for _ in range(3):
        sender.start()
        sender.session.encoding_failed(RfedgeError("not a readable picture"))
    assert sender.outcomes() == [(i, "dropped") for i in range(3)]
    assert sender.send().packet.sequence == 0


def test_a_payload_no_server_would_take_is_dropped_here(sender: Sender) -> None:
    sender.start()
    sender.finish(1_000_001)
    assert sender.written() == []
    (result,) = sender.session.take_results()
    assert result.outcome is Outcome.DROPPED
    assert result.reason is EndReason.OVERSIZE
    assert result.problem.startswith("1000001 bytes of payload exceed")


def test_loading_a_picture_is_no_part_of_its_latency(sender: Sender) -> None:
    sender.acked(sender.send(captured_s=0.5, read_s=0.25))
    (result,) = sender.session.take_results()
    assert result.latency_s == 1.25
    assert result.stage_s == {"read": 0.25, "render": 0.01, "encode": 0.02}
    assert result.encoded is not None
    assert result.encoded.sender_s == pytest.approx(0.03)


def test_a_frame_refused_before_it_was_written_is_still_written(sender: Sender) -> None:
    """It has used its credit; a Nack of something unreadable ended it meanwhile."""
    sender.start()
    sender.finish()
    sender.session.receive(UNREADABLE, 1.1)
    (frame,) = sender.written(1.2)
    sender.acked(frame)
    assert sender.outcomes() == [(0, "nacked")], "it ends once"


def test_an_abandoned_session_ends_every_picture_it_took(
    sender: Sender, make_capture: MakeCapture
) -> None:
    sender.send()
    sender.start()
    sender.session.offer(make_capture(2))
    sender.session.abandon(StreamEnd(EndReason.ABANDONED, "its stream was given up"), 2.0)
    results = sender.session.take_results()
    ended = sorted((result.capture.index, str(result.outcome)) for result in results)
    assert ended == [(0, "lost"), (1, "lost"), (2, "lost")]
    assert {result.reason for result in results} == {EndReason.ABANDONED}
    assert sender.session.is_idle


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


# --- which frame the next one is predicted from: the last sent, or after a loss the last decoded


def test_a_frame_is_predicted_from_the_one_sent_before_it(sender: Sender) -> None:
    frames = [sender.send() for _ in range(3)]
    assert [job.base for job in sender.jobs] == [None, frames[0].address, frames[1].address]


def test_after_a_loss_the_next_frame_goes_back_to_the_last_one_decoded(sender: Sender) -> None:
    first, second, _ = (sender.send() for _ in range(3))
    sender.acked(first)
    sender.nacked(second, RejectReason.CRC_MISMATCH)
    again = sender.send()
    assert sender.jobs[-1].base == first.address
    assert again.packet.epoch == 1


def test_refusals_that_follow_from_one_loss_begin_no_further_epoch(sender: Sender) -> None:
    first, second, third = (sender.send() for _ in range(3))
    sender.acked(first)
    sender.nacked(second, RejectReason.CRC_MISMATCH)
    healed = sender.send()
    sender.nacked(third, RejectReason.UNKNOWN_STATE)
    following = sender.send()
    assert sender.jobs[-1].base == healed.address
    assert following.packet.epoch == 1


def test_a_server_that_lost_its_frames_is_sent_one_that_needs_none(sender: Sender) -> None:
    first = sender.send()
    sender.acked(first)
    second = sender.send()
    sender.nacked(second, RejectReason.UNKNOWN_STATE)
    sender.send()
    assert sender.jobs[-1].base is None


def test_a_frame_decoded_to_something_else_is_no_base(sender: Sender) -> None:
    first = sender.send()
    sender.acked(first, b"x" * 16)
    second = sender.send()
    sender.nacked(second, RejectReason.DECODER_FAILED)
    sender.send()
    assert sender.jobs[-1].base is None


def test_a_frame_encoded_on_a_lost_base_is_not_sent(sender: Sender) -> None:
    first, second = sender.send(), sender.send()
    sender.acked(first)
    sender.start()
    sender.nacked(second, RejectReason.CRC_MISMATCH)
    sender.finish()
    assert sender.written() == []
    reasons = [result.reason for result in sender.session.take_results()]
    assert EndReason.BASE_LOST in reasons
    sender.send()
    assert sender.jobs[-1].base == first.address


def test_a_frame_too_large_to_send_is_no_base(sender: Sender) -> None:
    first = sender.send()
    sender.acked(first)
    sender.start()
    sender.finish(payload_bytes=1 << 20)
    assert sender.written() == []
    sender.send()
    assert sender.jobs[-1].base == first.address


def test_another_connection_begins_without_a_base(sender: Sender) -> None:
    sender.acked(sender.send())
    sender.session.connection_lost(UNAVAILABLE, 3.0)
    sender.connect("s-2")
    sender.send()
    assert sender.jobs[-1].base is None


def test_between_inexact_renderers_no_frame_has_a_base(sender: Sender) -> None:
    sender.session.connection_lost(UNAVAILABLE, 0.0)
    sender.connect("s-2", exact=False)
    sender.acked(sender.send())
    sender.send()
    assert [(job.base, job.exact) for job in sender.jobs] == [(None, False)] * 2


# --- poses ahead of their frames


def ahead_of(job: EncodeJob, sequence: int) -> PoseAhead:
    capture = job.capture
    pose = Pose.identity()
    return PoseAhead(capture.camera_id, job.epoch, sequence, capture.capture_time_ns, pose)


def test_a_pose_goes_ahead_of_its_frame_which_leaves_it_out(sender: Sender) -> None:
    sizes = []
    for number, ahead in enumerate([False, True]):
        job = sender.start()
        if ahead:
            sender.session.located(job, ahead_of(job, number))
            (outgoing,) = sender.session.messages_to_send(0.5)
            assert outgoing.message == ahead_of(job, number)
        sender.finish()
        (frame,) = sender.written()
        sizes.append(sender.sent_bytes)
        sender.acked(frame)
    (alone, after) = sender.session.take_results()
    assert after.ahead_bytes == len(outgoing.data) > 0 == alone.ahead_bytes
    assert after.packet_bytes == sizes[1] + after.ahead_bytes, "both count"
    assert sizes[1] < sizes[0]


def test_no_pose_goes_ahead_of_a_frame_that_will_not_be_sent(sender: Sender) -> None:
    job = sender.start()
    sender.session.connection_lost(UNAVAILABLE, 1.0)
    sender.session.located(job, ahead_of(job, 0))
    assert sender.session.messages_to_send(1.0) == []
    sender.finish()
    sender.connect("s-2")
    sender.session.located(job, ahead_of(job, 0))
    assert sender.session.messages_to_send(1.0) == []


def test_a_frame_refused_after_its_pose_is_followed_by_one_that_says_all(sender: Sender) -> None:
    job = sender.start()
    sender.session.located(job, ahead_of(job, 0))
    sender.finish()
    (frame,) = sender.written()
    sender.nacked(frame, RejectReason.UNKNOWN_STATE)
    job = sender.start()
    sender.session.located(job, ahead_of(job, 0))
    assert sender.session.messages_to_send(1.0) == []
