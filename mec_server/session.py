"""The server's side of one stream, without socket, clock or decoder.

``receive`` takes what the vehicle said, ``jobs_to_start`` hands out numerical work, ``opened`` /
``decoded`` / ``rejected`` bring its outcome back, ``messages_to_send`` has the answers, and
``get_timer`` says when ``handle_timer`` wants to be called. ``closed`` becomes an error (or a clean
end) when the stream is over.

States: awaiting hello -> opening -> open -> draining -> closed. A Hello or Frame with a bad value
is answered with a Nack and the session lives on; a broken rule of the conversation ends it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from enum import StrEnum

from mec_server.camera_queue import CameraQueue, Waiting
from mec_server.config import SessionLimits
from mec_server.decode_jobs import DecodeJob, DecodeOutcome, End, OpenJob
from mec_server.quotas import Limit
from rfcore.errors import (
    AccessDenied,
    InvalidInput,
    LimitExceeded,
    PacketRejected,
    ProtocolError,
    RejectReason,
    RfedgeError,
    UnknownField,
)
from rfcore.wire.checks import FIELD_ID_PREFIX_BYTES, MAX_FIELDS, shown
from rfcore.wire.conventions import RENDERER_CONTRACT
from rfcore.wire.convert import FrameRefused
from rfcore.wire.identity import PeerIdentity
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
    StageTimes,
    Welcome,
)

__all__ = ["ServerSession", "SessionState"]


MAX_UNUSABLE = 64
"""Messages in a row that are refused before any work is spent on them; then the stream ends."""


class SessionState(StrEnum):
    """Where the conversation is."""

    AWAITING_HELLO = "awaiting_hello"
    OPENING = "opening"
    OPEN = "open"
    DRAINING = "draining"
    CLOSED = "closed"


class ServerSession:
    """One vehicle's stream; ``held_field_ids`` are the fields this server has.

    ``identity``: whom its certificate names; without one any name is taken.
    """

    def __init__(
        self,
        session_id: str,
        held_field_ids: Sequence[str],
        now: float,
        limits: SessionLimits | None = None,
        identity: PeerIdentity | None = None,
    ) -> None:
        self.session_id = session_id
        self.hello: Hello | None = None
        self.state = SessionState.AWAITING_HELLO
        self.closed: End | None = None
        self._limits = limits or SessionLimits()
        self._held = tuple(held_field_ids)
        self._identity = identity
        self._lanes: dict[str, CameraQueue] = {}
        self._fields: dict[bytes, str] = {}
        self._opening: OpenJob | None = None
        self._outbox: deque[ServerMessage] = deque()
        self._deadline_s = now + self._limits.hello_s
        self._unusable = 0
        self._exact = False
        self._rate_hz = 0.0

    # --- what the vehicle said

    def end(self, error: RfedgeError) -> None:
        """End the stream for a reason that lies outside of the conversation."""
        self._close(error)

    def receive(self, message: ClientMessage, now: float) -> None:
        """Take one checked message."""
        if isinstance(message, Hello):
            self._receive_hello(message)
        else:
            self._receive_frame(message, now)

    def refuse(self, error: InvalidInput, now: float) -> None:
        """Answer for a message that failed its checks; the session lives on."""
        address = error.address if isinstance(error, FrameRefused) else FrameAddress("", 0, 0)
        lane = self._lanes.get(address.camera_id)
        if lane is None:
            for other in self._lanes.values():  # whose it was cannot be told; nobody shall starve
                other.answered += 1
        else:
            lane.refuse(address.epoch, address.sequence)
        self._nack(address, RejectReason.INVALID_ARGUMENT, str(error))
        self._alive(now)
        self._unusable_frame()

    def overrun(self, frame: Frame, error: LimitExceeded, now: float) -> None:
        """Answer for a frame beyond the vehicle's quota; the session lives on."""
        lane = self._lanes.get(frame.camera_id)
        if lane is not None:
            lane.refuse(frame.packet.epoch, frame.packet.sequence)
        self._nack(frame.address, RejectReason.OVERLOADED, str(error))
        self._alive(now)
        self._unusable_frame()

    def _unusable_frame(self) -> None:
        self._unusable += 1
        if self._unusable >= MAX_UNUSABLE:
            self._close(
                LimitExceeded(
                    Limit.UNUSABLE_FRAMES,
                    f"{self._unusable} messages in a row could not be used; each was answered",
                )
            )

    def _receive_hello(self, hello: Hello) -> None:
        if self.state is not SessionState.AWAITING_HELLO:
            self._close(ProtocolError("a stream has one Hello; open another stream"))
            return
        if self._identity is not None:
            try:
                self._identity.check_vehicle(hello.vehicle_id)
            except AccessDenied as error:
                self._close(error)
                return
        unknown = [field_id for field_id in hello.field_ids if field_id not in self._held]
        if unknown:
            self._outbox.append(FieldNotice(self._held[:MAX_FIELDS]))
            self._close(_unknown_field(unknown[0], self._held))
            return
        exact = hello.renderer.exact and hello.renderer.name == RENDERER_CONTRACT
        self.state = SessionState.OPENING
        self._opening = OpenJob(hello, exact)

    def _receive_frame(self, frame: Frame, now: float) -> None:
        if self.state is SessionState.AWAITING_HELLO:
            self._close(ProtocolError("a frame came before Hello"))
            return
        self._alive(now)
        try:
            lane = self._lane_of(frame)
            if self.state is SessionState.DRAINING:
                raise PacketRejected(RejectReason.OVERLOADED, "this server is shutting down")
            lane.admit(frame, now)
        except InvalidInput as error:
            self.refuse(FrameRefused(error, frame.address), now)
        except PacketRejected as error:
            self._lanes[frame.camera_id].refuse(frame.packet.epoch, frame.packet.sequence)
            self._nack(frame.address, error.reason, error.problem)
            self._unusable_frame()

    def _lane_of(self, frame: Frame) -> CameraQueue:
        if frame.camera_id not in self._lanes:
            raise InvalidInput(
                "frame.camera_id", f"{shown(frame.camera_id)} is not a camera of this Hello"
            )
        if frame.field_id_prefix not in self._fields:
            raise InvalidInput(
                "frame.field_id_prefix",
                f"{frame.field_id_prefix.hex()} is not a field of this Hello "
                f"({', '.join(dict.fromkeys(self._fields.values()))})",
            )
        return self._lanes[frame.camera_id]

    # --- numerical work

    def jobs_to_start(self, now: float) -> list[OpenJob | DecodeJob]:
        """Return the work that can begin now: one frame a camera, in order."""
        jobs: list[OpenJob | DecodeJob] = []
        if self._opening is not None and self.state is SessionState.OPENING:
            jobs.append(self._opening)
            self._opening = None
        for lane in self._lanes.values():
            while (waiting := lane.start()) is not None:
                job = self._job(lane, waiting, now)
                if job is not None:
                    jobs.append(job)
                    break
        self._finish_draining()
        return jobs

    def _job(self, lane: CameraQueue, waiting: Waiting, now: float) -> DecodeJob | None:
        frame = waiting.frame
        try:
            lane.check_order(frame)
        except PacketRejected as error:
            lane.fail()
            self._nack(frame.address, error.reason, error.problem)
            return None
        return DecodeJob(frame, self._fields[frame.field_id_prefix], waiting.received_s, now)

    def opened(self, job: OpenJob, now: float) -> None:
        """Fields and decoders of ``job`` are ready."""
        if self.state is not SessionState.OPENING:
            return
        self.state = SessionState.OPEN
        self.hello = job.hello
        for camera in job.hello.cameras:
            self._lanes[camera.camera_id] = CameraQueue(camera, self._limits.window_frames)
        for field_id in job.hello.field_ids:
            self._fields[bytes.fromhex(field_id)[:FIELD_ID_PREFIX_BYTES]] = field_id
        self._fields[b""] = job.hello.field_ids[0]
        self._exact = job.exact
        self._outbox.append(Welcome(self.session_id, job.exact, self._rate_hz))
        for camera_id, lane in self._lanes.items():
            self._outbox.append(Credit(camera_id, lane.granted))
        self._alive(now)

    def grant(self, rate_hz: float) -> None:
        """Let each camera send so many pictures per second; 0: as many as credits allow."""
        self._rate_hz = rate_hz
        if self.state is SessionState.OPEN:
            self._outbox.append(Welcome(self.session_id, self._exact, rate_hz))

    def open_failed(self, error: RfedgeError, now: float) -> None:
        """Hello named something that cannot be opened; a bad value leaves room for another."""
        if self.state is not SessionState.OPENING:
            return
        if not isinstance(error, InvalidInput):
            self._close(error)
            return
        self.state = SessionState.AWAITING_HELLO
        self._deadline_s = now + self._limits.hello_s
        self._nack(FrameAddress("", 0, 0), RejectReason.INVALID_ARGUMENT, str(error))

    def decoded(self, job: DecodeJob, outcome: DecodeOutcome, now: float) -> None:
        """The frame of ``job`` was reconstructed."""
        self._unusable = 0
        lane = self._lanes[job.frame.camera_id]
        address, times = job.frame.address, outcome.times
        for gap in lane.succeed(outcome.lost):
            first = replace(address, sequence=gap.first)
            self._nack(first, RejectReason.SEQUENCE_GAP, "never arrived", gap.count)
        times = StageTimes(
            queue_ns=_ns(job.started_s - job.received_s),
            render_ns=times.render_ns,
            splice_ns=times.splice_ns,
            decode_ns=times.decode_ns,
            total_ns=_ns(now - job.received_s),
        )
        self._outbox.append(Ack(address, times, outcome.reconstruction_digest))
        self._answered(now)

    def rejected(self, job: DecodeJob, error: PacketRejected, now: float) -> None:
        """The frame of ``job`` did not become a picture."""
        lane = self._lanes[job.frame.camera_id]
        lane.fail()
        self._nack(job.frame.address, error.reason, error.problem)
        self._answered(now)

    def _answered(self, now: float) -> None:
        self._alive(now)
        self._finish_draining()

    # --- answers and time

    @property
    def has_news(self) -> bool:
        """Whether there is something to send, or the stream is over."""
        return bool(self._outbox) or self.closed is not None

    def messages_to_send(self, now: float) -> list[ServerMessage]:  # noqa: ARG002
        """Return, once, what the vehicle is to be told; credits that grew come last."""
        messages = list(self._outbox)
        self._outbox.clear()
        answered = {m.address.camera_id for m in messages if isinstance(m, (Ack, Nack))}
        for camera_id, lane in self._lanes.items():
            if camera_id in answered or "" in answered:
                messages.append(Credit(camera_id, lane.granted))
        return messages

    def drain(self) -> None:
        """Take no more frames, finish those taken, then close."""
        if self.state is SessionState.OPEN:
            self.state = SessionState.DRAINING
            self._finish_draining()
        elif self.state is not SessionState.CLOSED:
            self._close(None)

    def fields_changed(self, current_field_ids: Sequence[str]) -> None:
        """Tell a vehicle that streams which fields are current now; its own goes on being good."""
        if self.state is SessionState.OPEN:
            self._outbox.append(FieldNotice(tuple(current_field_ids)))

    def disconnected(self) -> None:
        """The vehicle ended the stream, or vanished."""
        self._close(None)

    def get_timer(self) -> float | None:
        """Return when ``handle_timer`` has something to do, or None."""
        timed = (SessionState.AWAITING_HELLO, SessionState.OPEN)
        return self._deadline_s if self.state in timed else None

    def handle_timer(self, now: float) -> None:
        """Let a vehicle go that says nothing, unless its frames are in work; it may come back."""
        timer = self.get_timer()
        if timer is None or now < timer:
            return
        if any(lane.outstanding for lane in self._lanes.values()):
            self._alive(now)
        elif self.state is SessionState.AWAITING_HELLO:
            self._close(ProtocolError(f"no Hello within {self._limits.hello_s:g} s"))
        else:
            self._close(None)

    def _alive(self, now: float) -> None:
        if self.state is SessionState.OPEN:
            self._deadline_s = now + self._limits.idle_s

    def _finish_draining(self) -> None:
        if self.state is not SessionState.DRAINING:
            return
        if not any(lane.outstanding for lane in self._lanes.values()):
            self._close(None)

    def _close(self, error: RfedgeError | None) -> None:
        if self.closed is None:
            self.state = SessionState.CLOSED
            self.closed = End(error)

    def _nack(
        self, address: FrameAddress, reason: RejectReason, problem: str, count: int = 1
    ) -> None:
        lane = self._lanes.get(address.camera_id)
        epoch = (lane.epoch if lane else None) or 0
        last_good = lane.last_good if lane and lane.epoch == address.epoch else None
        self._outbox.append(Nack(address, reason, problem, count, last_good, epoch))


def _ns(seconds: float) -> int:
    return max(0, round(seconds * 1e9))


def _unknown_field(asked: str, held: Sequence[str]) -> UnknownField:
    here = ", ".join(held) or "no field"
    return UnknownField(f"the vehicle asked for field {asked}; this server holds {here}")
