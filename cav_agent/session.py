"""The vehicle's side of one stream: a state machine without socket, clock or encoder.

``cav_agent.client`` moves bytes and time in and out of it. ``offer`` takes a captured picture, or
those of one instant of a rig, of which the newest wait; ``job_to_start`` returns one to encode when
the server's credit allows; ``located`` brings its pose, then ``encoded`` the packet;
``messages_to_send`` returns what goes to the server, ``receive`` takes what came from it;
``get_timer`` returns when ``handle_timer`` is to be called; ``take_results`` returns how pictures
ended.

Each camera has its own epochs and credits, so what is wrong with one leaves the others alone.
Pictures are dropped only before they are encoded. A frame is predicted from the one sent before it,
as if that had arrived. After a Nack a new epoch begins, and its first frame goes back to the last
one that the server is known to have decoded; after a lost connection, or when the server does not
have that one either, it needs nothing that went before. Between renderers that are not exact no
frame is ever predicted from another.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

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
from cav_agent.pending_frames import (
    AheadSwitch,
    FramesInFlight,
    PredictionChain,
    SendingCamera,
    WaitingInstants,
)
from cav_agent.rate_control import BitDivision, ByteBudget, RateControl
from rfcore.errors import InvalidInput, ProtocolError, RejectReason, RfedgeError
from rfcore.wire.convert import hello_to_bytes
from rfcore.wire.head import FrameWriter
from rfcore.wire.messages import (
    MAX_EPOCH_STEP,
    Ack,
    ClientMessage,
    Credit,
    DrainNotice,
    FieldNotice,
    Frame,
    FrameAddress,
    Hello,
    Nack,
    PoseAhead,
    ServerMessage,
    Welcome,
)
from rfcore.wire.notices import StreetNotice
from rfcore.wire.values import MAX_PAYLOAD_BYTES

MAX_PROBLEM = 500
"""Letters of a server's problem that are kept; the rest could fill a disk with logs."""


class LinkState(StrEnum):
    """The state of the conversation with the server."""

    DISCONNECTED = "disconnected"
    GREETING = "greeting"
    STREAMING = "streaming"


@dataclass(frozen=True)
class OutgoingMessage:
    """A message and its bytes on the wire, serialised once."""

    message: ClientMessage
    data: bytes


class AgentSession:
    """The stream of the cameras of ``hello`` to one server.

    ``rate_control`` says how many bytes each instant may take, and ``bit_division`` how its
    cameras share them; without the former all have the configured CRF. ``pose_ahead``: poses may be
    sent ahead of their frames, as long as that pays (``AheadSwitch``). ``failed`` is set when the
    server refused the vehicle's Hello, ``broken`` when it did not answer in time; either ends the
    stream. ``is_draining``: the server is about to stop, and goes on taking frames for a while.
    """

    def __init__(
        self,
        hello: Hello,
        limits: AgentLimits | None = None,
        rate_control: RateControl | None = None,
        bit_division: BitDivision | None = None,
        *,
        first_epoch: int = 0,
        pose_ahead: bool = True,
    ) -> None:
        self.state = LinkState.DISCONNECTED
        self.session_id = ""
        self.exact: bool | None = None
        self.is_draining = False
        self.rate_limit_hz = 0.0
        self.failed: RfedgeError | None = None
        self.broken: StreamEnd | None = None
        self._hello = hello
        self._limits = limits or AgentLimits()
        self._rate_control = rate_control
        self._bit_division = bit_division or BitDivision({})
        self._budgets: dict[str, ByteBudget] = {}
        self._cameras = {
            camera.camera_id: SendingCamera(PredictionChain(first_epoch))
            for camera in hello.cameras
        }
        self._in_flight = FramesInFlight(self._limits)
        self._connection = 0
        self._writer = FrameWriter(hello)
        self._waiting = WaitingInstants(
            self._limits.slot_frames, lambda c: self._cameras[c].may_send
        )
        self._job: EncodeJob | None = None
        self._job_is_after: tuple[FrameWriter, FrameAddress | None] = self._writer, None
        """Writer of the job's frame, and the frame that it will be sent after."""
        self._ahead_pays = AheadSwitch(pose_ahead)
        self._ahead_bytes = 0
        """Bytes of the pose that was sent ahead of the job's frame."""
        self._outbox: deque[OutgoingMessage] = deque()
        self._results: deque[FrameResult] = deque()
        self._greeting_until_s = 0.0

    @property
    def vehicle_id(self) -> str:
        """The vehicle's name."""
        return self._hello.vehicle_id

    @property
    def camera_ids(self) -> Sequence[str]:
        """The cameras in the order of Hello."""
        return tuple(self._cameras)

    @property
    def epoch(self) -> int:
        """The highest epoch of the cameras' next packets."""
        return max(camera.chain.epoch for camera in self._cameras.values())

    @property
    def is_idle(self) -> bool:
        """Return whether no picture waits, is being encoded or is unanswered."""
        return not (self._waiting or self._job or self._in_flight)

    @property
    def waits_for(self) -> str:
        """The reason why a picture is not sent or answered; "" for none, or no connection."""
        if self.state is LinkState.GREETING:
            return "the server's welcome"
        if self.state is LinkState.DISCONNECTED or self.is_idle:
            return ""
        if self._job is not None:
            return "the encoder"
        if self._in_flight:
            return "the server's answer to a frame"
        may_send = any(camera.may_send for camera in self._cameras.values())
        return "room on the link" if may_send else "credit of the server"

    # --- connection

    def connected(self, now: float) -> None:
        """Greet the server on a stream that was opened."""
        self.state = LinkState.GREETING
        self.broken = None
        self.is_draining = False
        self._connection += 1
        self._writer = FrameWriter(self._hello)
        for camera in self._cameras.values():
            camera.granted = camera.used = 0
        self._greeting_until_s = now + self._limits.greeting_s
        self._in_flight.stream_opened()
        self._outbox.append(OutgoingMessage(self._hello, hello_to_bytes(self._hello)))

    def connection_lost(self, end: StreamEnd, now: float) -> None:
        """End every frame that was not answered, since its stream is gone."""
        self.state = LinkState.DISCONNECTED
        self._outbox.clear()
        for address in self._in_flight.addresses:
            self._finish(address, Outcome.LOST, end.reason, end.problem, now)
        for camera in self._cameras.values():
            camera.chain.forget()
            camera.chain.restart()

    def abandon(self, end: StreamEnd, now: float) -> None:
        """End every picture that was taken: none of them will be encoded or sent any more."""
        for capture in self._waiting.clear():
            self._results.append(FrameResult(capture, Outcome.LOST, end.reason, end.problem))
        if self._job is not None:
            capture = self._take_job().capture
            self._results.append(FrameResult(capture, Outcome.LOST, end.reason, end.problem))
        self.connection_lost(end, now)

    # --- messages from the server

    def receive(self, message: ServerMessage, now: float) -> None:
        """Take one message of the server; raise ``ProtocolError`` for an impossible one."""
        match message:
            case Welcome(session_id, exact, rate_hz):
                self.state = LinkState.STREAMING
                self.session_id, self.exact = session_id, exact
                self.rate_limit_hz = rate_hz
            case Credit(camera_id, frames) if camera_id in self._cameras:
                camera = self._cameras[camera_id]
                camera.granted = max(camera.granted, frames)
            case Ack():
                self._acked(message, now)
            case Nack():
                self._nacked(message, now)
            case DrainNotice():
                self.is_draining = True
            case FieldNotice() | StreetNotice() | Credit():
                pass  # the refusal that follows a notice names both ids

    def _acked(self, ack: Ack, now: float) -> None:
        frame = self._in_flight.acked(ack, now)
        if frame is None:
            return
        self._ahead_pays.answered(frame.result)
        packet = frame.result.packet
        if packet is not None and packet.reconstruction_digest == ack.reconstruction_digest:
            self._cameras[ack.address.camera_id].chain.decoded(ack.address)
        self._finish(ack.address, Outcome.ACKED, EndReason.NONE, "", now)

    def _nacked(self, nack: Nack, now: float) -> None:
        if self.state is LinkState.GREETING:
            self.failed = ProtocolError(f"the server refused this vehicle's Hello: {nack.problem}")
            return
        if nack.current_epoch > self.epoch + MAX_EPOCH_STEP:
            raise ProtocolError(
                f"the server says epoch {nack.current_epoch}, and this vehicle is in {self.epoch}"
            )
        self._end_refused(replace(nack, problem=nack.problem[:MAX_PROBLEM]), now)
        camera_id = nack.address.camera_id
        if camera_id == "":
            for camera in self._cameras.values():
                camera.chain.restart(nack.current_epoch)
        elif camera_id in self._cameras:
            self._cameras[camera_id].chain.refused(nack)

    def _end_refused(self, nack: Nack, now: float) -> None:
        """End the frames that ``nack`` is about; an overloaded server has not judged them."""
        overloaded = nack.reason is RejectReason.OVERLOADED
        outcome = Outcome.LOST if overloaded else Outcome.NACKED
        for address, frame in self._in_flight.refused_by(nack):
            if frame.result.ahead_bytes:
                self._ahead_pays.failed()
            if nack.reason is RejectReason.UNKNOWN_STATE:
                self._cameras[address.camera_id].chain.unknown_to_server(frame.base)
            self._finish(address, outcome, nack.reason, nack.problem, now)

    # --- pictures

    def offer(self, *captures: Capture) -> None:
        """Take the pictures of an instant; what waits longest is dropped when there is no room."""
        self._drop(self._waiting.offer(captures), EndReason.SUPERSEDED)
        if self._rate_control is not None:
            self._rate_control.captured(captures[0].captured_s)

    def withdraw(self) -> None:
        """Lose what waits for the encoder, to be captured again for another server."""
        for capture in self._waiting.clear():
            self._results.append(FrameResult(capture, Outcome.LOST, EndReason.HANDED_OVER))

    def stop(self) -> None:
        """Drop what waits for the encoder; what is being encoded or unanswered goes on."""
        self._drop(self._waiting.clear(), EndReason.STOPPING)

    def _drop(self, captures: Iterable[Capture], reason: EndReason) -> None:
        self._results.extend(FrameResult(c, Outcome.DROPPED, reason) for c in captures)

    def job_to_start(self, now: float) -> EncodeJob | None:
        """Return the picture to encode now; None without picture, credit, free encoder or room."""
        ready = self.state is LinkState.STREAMING and self._job is None
        self._drop_late(now)
        if not ready or not (self._waiting.is_begun or self._begin_instant(now)):
            return None
        capture = self._waiting.next()
        if capture is None:
            return None
        exact, chain = bool(self.exact), self._cameras[capture.camera_id].chain
        budget = self._budgets.get(capture.camera_id)
        self._job = EncodeJob(
            capture,
            chain.epoch,
            self._connection,
            chain.base if exact else None,
            exact=exact,
            budget=budget,
            started_s=now,
        )
        self._job_is_after = self._writer, chain.base
        chain.started()
        return self._job

    def _begin_instant(self, now: float) -> bool:
        """Begin the instant that waits and divide its bytes; return whether that could be done."""
        captures = self._waiting.startable()
        if not captures:
            return False
        control = self._rate_control
        if control is not None:
            first_s = min(capture.captured_s for capture in captures)
            budget = control.budget(first_s, now, len(captures))
            if budget is None:
                return False
            camera_ids = [capture.camera_id for capture in captures]
            shares = self._bit_division.divide(budget.target_bytes, camera_ids)
            self._budgets = {c: budget.with_target(size) for c, size in shares.items()}
            control.begun(captures[0].instant, len(captures))
        self._drop(self._waiting.begin(), EndReason.SUPERSEDED)
        return True

    def _drop_late(self, now: float) -> None:
        control = self._rate_control
        while control is not None and (waiting_s := self._waiting.waiting_since_s) is not None:
            if not control.is_late(waiting_s, now):
                return
            self._drop(self._waiting.drop_oldest(), EndReason.TOO_LATE)

    def located(self, job: EncodeJob, ahead: PoseAhead) -> None:
        """Send the pose of the running job's picture ahead of its frame, if that pays."""
        if job is not self._job or self._obstacle(job) is not None or not self._ahead_pays.next():
            return
        writer, after = self._job_is_after
        outgoing = OutgoingMessage(ahead, writer.ahead(ahead, after))
        self._ahead_bytes = len(outgoing.data)
        self._outbox.append(outgoing)

    def encoded(self, encoded: EncodedFrame, now: float) -> None:
        """Send the frame of the running job, if its stream still is the same."""
        ahead_bytes = self._ahead_bytes
        job = self._take_job()
        frame = self._frame(job.capture, encoded)
        writer, after = self._job_is_after
        data = writer.message(frame, after)
        payload_bytes, packet_bytes = len(encoded.packet.payload), ahead_bytes + len(data)
        outgoing = OutgoingMessage(frame, data)
        if self._rate_control is not None:
            self._rate_control.coded(encoded.sender_s, payload_bytes, packet_bytes)
        if encoded.crf is not None:
            self._bit_division.coded(job.capture.camera_id, payload_bytes, encoded.crf)
        result = FrameResult(
            job.capture,
            Outcome.LOST,
            encoded=encoded,
            packet_bytes=packet_bytes,
            ahead_bytes=ahead_bytes,
            budget=job.budget,
            session_id=self.session_id,
        )
        self._in_flight.add(frame.address, result, job.base, now)
        if payload_bytes > MAX_PAYLOAD_BYTES:
            self._drop_oversize(frame, now)
        elif (obstacle := self._obstacle(job)) is not None:
            self._not_sent(frame.instant)
            self._finish(frame.address, Outcome.LOST, *obstacle, now)
        else:
            camera = self._cameras[frame.camera_id]
            camera.used += 1
            camera.chain.sent(frame.address)
            self._outbox.append(outgoing)

    def _drop_oversize(self, frame: Frame, now: float) -> None:
        size_bytes = len(frame.packet.payload)
        problem = (
            f"{size_bytes} bytes of payload exceed {MAX_PAYLOAD_BYTES} even at the highest CRF"
        )
        self._not_sent(frame.instant)
        self._finish(frame.address, Outcome.DROPPED, EndReason.OVERSIZE, problem, now)
        self._cameras[frame.camera_id].chain.restart()

    def _obstacle(self, job: EncodeJob) -> tuple[EndReason, str] | None:
        """Return why the frame of ``job`` is not worth sending, or None."""
        if job.connection != self._connection or self.state is not LinkState.STREAMING:
            return EndReason.NOT_SENT, "the stream ended before it was sent"
        if job.epoch != self._cameras[job.capture.camera_id].chain.epoch and job.base is not None:
            return EndReason.BASE_LOST, "the frame it needs was not decoded"
        return None

    def encoding_failed(self, error: RfedgeError) -> None:
        """Drop the picture of the running job, which could not be read or coded."""
        capture = self._take_job().capture
        result = FrameResult(capture, Outcome.DROPPED, EndReason.NOT_CODED, str(error))
        self._results.append(result)
        self._not_sent(capture.instant)
        self._cameras[capture.camera_id].chain.restart()

    def _not_sent(self, instant: int) -> None:
        if self._rate_control is not None:
            self._rate_control.not_sent(instant)

    def _take_job(self) -> EncodeJob:
        if self._job is None:
            raise InvalidInput("encoded", "no picture is being encoded")
        job, self._job = self._job, None
        self._ahead_bytes = 0
        return job

    def _frame(self, capture: Capture, encoded: EncodedFrame) -> Frame:
        return Frame(
            capture.camera_id,
            capture.capture_time_ns,
            encoded.pose,
            encoded.field_id,
            encoded.packet,
            encoded.rung.quality,
            capture.clock,
            encoded.pose_state,
            capture.instant,
        )

    def _finish(
        self,
        address: FrameAddress,
        outcome: Outcome,
        reason: EndReason | RejectReason,
        problem: str,
        now: float,
    ) -> None:
        result = self._in_flight.pop(address).result
        read_s = 0.0 if result.encoded is None else result.encoded.read_s
        latency_s = now - result.capture.captured_s - read_s
        ended = replace(
            result, outcome=outcome, reason=reason, problem=problem, latency_s=latency_s
        )
        self._results.append(ended)
        if self._rate_control is None:
            return
        if outcome in (Outcome.ACKED, Outcome.NACKED):
            server_s = None if result.server is None else result.server.total_ns / 1e9
            self._rate_control.answered(address, latency_s, now, server_s)
        else:
            self._rate_control.lost(address)

    # --- messages to the server, and time

    def messages_to_send(self, now: float) -> list[OutgoingMessage]:
        """Return, once, what is to be written to the stream; it counts as sent ``now``."""
        outgoing = list(self._outbox)
        self._outbox.clear()
        for entry in outgoing:
            if isinstance(entry.message, Frame):
                self._sent(entry.message.address, now)
        return outgoing

    def _sent(self, address: FrameAddress, now: float) -> None:
        if address not in self._in_flight:
            return  # a Nack that names no frame ended it; it is sent since it has used its credit
        result = self._in_flight.sent(address, now)
        if self._rate_control is not None:
            instant = result.capture.instant
            self._rate_control.sent(address, result.packet_bytes, now, instant)

    def take_results(self) -> list[FrameResult]:
        """Return, once, the pictures that came to an end."""
        results = list(self._results)
        self._results.clear()
        return results

    def get_timer(self) -> float | None:
        """Return when ``handle_timer`` has something to do, or None."""
        if self.state is LinkState.GREETING:
            return self._greeting_until_s
        if self.state is LinkState.STREAMING:
            return self._in_flight.timeout_at()
        return None

    def handle_timer(self, now: float) -> None:
        """Give the stream up (``broken`` says why) when an answer is overdue."""
        timer = self.get_timer()
        if timer is None or now < timer or self.broken is not None:
            return
        if self.state is LinkState.GREETING:
            problem = f"no Welcome within {self._limits.greeting_s:g} s"
            self.broken = StreamEnd(EndReason.NO_WELCOME, problem)
        else:
            waited_s = self._in_flight.longest_wait_s(now)
            problem = f"no answer to a frame within {waited_s:.2g} s"
            self.broken = StreamEnd(EndReason.NO_ANSWER, problem)
