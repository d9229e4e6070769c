"""One vehicle's stream: moves messages between gRPC and the session, and frames to the workers.

A reader takes messages in and starts the work they allow; outcomes come back from the workers as
calls on the event loop; a writer sends the answers. A frame wakes the reader once and the writer
once, and makes no task: at thousands of frames per second each further wake-up costs a tenth of a
core.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import dataclass

import grpc
import structlog

from mec_server.config import SessionLimits
from mec_server.connections import Connections
from mec_server.decoding.process import DecoderLost
from mec_server.event_loop import LazyTimer
from mec_server.learner import UnrecordedTrials
from mec_server.ledger.budgets import Limit
from mec_server.ledger.entry import EntryControl, StreamAccount
from mec_server.ledger.peer_log import LogLimiter, PeerLog
from mec_server.metrics import ServerMetrics
from mec_server.reconstruction import DecodingParts, Reconstruction, StreamDecoders
from mec_server.session import (
    DecodeJob,
    OpenJob,
    PrepareJob,
    RenderTooLate,
    ServerSession,
    SessionState,
    StreamEnd,
)
from mec_server.twin.state import ReceivedPicture, Twin
from rfcore.camera import Intrinsics
from rfcore.errors import InvalidInput, LimitExceeded, PacketRejected, ProtocolError, RfedgeError
from rfcore.wire.conventions import AGENT_PROCESS
from rfcore.wire.convert import client_message_from_bytes
from rfcore.wire.convert_answers import AnswerWriter
from rfcore.wire.head import FrameReader, FrameRefused
from rfcore.wire.messages import (
    Frame,
    FrameAddress,
    Hello,
    PackedFrame,
    PoseAhead,
    RendererContract,
)
from rfcore.wire.notices import StreetNotice
from rfcore.wire.tls import peer_identity

log = structlog.get_logger()
Context = grpc.aio.ServicerContext[bytes, bytes]

UNKNOWN_VEHICLE = ""
"""The vehicle id under which a stream is counted until its Hello is accepted."""


@dataclass(frozen=True)
class ServerContext:
    """The parts of one server that its streams share."""

    decoding: DecodingParts
    held_field_ids: Callable[[], tuple[str, ...]]
    contracts: Mapping[str, RendererContract]
    metrics: ServerMetrics
    limits: SessionLimits
    entry: EntryControl
    log_limiter: LogLimiter
    connections: Connections
    twin: Twin
    trials: UnrecordedTrials | None = None


class Stream:
    """Serves one session; a ``mec_server.ledger.entry.CameraSender``.

    ``account`` is charged; who made it closes it. ``regrant`` is called with the sessions whose
    rate changes, after a frame has changed what frames cost.
    """

    def __init__(
        self,
        server: ServerContext,
        context: Context,
        session_id: str,
        account: StreamAccount,
        regrant: Callable[[Mapping[str, float]], None],
    ) -> None:
        self.agent = _agent_process(context)
        self._server = server
        self._regrant = regrant
        self._context = context
        self._wake = asyncio.Event()
        self._timer = LazyTimer(self._wake)
        self._tasks = asyncio.TaskGroup()
        self._opening: asyncio.Task[None] | None = None
        self._identity = peer_identity(context.auth_context())
        self._account = account
        self._opened_time_ns = 0
        self._over_budget = False
        self.is_stalled = False
        self._writing_since_s: float | None = None
        self._is_closed = False
        self._decoders = StreamDecoders(server.decoding, session_id)
        self._intrinsics: dict[str, Intrinsics] = {}
        self._reader: FrameReader | None = None
        self._writer = AnswerWriter()
        self._fault: Exception | None = None
        self._metrics = server.metrics.of(UNKNOWN_VEHICLE)
        self._peer = context.peer()
        lines = log.bind(session=session_id, peer=self._peer)
        self._log = PeerLog(lines, server.log_limiter, account.identity, time.monotonic)
        self._session = ServerSession(
            session_id,
            server.held_field_ids(),
            time.monotonic(),
            server.limits,
            self._identity,
            server.contracts,
        )

    def announce_drain(self) -> None:
        """Ask the vehicle to go elsewhere; its frames are still taken."""
        self._session.announce_drain()
        self._wake.set()

    def drain(self) -> None:
        """Take no more frames and end when those taken are answered."""
        self._session.drain()
        self._wake.set()

    def fields_changed(self, current_field_ids: tuple[str, ...]) -> None:
        """Pass on which fields are current now."""
        self._session.fields_changed(current_field_ids)
        self._wake.set()

    @property
    def session_id(self) -> str:
        """The id of the stream."""
        return self._session.session_id

    @property
    def hello(self) -> Hello:
        """The vehicle's Hello, once it was accepted."""
        assert self._session.hello is not None
        return self._session.hello

    @property
    def takes_notices(self) -> bool:
        """Whether the vehicle wants notices."""
        return self._session.takes_notices

    def tell(self, notice: StreetNotice) -> None:
        """Send a notice to the vehicle."""
        self._session.tell(notice)
        self._wake.set()

    def grant(self, rate_hz: float) -> None:
        """Tell the vehicle its new rate."""
        self._log.info("rate granted", rate_hz=rate_hz)
        self._account.grant(rate_hz, time.monotonic())
        self._session.grant(rate_hz)
        self._wake.set()

    def silent_s(self, now: float) -> float:
        """Return how long the vehicle has sent nothing; 0 while it waits for an answer."""
        return self._session.silent_s(now)

    def displace(self, error: LimitExceeded) -> None:
        """End the stream: another agent sends its cameras from now on."""
        self._log.warning("stream displaced", reason=error.limit, problem=str(error))
        self._session.end(error)
        self._wake.set()

    def close(self) -> None:
        """Remove the stream from twin, metrics and ledger, and close its decoders."""
        if self._is_closed:
            return
        self._is_closed = True
        self._timer.cancel()
        self._decoders.close()
        self._server.twin.leave(self._session.session_id)
        if self._server.trials is not None and self._session.hello is not None:
            self._server.trials.left(self.hello.vehicle_id)
        self._metrics.forget()
        self._account.ended(time.monotonic())
        self._account.leave()

    async def run(self, requests: AsyncIterator[bytes]) -> StreamEnd:
        """Serve until the session is closed; return how it ended."""
        self._log.info("stream opened")
        try:
            await self._serve(requests)
        except asyncio.CancelledError:
            self._log.warning("stream closed", error="the vehicle is gone")
            raise
        end = self._session.closed
        assert end is not None
        if isinstance(end.error, LimitExceeded) and end.error.limit == Limit.UNUSABLE_FRAMES:
            self._account.opening_failed(time.monotonic())
        self._log.info("stream closed", error=str(end.error) if end.error else None)
        return end

    async def _serve(self, requests: AsyncIterator[bytes]) -> None:
        async with self._tasks:
            reader = self._tasks.create_task(self._read(requests))
            while self._session.closed is None:
                await self._write()
                await self._rest()
            await self._write()
            reader.cancel()
            if self._opening is not None:
                self._opening.cancel()

    def _advance(self) -> None:
        """Start the work that can be started, and wake the writer if there is something to send."""
        now = time.monotonic()
        for job in self._session.jobs_to_start(now):
            if isinstance(job, DecodeJob):
                expected_s = self._account.expected_s(job.frame.camera_id)
                doubtful = self._account.is_doubtful(now)
                self._decoders.submit(job, expected_s, self._finished, in_background=doubtful)
                self._expect(job)
            else:
                self._opening = self._tasks.create_task(self._open(job))
        if self._decoders.has_room and not self._account.is_doubtful(now):
            for ahead in self._session.poses_to_prepare():
                self._decoders.prepare(ahead, self._prepared)
        if self._session.has_news:
            self._wake.set()

    async def _write(self) -> None:
        messages = self._session.messages_to_send(time.monotonic())
        if not messages or self.is_stalled:
            return
        self._metrics.answered(messages)
        for data in self._writer.messages(messages):
            self._writing_since_s = time.monotonic()
            await self._context.write(data)
        self._writing_since_s = None

    def end_if_stalled(self, now: float) -> LimitExceeded | None:
        """End the stream and give back what it holds if its peer took no answer for long.

        gRPC sends no status before what is being written, so the call itself lasts until the peer
        reads again or is gone, and is charged for as long. Returns why it ended, once.
        """
        since_s, stalled_s = self._writing_since_s, self._server.limits.stalled_s
        if self.is_stalled or since_s is None or now < since_s + stalled_s:
            return None
        self.is_stalled = True
        error = LimitExceeded(Limit.UNREAD_ANSWERS, f"no answer was taken for {stalled_s:g} s")
        self._log.warning("stream stalled", reason=error.limit, problem=str(error))
        self._session.end(error)
        self.close()
        return error

    async def _rest(self) -> None:
        """Wait until there is something to send or the session's timer runs out."""
        if self._session.closed is not None:
            return
        self._timer.restart(self._session.get_timer())
        await self._wake.wait()
        self._wake.clear()
        if self._fault is not None:
            raise self._fault
        self._session.handle_timer(time.monotonic())

    # --- messages of the vehicle

    async def _read(self, requests: AsyncIterator[bytes]) -> None:
        async for data in requests:
            self._receive(data, time.monotonic())
            self._advance()
            if self._session.closed is not None:
                return
        self.drain()

    def _receive(self, data: bytes, now: float) -> None:
        """Take one message; whatever it is, it is charged."""
        self._server.connections.explain(self._peer, len(data))
        excess = self._excess(lambda: self._account.spend_message(len(data), now))
        try:
            message = client_message_from_bytes(data)
            frame = None if isinstance(message, Hello) else self._frame(message, now)
        except InvalidInput as error:
            self._log.warning("message refused", problem=str(error))
            self._session.refuse(error, now)
        except ProtocolError as error:
            self._session.end(error)
        else:
            if isinstance(message, Hello):
                self._receive_hello(message, excess, now)
            elif isinstance(frame, Frame):
                self._receive_frame(frame, len(data), excess, now)
            elif frame is not None:
                self._receive_ahead(frame, len(data), excess, now)

    def _frame(self, packed: PackedFrame, now: float) -> Frame | PoseAhead | None:
        """Return what was packed; None if it is refused. A pose ahead is never answered."""
        if self._reader is None:
            raise ProtocolError("a frame came before Hello")
        try:
            return self._reader.read(packed)
        except FrameRefused as error:
            self._log_rejected(error.address, error, "pose ahead" if packed.is_ahead else "frame")
            if packed.is_ahead:
                self._server.metrics.poses_ahead.labels("refused").inc()
                self._session.refuse_ahead()
            else:
                self._session.refuse(error, now)
            return None

    def _excess(self, spend: Callable[[], None]) -> LimitExceeded | None:
        """Return the limit that ``spend`` exceeds, if it does: counted, and logged once."""
        try:
            spend()
        except LimitExceeded as error:
            self._server.metrics.count_limited(error.limit)
            if not self._over_budget:
                self._log.warning("frames refused", reason=error.limit, problem=str(error))
            self._over_budget = True
            return error
        return None

    def _receive_hello(self, hello: Hello, excess: LimitExceeded | None, now: float) -> None:
        session = self._session
        if excess is not None:
            session.end(excess)
            return
        self._opened_time_ns = time.time_ns()
        session.receive(hello, now)
        if session.state is not SessionState.OPENING:
            return
        self._reader = FrameReader(hello)
        self._writer = AnswerWriter(camera.camera_id for camera in hello.cameras)
        try:
            rate_hz = self._account.enter(hello, self, now)
        except LimitExceeded as error:
            self._log.warning(
                "vehicle refused",
                vehicle=hello.vehicle_id,
                reason=error.limit,
                problem=str(error),
            )
            session.end(error)
        else:
            session.grant(rate_hz)

    def _receive_frame(
        self, frame: Frame, message_bytes: int, excess: LimitExceeded | None, now: float
    ) -> None:
        self._metrics.received(frame, message_bytes)
        if excess is None:
            excess = self._excess(lambda: self._account.spend_frame(frame, message_bytes, now))
        if excess is not None:
            self._session.overrun(frame, excess, now)
            return
        self._over_budget = False
        self._session.receive(frame, now)

    def _receive_ahead(
        self, ahead: PoseAhead, message_bytes: int, excess: LimitExceeded | None, now: float
    ) -> None:
        """Take a pose ahead of its frame; one beyond a budget is not prepared for."""
        self._metrics.received_ahead(message_bytes)
        if excess is None:
            excess = self._excess(lambda: self._account.spend_ahead(ahead, message_bytes, now))
        if excess is None:
            self._session.receive(ahead, now)

    async def _open(self, job: OpenJob) -> None:
        try:
            await self._decoders.open(self._account.identity, job, self._account.take_decoders())
        except RfedgeError as error:
            self._account.opening_failed(time.monotonic())
            self._session.open_failed(error, time.monotonic())
        else:
            self._intrinsics = {c.camera_id: c.intrinsics for c in job.hello.cameras}
            self._log = self._log.bind(vehicle=job.hello.vehicle_id)
            self._metrics.forget()
            self._metrics = self._server.metrics.of(job.hello.vehicle_id)
            self._log.info("vehicle welcomed", fields=job.hello.field_ids, exact=job.exact)
            self._session.opened(job, time.monotonic())
        self._wake.set()

    def _expect(self, job: DecodeJob) -> None:
        camera = job.frame.camera(self._intrinsics[job.frame.camera_id])
        if camera is not None:
            self._server.twin.expect(job.field_id, camera)

    # --- outcomes of frames, on the event loop

    def _prepared(self, job: PrepareJob, outcome: float | Exception) -> None:
        if isinstance(outcome, Exception):
            self._fault = outcome
            self._wake.set()
            return
        self._account.prepared(job.ahead.camera_id, outcome, time.monotonic())
        self._server.metrics.poses_prepared.inc()
        self._session.prepared(job)
        self._advance()

    def _finished(
        self, job: DecodeJob, outcome: Reconstruction | Exception, worker_s: float
    ) -> None:
        try:
            self._take_outcome(job, outcome, worker_s, time.monotonic())
        except Exception as error:  # a programming error ends the stream that met it, loudly
            self._fault = error
            self._wake.set()
        else:
            self._advance()

    def _take_outcome(
        self, job: DecodeJob, outcome: Reconstruction | Exception, worker_s: float, now: float
    ) -> None:
        if isinstance(outcome, Exception) and not isinstance(outcome, PacketRejected):
            raise outcome
        is_complete = isinstance(outcome, Reconstruction)
        worker_s = self._account.worked(
            job.frame.camera_id, job.field_id, worker_s, now, complete=is_complete
        )
        changed = self._server.entry.reallocate_rates(now)
        if changed:
            self._regrant(changed)
        if isinstance(outcome, Reconstruction):
            self._reconstructed(job, outcome, now)
        else:
            self._rejected(job, outcome, worker_s, now)

    def _reconstructed(self, job: DecodeJob, made: Reconstruction, now: float) -> None:
        self._session.decoded(job, made.digest, made.times, now)
        since_arrival_s = max(0.0, time.monotonic() - job.received_s)
        latency_s = self._metrics.reconstructed(
            job.frame.capture_time_ns, time.time_ns(), since_arrival_s
        )
        if not made.exact:
            self._server.metrics.inexact.inc()
        self._server.metrics.count_picture(job.field_id, len(job.frame.packet.payload))
        self._show(job, made, now, latency_s)

    def _rejected(self, job: DecodeJob, error: PacketRejected, worker_s: float, now: float) -> None:
        self._log_rejected(job.frame.address, error)
        self._session.rejected(job, error, now)
        if isinstance(error, RenderTooLate):
            self._server.metrics.count_limited(Limit.RENDER_DEADLINE)
        if not isinstance(error.__cause__, DecoderLost):
            self._account.rejected(worker_s, now)
            return
        try:
            self._account.lost_decoder(now)
        except LimitExceeded as barred:
            self._session.end(barred)

    def _log_rejected(
        self, address: FrameAddress, error: PacketRejected, what: str = "frame"
    ) -> None:
        self._log.warning(
            f"{what} rejected",
            camera=address.camera_id,
            epoch=address.epoch,
            seq=address.sequence,
            reason=str(error.reason),
            problem=error.problem,
        )

    def _show(self, job: DecodeJob, made: Reconstruction, now: float, latency_s: float) -> None:
        hello, session = self._session.hello, self._session
        if hello is None or session.closed is not None:
            return
        picture = ReceivedPicture(
            vehicle_id=hello.vehicle_id,
            session_id=session.session_id,
            frame=job.frame,
            intrinsics=self._intrinsics[job.frame.camera_id],
            field_id=job.field_id,
            picture=made.picture,
            digest=made.digest,
            reconstructed_s=now,
            latency_s=latency_s,
            opened_time_ns=self._opened_time_ns,
            decoding_s=now - job.received_s,
        )
        self._server.twin.show(picture, made.render)
        if self._server.trials is not None and not hello.allow_recording:
            self._server.trials.saw(picture)


def _agent_process(context: Context) -> str:
    """Return the name of the agent process at the other end, or else of its connection."""
    for key, value in context.invocation_metadata() or ():
        if key == AGENT_PROCESS:
            return str(value)
    return context.peer()
