"""The vehicle's side of one camera's stream, without socket, clock or encoder.

``offer`` takes captured pictures into a slot where the newest wins; ``job_to_start`` hands one out
for encoding when the server's credit allows; ``encoded`` brings the packet back;
``messages_to_send`` has what goes up, ``receive`` takes what came down, ``get_timer`` says when
``handle_timer`` wants to be called, and ``take_results`` tells how each picture ended.

Pictures are dropped only before they are encoded. A frame is predicted from the one sent before it,
as if that had arrived. After a Nack a new epoch begins, and its first frame goes back to the last
one that the server is known to have decoded; after a lost connection, or when the server does not
have that one either, it needs nothing that went before. Between renderers that are not exact no
frame is ever predicted from another.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from enum import StrEnum

from cav_agent.answer_timeout import AnswerTimeout
from cav_agent.config import AgentLimits
from cav_agent.frames import (
    TOO_LATE,
    Capture,
    EncodedFrame,
    EncodeJob,
    FrameResult,
    Outcome,
)
from cav_agent.rate_control import ByteBudget, RateControl
from rfcore.errors import InvalidInput, ProtocolError, RejectReason, RfedgeError
from rfcore.wire.checks import MAX_PAYLOAD_BYTES
from rfcore.wire.convert import client_message_to_bytes
from rfcore.wire.messages import (
    Ack,
    ClientMessage,
    Credit,
    FieldNotice,
    Frame,
    FrameAddress,
    Hello,
    Nack,
    ServerMessage,
    Welcome,
)

__all__ = ["AgentSession", "LinkState"]


class LinkState(StrEnum):
    """Where the conversation with the server is."""

    DISCONNECTED = "disconnected"
    GREETING = "greeting"
    STREAMING = "streaming"


@dataclass(frozen=True)
class Pending:
    """An encoded frame that has not been answered, and how long that may last.

    ``base`` is the frame it was predicted from.
    """

    result: FrameResult
    encoded_s: float
    base: FrameAddress | None
    patience_s: float
    sent_s: float | None = None


class AgentSession:
    """One camera's stream to one server; ``hello`` names that camera first. ``rate_control`` says
    how many bytes each frame may take; without it all have the configured CRF."""

    def __init__(
        self,
        hello: Hello,
        limits: AgentLimits | None = None,
        rate_control: RateControl | None = None,
        *,
        first_epoch: int = 0,
    ) -> None:
        self.state = LinkState.DISCONNECTED
        self.session_id = ""
        self.exact: bool | None = None
        self.failed: RfedgeError | None = None
        self.broken: str | None = None
        self._hello = hello
        self._camera_id = hello.cameras[0].camera_id
        self._limits = limits or AgentLimits()
        self._rate_control = rate_control
        self._patience = AnswerTimeout(self._limits.answer_s)
        self._epoch = first_epoch
        self._epoch_used = False
        self._connection = 0
        self._granted = 0
        self._used = 0
        self._slot: deque[Capture] = deque()
        self._job: EncodeJob | None = None
        self._pending: dict[FrameAddress, Pending] = {}
        self._outbox: deque[ClientMessage] = deque()
        self._results: deque[FrameResult] = deque()
        self._greeting_until_s = 0.0
        self._sent: FrameAddress | None = None
        self._decoded: FrameAddress | None = None

    @property
    def epoch(self) -> int:
        """The epoch of the next packet."""
        return self._epoch

    @property
    def is_idle(self) -> bool:
        """Whether no picture waits, is being encoded or is unanswered."""
        return not (self._slot or self._job or self._pending)

    # --- connection

    def connected(self, now: float) -> None:
        """A stream is open: greet the server."""
        self.state = LinkState.GREETING
        self.broken = None
        self._connection += 1
        self._granted = self._used = 0
        self._greeting_until_s = now + self._limits.greeting_s
        self._patience.begin()
        self._outbox.append(self._hello)

    def connection_lost(self, reason: str, now: float) -> None:
        """The stream is gone, and with it every frame that was not answered."""
        self.state = LinkState.DISCONNECTED
        self._outbox.clear()
        for address in list(self._pending):
            self._finish(address, Outcome.LOST, reason, now)
        self._decoded = None
        self._start_epoch()

    def receive(self, message: ServerMessage, now: float) -> None:
        """Take one message of the server."""
        match message:
            case Welcome(session_id, exact):
                self.state = LinkState.STREAMING
                self.session_id, self.exact = session_id, exact
            case Credit(camera_id, frames) if camera_id == self._camera_id:
                self._granted = max(self._granted, frames)
            case Ack():
                self._acked(message, now)
            case Nack():
                self._nacked(message, now)
            case FieldNotice() | Credit():
                pass  # the refusal that follows a notice names both ids

    def _acked(self, ack: Ack, now: float) -> None:
        pending = self._pending.get(ack.address)
        if pending is None:
            return
        since_s = pending.encoded_s if pending.sent_s is None else pending.sent_s
        self._patience.answered(now - pending.encoded_s)
        link_s = max(0.0, now - since_s - ack.times.total_ns / 1e9)
        answered = replace(
            pending.result,
            server=ack.times,
            server_digest=ack.reconstruction_digest,
            link_s=link_s,
        )
        self._pending[ack.address] = replace(pending, result=answered)
        packet = pending.result.packet
        if packet is not None and packet.reconstruction_digest == ack.reconstruction_digest:
            self._decoded = ack.address
        self._finish(ack.address, Outcome.ACKED, "", now)

    def _nacked(self, nack: Nack, now: float) -> None:
        if self.state is LinkState.GREETING:
            self.failed = ProtocolError(f"the server refused this vehicle's Hello: {nack.problem}")
            return
        overloaded = nack.reason is RejectReason.OVERLOADED  # never looked at: may be sent again
        outcome = Outcome.LOST if overloaded else Outcome.NACKED
        for address, pending in list(self._pending.items()):
            if _covers(nack, address):
                if nack.reason is RejectReason.UNKNOWN_STATE and pending.base == self._decoded:
                    self._decoded = None
                self._finish(address, outcome, f"{nack.reason}: {nack.problem}", now)
        is_over = nack.address.camera_id != "" and nack.address.epoch < self._epoch
        if is_over and nack.current_epoch <= self._epoch:
            return  # it follows from a loss that a new epoch has answered already
        self._start_epoch(nack.current_epoch)

    def _start_epoch(self, above: int = -1) -> None:
        """Begin a new epoch, unless the present one has no packet yet and is new enough; go back
        to the last frame known to have been decoded."""
        if self._epoch_used or self._epoch <= above:
            self._epoch = max(self._epoch, above) + 1
            self._epoch_used = False
        self._sent = self._decoded

    # --- pictures

    def offer(self, capture: Capture) -> None:
        """Take a picture; the oldest that waits is dropped when there is no room for it."""
        if len(self._slot) >= self._limits.slot_frames:
            self._drop("superseded")
        self._slot.append(capture)
        if self._rate_control is not None:
            self._rate_control.captured(capture.captured_s)

    def withdraw(self) -> None:
        """Let go what waits for the encoder, to be captured again for another server."""
        while self._slot:
            self._results.append(FrameResult(self._slot.popleft(), Outcome.LOST, "handed over"))

    def stop(self) -> None:
        """Drop what waits for the encoder; what is being encoded or unanswered goes on."""
        while self._slot:
            self._drop("stopping")

    def _drop(self, reason: str) -> None:
        self._results.append(FrameResult(self._slot.popleft(), Outcome.DROPPED, reason))

    def job_to_start(self, now: float) -> EncodeJob | None:
        """Return the picture to encode now; None without picture, credit, free encoder or room."""
        ready = self.state is LinkState.STREAMING and self._job is None
        self._drop_late(now)
        if not ready or not self._slot or self._used >= self._granted:
            return None
        budget: ByteBudget | None = None
        if self._rate_control is not None:
            budget = self._rate_control.budget(self._slot[0].captured_s, now)
            if budget is None:
                return None
        exact = bool(self.exact)
        base = self._sent if exact else None
        self._job = EncodeJob(
            self._slot.popleft(), self._epoch, self._connection, base, exact, budget
        )
        self._epoch_used = True
        return self._job

    def _drop_late(self, now: float) -> None:
        control = self._rate_control
        while control is not None and self._slot and control.is_late(self._slot[0].captured_s, now):
            self._drop(TOO_LATE)

    def encoded(self, encoded: EncodedFrame, now: float) -> None:
        """The picture of the running job became ``encoded``: send it, if its stream still is."""
        job = self._take_job()
        frame = self._frame(job.capture, encoded)
        result = FrameResult(
            job.capture,
            Outcome.LOST,
            packet=encoded.packet,
            packet_bytes=len(client_message_to_bytes(frame)),
            stage_s=encoded.stage_s,
            tries=encoded.tries,
            rung=encoded.rung,
            crf=encoded.crf,
            budget=job.budget,
        )
        if self._rate_control is not None:
            payload_bytes = len(encoded.packet.payload)
            self._rate_control.coded(encoded.stage_s, payload_bytes, result.packet_bytes)
        under_way = sum(p.result.packet_bytes for p in self._pending.values())
        patience_s = self._patience.limit_s(under_way + result.packet_bytes)
        self._pending[frame.address] = Pending(result, now, job.base, patience_s)
        if len(encoded.packet.payload) > MAX_PAYLOAD_BYTES:
            problem = (
                f"{len(encoded.packet.payload)} bytes of payload exceed {MAX_PAYLOAD_BYTES} "
                "even at the highest CRF"
            )
            self._finish(frame.address, Outcome.DROPPED, f"oversize: {problem}", now)
            self._start_epoch()
        elif job.connection != self._connection or self.state is not LinkState.STREAMING:
            self._finish(frame.address, Outcome.LOST, "the stream ended before it was sent", now)
        elif job.epoch != self._epoch and job.base is not None:
            self._finish(frame.address, Outcome.LOST, "the frame it needs was not decoded", now)
        else:
            self._used += 1
            self._sent = frame.address
            self._outbox.append(frame)

    def encoding_failed(self, error: RfedgeError) -> None:
        """The picture of the running job could not be read or coded."""
        job = self._take_job()
        self._results.append(FrameResult(job.capture, Outcome.DROPPED, str(error)))
        self._start_epoch()

    def _take_job(self) -> EncodeJob:
        if self._job is None:
            raise InvalidInput("encoded", "no picture is being encoded")
        job, self._job = self._job, None
        return job

    def _frame(self, capture: Capture, encoded: EncodedFrame) -> Frame:
        return Frame(
            self._camera_id,
            capture.capture_time_ns,
            encoded.pose or capture.picture.camera.world_from_cam,
            b"",  # the field of Hello; an agent has one
            encoded.packet,
            encoded.rung.quality,
        )

    def _finish(self, address: FrameAddress, outcome: Outcome, reason: str, now: float) -> None:
        result = self._pending.pop(address).result
        # A camera hands its picture over; that ours comes from a file is the replay's cost.
        reading_s = result.stage_s.get("read", 0.0)
        latency_s = now - result.capture.captured_s - reading_s
        self._results.append(replace(result, outcome=outcome, reason=reason, latency_s=latency_s))
        if self._rate_control is None:
            return
        if outcome in (Outcome.ACKED, Outcome.NACKED):
            self._rate_control.answered(address, latency_s, now)
        else:
            self._rate_control.lost(address)

    # --- what goes out, and time

    def messages_to_send(self, now: float) -> list[ClientMessage]:
        """Return, once, what is to be written to the stream, which counts as sent ``now``."""
        messages = list(self._outbox)
        self._outbox.clear()
        for message in messages:
            if isinstance(message, Frame):
                sent = replace(self._pending[message.address], sent_s=now)
                self._pending[message.address] = sent
                if self._rate_control is not None:
                    size_bytes = sent.result.packet_bytes
                    self._rate_control.sent(message.address, size_bytes, now)
        return messages

    def take_results(self) -> list[FrameResult]:
        """Return, once, the pictures that came to an end."""
        results = list(self._results)
        self._results.clear()
        return results

    def get_timer(self) -> float | None:
        """Return when ``handle_timer`` has something to do, or None."""
        if self.state is LinkState.GREETING:
            return self._greeting_until_s
        if self.state is LinkState.STREAMING and self._pending:
            return min(p.encoded_s + p.patience_s for p in self._pending.values())
        return None

    def handle_timer(self, now: float) -> None:
        """Give the stream up (``broken`` says why) when an answer is overdue."""
        timer = self.get_timer()
        if timer is None or now < timer or self.broken is not None:
            return
        if self.state is LinkState.GREETING:
            self.broken = f"no Welcome within {self._limits.greeting_s:g} s"
        else:
            waited_s = now - min(p.encoded_s for p in self._pending.values())
            self.broken = f"no answer to a frame within {waited_s:.2g} s"


def _covers(nack: Nack, address: FrameAddress) -> bool:
    first = nack.address
    if first.camera_id == "" and nack.reason is RejectReason.INVALID_ARGUMENT:
        return True  # unreadable for the server: any frame on its way may be the one
    same = (address.camera_id, address.epoch) == (first.camera_id, first.epoch)
    return same and first.sequence <= address.sequence < first.sequence + nack.count
