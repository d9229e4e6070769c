"""Which frame the next one is predicted from: the last sent, or after a loss the last decoded."""

from collections.abc import Callable

import pytest

from cav_agent.frames import Capture, EncodedFrame, EncodeJob, EndReason, StreamEnd
from cav_agent.session import AgentSession
from rfcore.errors import RejectReason
from rfcore.wire.messages import Ack, Credit, Frame, Hello, Nack, StageTimes, Welcome

MakeCapture = Callable[..., Capture]
Encode = Callable[..., EncodedFrame]


class Sender:
    """A session with plenty of credit; sends pictures and remembers their jobs."""

    def __init__(self, session: AgentSession, make_capture: MakeCapture, encode: Encode) -> None:
        self.session = session
        self.jobs: list[EncodeJob] = []
        self._make_capture = make_capture
        self._encode = encode
        session.receive(Credit("front", 99), 0.0)

    def start(self) -> EncodeJob:
        self.session.offer(self._make_capture(len(self.jobs)))
        job = self.session.job_to_start(0.0)
        assert job is not None
        self.jobs.append(job)
        return job

    def finish(self, payload_bytes: int = 100) -> list[Frame]:
        self.session.encoded(self._encode(self.jobs[-1], payload_bytes), 1.0)
        outgoing = [entry.message for entry in self.session.messages_to_send(1.0)]
        return [message for message in outgoing if isinstance(message, Frame)]

    def send(self) -> Frame:
        self.start()
        (frame,) = self.finish()
        return frame

    def acked(self, frame: Frame, digest: bytes = b"d" * 16) -> None:
        self.session.receive(Ack(frame.address, StageTimes(), digest), 2.0)

    def nacked(self, frame: Frame, reason: RejectReason, current_epoch: int = 0) -> None:
        nack = Nack(frame.address, reason, "problem", current_epoch=current_epoch)
        self.session.receive(nack, 2.0)


@pytest.fixture
def sender(session: AgentSession, make_capture: MakeCapture, encode: Encode) -> Sender:
    return Sender(session, make_capture, encode)


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
    assert sender.finish() == []
    reasons = [result.reason for result in sender.session.take_results()]
    assert EndReason.BASE_LOST in reasons
    sender.send()
    assert sender.jobs[-1].base == first.address


def test_a_frame_too_large_to_send_is_no_base(sender: Sender) -> None:
    first = sender.send()
    sender.acked(first)
    sender.start()
    assert sender.finish(payload_bytes=1 << 20) == []
    sender.send()
    assert sender.jobs[-1].base == first.address


def test_another_connection_begins_without_a_base(sender: Sender) -> None:
    sender.acked(sender.send())
    sender.session.connection_lost(StreamEnd(EndReason.STREAM_LOST, "gone"), 3.0)
    sender.session.connected(4.0)
    sender.session.receive(Welcome("s-2", exact=True), 4.0)
    sender.session.receive(Credit("front", 2), 4.0)
    sender.send()
    assert sender.jobs[-1].base is None


def test_between_inexact_renderers_no_frame_has_a_base(
    hello: Hello, make_capture: MakeCapture, encode: Encode
) -> None:
    session = AgentSession(hello)
    session.connected(0.0)
    session.messages_to_send(0.0)
    session.receive(Welcome("s-1", exact=False), 0.0)
    sender = Sender(session, make_capture, encode)
    sender.acked(sender.send())
    sender.send()
    assert [(job.base, job.exact) for job in sender.jobs] == [(None, False)] * 2
