"""The server's side of one stream, without socket, clock or decoder.

``receive`` takes a message of the vehicle, ``jobs_to_start`` hands out decoding work, ``opened`` /
``decoded`` / ``rejected`` take its outcome, ``messages_to_send`` has the answers, and ``get_timer``
says when ``handle_timer`` is to be called. ``closed`` is set when the stream is over: to an error,
or to a clean end.

States: awaiting hello -> opening -> open -> draining -> closed. A Hello or Frame with a bad value
is answered with a Nack and the session lives on; a broken rule of the protocol ends it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from types import MappingProxyType

from mec_server.camera_queue import SessionCameras
from mec_server.config import SessionLimits
from mec_server.ledger.budgets import Limit
from rfcore.codec.packet import RECONSTRUCTION_DIGEST_BYTES, CheckedPacket
from rfcore.errors import (
    AccessDenied,
    InvalidInput,
    LimitExceeded,
    PacketRejected,
    ProtocolError,
    RejectReason,
    RfedgeError,
    UnknownField,
    named,
)
from rfcore.wire.head import FrameRefused
from rfcore.wire.messages import (
    OUR_CONTRACT,
    Ack,
    ClientMessage,
    DrainNotice,
    FieldNotice,
    Frame,
    FrameAddress,
    Hello,
    Nack,
    PoseAhead,
    RendererContract,
    ServerMessage,
    StageTimes,
    Welcome,
)
from rfcore.wire.notices import StreetNotice
from rfcore.wire.tls import PeerIdentity
from rfcore.wire.values import MAX_FIELDS

MAX_UNUSABLE = 64
"""Messages in a row that are refused before any work is spent on them; then the stream ends."""

MAX_UNREAD = 256
"""Answers that wait for a peer to read them; a correct one has a few frames in flight. Then the
stream ends: a peer that sends and does not read must cost no memory."""


@dataclass(frozen=True)
class OpenJob:
    """Open fields and decoders for ``hello``; ``exact``: both renderers give the same bits."""

    hello: Hello
    exact: bool


@dataclass(frozen=True)
class DecodeJob:
    """Reconstruct one frame of one camera; ``packet`` is the frame's, once it was checked."""

    frame: Frame
    packet: CheckedPacket
    field_id: str
    received_s: float
    started_s: float


@dataclass(frozen=True)
class PrepareJob:
    """Make what the next frame of a camera will be predicted from."""

    ahead: PoseAhead
    field_id: str


@dataclass(frozen=True)
class StreamEnd:
    """The stream is over; ``error`` is None when it ended as it should."""

    error: RfedgeError | None = None


class RenderTooLate(PacketRejected):
    """A frame that was not rendered, since it would have been decoded after its deadline."""

    def __init__(self, waited_s: float, expected_s: float, deadline_s: float) -> None:
        super().__init__(
            RejectReason.OVERLOADED,
            f"it waited {waited_s:.3g} s and would take {expected_s:.3g} s to render and decode; "
            f"the deadline is {deadline_s:g} s after its arrival",
        )


class SessionState(StrEnum):
    """State of the conversation."""

    AWAITING_HELLO = "awaiting_hello"
    OPENING = "opening"
    OPEN = "open"
    DRAINING = "draining"
    CLOSED = "closed"


class ServerSession:
    """One vehicle's stream; ``held_field_ids`` are the fields that this server has.

    ``contracts``: how the fields of users' classes are rendered, by id.

    ``identity``: named by the vehicle's certificate; without one any vehicle name is accepted.
    """

    def __init__(
        self,
        session_id: str,
        held_field_ids: Sequence[str],
        now: float,
        limits: SessionLimits | None = None,
        identity: PeerIdentity | None = None,
        contracts: Mapping[str, RendererContract] = MappingProxyType({}),
    ) -> None:
        self.session_id = session_id
        self.hello: Hello | None = None
        self.state = SessionState.AWAITING_HELLO
        self.closed: StreamEnd | None = None
        self._limits = limits or SessionLimits()
        self._held = tuple(held_field_ids)
        self._identity = identity
        self._contracts = contracts
        self._cameras = SessionCameras(self._limits.window_frames)
        self._opening: OpenJob | None = None
        self._outbox: deque[ServerMessage] = deque()
        self._deadline_s = now + self._limits.hello_s
        self._heard_s = now
        self._unusable = 0
        self._exact = False
        self._rate_hz = 0.0
        self._is_to_drain = False

    # --- messages of the vehicle

    def receive(self, message: ClientMessage, now: float) -> None:
        """Take one checked message."""
        self._heard_s = now
        if isinstance(message, Hello):
            self._receive_hello(message)
        elif isinstance(message, Frame):
            self._receive_frame(message, now)
        else:
            self._receive_ahead(message, now)

    def refuse(self, error: InvalidInput | FrameRefused, now: float) -> None:
        """Answer for a message that failed its checks; the session lives on."""
        if isinstance(error, FrameRefused):
            self._refuse(error.address, error.reason, error.problem, now)
        else:
            address = FrameAddress("", 0, 0)
            self._refuse(address, RejectReason.INVALID_ARGUMENT, str(error), now)

    def overrun(self, frame: Frame, error: LimitExceeded, now: float) -> None:
        """Answer for a frame beyond a budget; the session lives on."""
        self._refuse(frame.address, RejectReason.OVERLOADED, str(error), now)

    def silent_s(self, now: float) -> float:
        """Return for how long the vehicle has sent nothing; 0 while it waits for an answer."""
        return 0.0 if self._cameras.are_busy else max(0.0, now - self._heard_s)

    def _refuse(
        self, address: FrameAddress, reason: RejectReason, problem: str, now: float
    ) -> None:
        self._heard_s = now
        self._cameras.refuse(address)
        self._nack(address, reason, problem)
        self._restart_deadline(now)
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
            self._say(FieldNotice(self._held[:MAX_FIELDS]))
            self._close(_unknown_field(unknown[0], self._held))
            return
        here = {self._contracts.get(field_id, OUR_CONTRACT) for field_id in hello.field_ids}
        exact = hello.renderer.exact and here == {hello.renderer}
        self.state = SessionState.OPENING
        self._opening = OpenJob(hello, exact)

    def _receive_frame(self, frame: Frame, now: float) -> None:
        if self.state is SessionState.AWAITING_HELLO:
            self._close(ProtocolError("a frame came before Hello"))
            return
        self._restart_deadline(now)
        try:
            queue = self._cameras.queue_of(frame)
            if self.state is SessionState.DRAINING:
                raise PacketRejected(RejectReason.OVERLOADED, "this server is shutting down")
            queue.admit(self._cameras.posed(frame), now)
        except InvalidInput as error:
            self._refuse(frame.address, RejectReason.INVALID_ARGUMENT, str(error), now)
        except PacketRejected as error:
            self._refuse(frame.address, error.reason, error.problem, now)

    def _receive_ahead(self, ahead: PoseAhead, now: float) -> None:
        """Take a pose ahead of its frame; before Welcome, and while draining, it is of no use."""
        self._restart_deadline(now)
        if self.state is SessionState.OPEN:
            self._cameras.queue_of(ahead).expect(self._cameras.posed(ahead))

    def refuse_ahead(self) -> None:
        """Note that a pose ahead failed its checks: it has no answer, its frame will be refused."""
        self._unusable_frame()

    # --- numerical work

    def jobs_to_start(self, now: float) -> list[OpenJob | DecodeJob]:
        """Return the work that can begin now: one frame a camera, in order.

        Frames that are stale are answered here: they cost no rendering.
        """
        jobs: list[OpenJob | DecodeJob] = []
        if self._opening is not None and self.state is SessionState.OPENING:
            jobs.append(self._opening)
            self._opening = None
        for queue, waiting in self._cameras.started():
            frame = waiting.frame
            try:
                packet = CheckedPacket(frame.packet, queue.check(frame))
            except PacketRejected as error:
                queue.fail()
                self._nack(frame.address, error.reason, error.problem)
                self._unusable_frame()
            else:
                field_id = self._cameras.field_of(frame)
                jobs.append(DecodeJob(frame, packet, field_id, waiting.received_s, now))
        self._finish_draining()
        return jobs

    def poses_to_prepare(self) -> list[PrepareJob]:
        """Return the work that can be done before the frames of these poses come.

        Only a server with a worker to spare asks for it. A camera's next frame waits for it, until
        ``prepared``.
        """
        return [
            PrepareJob(ahead, self._cameras.field_of(ahead)) for ahead in self._cameras.to_prepare()
        ]

    def prepared(self, job: PrepareJob) -> None:
        """Note that a pose was prepared, or could not be: its frame will tell."""
        self._cameras.queue_of(job.ahead).prepared()

    def opened(self, job: OpenJob, now: float) -> None:
        """Fields and decoders of ``job`` are ready."""
        if self.state is not SessionState.OPENING:
            return
        self.state = SessionState.OPEN
        self.hello = job.hello
        self._cameras.open(job.hello)
        self._exact = job.exact
        self._say(self._welcome())
        for credit in self._cameras.credits():
            self._say(credit)
        if self._is_to_drain:
            self._say(DrainNotice())
        self._restart_deadline(now)

    def grant(self, rate_hz: float) -> None:
        """Limit each camera to this many pictures per second; 0: as many as credits allow."""
        self._rate_hz = rate_hz
        if self.state is SessionState.OPEN:
            self._say(self._welcome())

    def _welcome(self) -> Welcome:
        return Welcome(self.session_id, self._exact, self._rate_hz)

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

    def decoded(self, job: DecodeJob, digest: bytes, times: StageTimes, now: float) -> None:
        """Note that the frame of ``job`` was reconstructed, to a picture of ``digest``; the vehicle
        is told as much of that as its frame had."""
        self._unusable = 0
        address = job.frame.address
        for gap in self._cameras.queue_of(job.frame).succeed():
            first = replace(address, sequence=gap.first)
            self._nack(first, RejectReason.SEQUENCE_GAP, "never arrived", gap.count)
        times = replace(
            times,
            queue_ns=_ns(job.started_s - job.received_s),
            total_ns=_ns(now - job.received_s),
        )
        self._say(Ack(address, times, digest[:RECONSTRUCTION_DIGEST_BYTES]))
        self._answered(now)

    def rejected(self, job: DecodeJob, error: PacketRejected, now: float) -> None:
        """The frame of ``job`` did not become a picture."""
        self._cameras.queue_of(job.frame).fail()
        self._nack(job.frame.address, error.reason, error.problem)
        self._answered(now)

    def _answered(self, now: float) -> None:
        self._restart_deadline(now)
        self._finish_draining()

    # --- answers, time and the end

    def end(self, error: RfedgeError) -> None:
        """End the stream for a reason that lies outside of the protocol."""
        self._close(error)

    @property
    def has_news(self) -> bool:
        """Whether there is something to send, or the stream is over."""
        return bool(self._outbox) or self.closed is not None

    def messages_to_send(self, now: float) -> list[ServerMessage]:  # noqa: ARG002
        """Return the messages for the vehicle, once; credits that grew come last."""
        messages = list(self._outbox)
        self._outbox.clear()
        answered = {m.address.camera_id for m in messages if isinstance(m, (Ack, Nack))}
        return [*messages, *self._cameras.credits(answered)]

    def announce_drain(self) -> None:
        """Tell the vehicle to go elsewhere, now or after its Welcome; frames are still taken."""
        if not self._is_to_drain and self.state is SessionState.OPEN:
            self._say(DrainNotice())
        self._is_to_drain = True

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
            self._say(FieldNotice(tuple(current_field_ids)))

    @property
    def takes_notices(self) -> bool:
        """Whether the vehicle was welcomed and wants notices."""
        asked = self.hello is not None and self.hello.take_notices
        return asked and self.state is SessionState.OPEN

    def tell(self, notice: StreetNotice) -> None:
        """Send a notice to a vehicle that takes them; one that does not read misses it."""
        if self.takes_notices and len(self._outbox) < MAX_UNREAD // 2:
            self._say(notice)

    def get_timer(self) -> float | None:
        """Return when ``handle_timer`` has something to do, or None."""
        timed = (SessionState.AWAITING_HELLO, SessionState.OPEN)
        return self._deadline_s if self.state in timed else None

    def handle_timer(self, now: float) -> None:
        """End the stream of a silent vehicle, unless its frames are being decoded; it may come
        back."""
        timer = self.get_timer()
        if timer is None or now < timer:
            return
        if self._cameras.are_busy:
            self._restart_deadline(now)
        elif self.state is SessionState.AWAITING_HELLO:
            self._close(ProtocolError(f"no Hello within {self._limits.hello_s:g} s"))
        else:
            self._close(None)

    def _restart_deadline(self, now: float) -> None:
        if self.state is SessionState.OPEN:
            self._deadline_s = now + self._limits.idle_s

    def _finish_draining(self) -> None:
        if self.state is not SessionState.DRAINING:
            return
        if not self._cameras.are_busy:
            self._close(None)

    def _close(self, error: RfedgeError | None) -> None:
        if self.closed is None:
            self.state = SessionState.CLOSED
            self.closed = StreamEnd(error)

    def _say(self, message: ServerMessage) -> None:
        if len(self._outbox) < MAX_UNREAD:
            self._outbox.append(message)
            return
        self._outbox.clear()
        self._close(
            LimitExceeded(
                Limit.UNREAD_ANSWERS, f"{MAX_UNREAD} answers wait to be read, as many as may be"
            )
        )

    def _nack(
        self, address: FrameAddress, reason: RejectReason, problem: str, count: int = 1
    ) -> None:
        epoch, last_good = self._cameras.position(address)
        self._say(Nack(address, reason, problem, count, last_good, epoch))


def _ns(seconds: float) -> int:
    return max(0, round(seconds * 1e9))


def _unknown_field(asked: str, held: Sequence[str]) -> UnknownField:
    here = named(held, "no field")
    return UnknownField(f"the vehicle asked for field {asked}; this server holds {here}")
