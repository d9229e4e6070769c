"""One vehicle's stream: pumps its session between gRPC and the workers.

A reader takes messages in and starts the work they allow; workers' outcomes come back as calls on
the loop; a writer sends what there is to say. A frame wakes the reader once and the writer once,
and makes no task: at thousands of frames a second, each wake-up more is a tenth of a core.
"""

from __future__ import annotations

import asyncio
import time
import uuid
from collections.abc import AsyncIterator, Callable, Mapping
from functools import partial

import grpc
import structlog

from mec_server.decode_jobs import DecodeJob, End, OpenJob
from mec_server.decoding.process import DecoderLost
from mec_server.lazy_timer import LazyTimer
from mec_server.quotas import Allowance
from mec_server.reconstruction import Decoder, Reconstruction
from mec_server.recorder import Recording
from mec_server.server_context import ServerContext
from mec_server.session import ServerSession, SessionState
from mec_server.twin.state import TwinView
from rfcore.camera import Intrinsics
from rfcore.errors import InvalidInput, LimitExceeded, PacketRejected, RfedgeError
from rfcore.wire.convert import client_message_from_bytes
from rfcore.wire.convert_answers import server_messages_to_bytes
from rfcore.wire.identity import peer_identity
from rfcore.wire.messages import Frame, Hello

__all__ = ["Context", "Stream"]

log = structlog.get_logger()
Context = grpc.aio.ServicerContext[bytes, bytes]
Worked = tuple[Reconstruction, float]
"""A picture, and the seconds it took a worker."""

UNKNOWN_VEHICLE = ""
"""Whom a stream counts for until its Hello was accepted."""


class Stream:
    """Pumps one session; ``deal_out`` is called when frames' costs may have changed."""

    def __init__(
        self, around: ServerContext, context: Context, deal_out: Callable[[], None]
    ) -> None:
        self._around = around
        self._deal_out = deal_out
        self._context = context
        self._wake = asyncio.Event()
        self._alarm = LazyTimer(self._wake)
        self._tasks = asyncio.TaskGroup()
        self._identity = peer_identity(context.auth_context())
        self._allowance: Allowance | None = None
        self._overrunning = False
        self._opening: asyncio.Future[dict[str, Decoder]] | None = None
        self._decoders: dict[str, Decoder] = {}
        self._intrinsics: dict[str, Intrinsics] = {}
        self._fault: Exception | None = None
        self._left = False
        self._metrics = around.metrics.of(UNKNOWN_VEHICLE)
        session_id = uuid.uuid4().hex[:12]
        self._log = log.bind(session=session_id, peer=context.peer())
        self._session = ServerSession(
            session_id,
            around.held_field_ids(),
            time.monotonic(),
            around.limits,
            self._identity,
        )

    def drain(self) -> None:
        """Take no more frames and end when those taken are answered."""
        self._session.drain()
        self._wake.set()

    def fields_changed(self, current_field_ids: tuple[str, ...]) -> None:
        """Pass on which fields are current now."""
        self._session.fields_changed(current_field_ids)
        self._wake.set()

    def regrant(self, changed: Mapping[str, float]) -> None:
        """Tell the vehicle its new rate, if it is among ``changed``."""
        rate_hz = changed.get(self._session.session_id)
        if rate_hz is not None:
            self._log.info("rate granted", rate_hz=rate_hz)
            self._session.grant(rate_hz)
            self._wake.set()

    def leave(self) -> None:
        """Let nothing remain of this stream, in the twin or in the metrics."""
        self._left = True
        self._alarm.cancel()
        self._around.twin.leave(self._session.session_id)
        self._metrics.forget()
        self._around.admission.leave(self._session.session_id)
        if self._allowance is not None:
            self._allowance.leave()
        if self._opening is not None:
            self._opening.add_done_callback(_close_decoders)

    async def run(self, requests: AsyncIterator[bytes]) -> End:
        """Serve until the session is closed; return how it ended."""
        self._log.info("stream opened")
        try:
            await self._serve(requests)
        except asyncio.CancelledError:
            self._log.warning("stream closed", error="the vehicle is gone")
            raise
        end = self._session.closed
        assert end is not None
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

    def _advance(self) -> None:
        """Start the work that can be started, and wake the writer if there is something to say."""
        for job in self._session.jobs_to_start(time.monotonic()):
            if isinstance(job, DecodeJob):
                self._around.workers.submit(
                    partial(self._reconstruct, job), partial(self._finished, job)
                )
            else:
                self._tasks.create_task(self._open(job))
        if self._session.has_news:
            self._wake.set()

    async def _write(self) -> None:
        messages = self._session.messages_to_send(time.monotonic())
        if messages:
            self._metrics.answered(messages)
            for data in server_messages_to_bytes(messages):
                await self._context.write(data)

    async def _rest(self) -> None:
        """Wait until there is something to say or the session's timer runs out."""
        if self._session.closed is not None:
            return
        self._alarm.by(self._session.get_timer())
        await self._wake.wait()
        self._wake.clear()
        if self._fault is not None:
            raise self._fault
        self._session.handle_timer(time.monotonic())

    # --- what the vehicle says

    async def _read(self, requests: AsyncIterator[bytes]) -> None:
        async for data in requests:
            now = time.monotonic()
            try:
                message = client_message_from_bytes(data)
            except InvalidInput as error:
                self._log.warning("message refused", problem=str(error))
                self._session.refuse(error, now)
            else:
                if isinstance(message, Frame):
                    self._receive_frame(message, len(data), now)
                else:
                    self._receive_hello(message, now)
            self._advance()
        self.drain()

    def _receive_hello(self, hello: Hello, now: float) -> None:
        session = self._session
        session.receive(hello, now)
        if session.state is not SessionState.OPENING or self._allowance is not None:
            return
        named = self._identity.uris[0] if self._identity is not None else hello.vehicle_id
        try:
            self._allowance = self._around.quotas.enter(named, now)
            rate_hz = self._around.admission.enter(session.session_id, hello)
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

    def _receive_frame(self, frame: Frame, message_bytes: int, now: float) -> None:
        self._metrics.received(frame, message_bytes)
        try:
            if self._allowance is not None:
                self._allowance.spend(message_bytes, now)
        except LimitExceeded as error:
            self._around.metrics.limited.labels(error.limit).inc()
            if not self._overrunning:  # once until it is over: the log has quotas, too
                self._log.warning("frames refused", reason=error.limit, problem=str(error))
            self._overrunning = True
            self._session.overrun(frame, error, now)
        else:
            self._overrunning = False
            self._session.receive(frame, now)

    async def _open(self, job: OpenJob) -> None:
        around = self._around
        self._opening = asyncio.get_running_loop().run_in_executor(
            around.opener, around.open_cameras, job, around.fields, around.tools
        )
        try:
            self._decoders = await asyncio.shield(self._opening)
        except RfedgeError as error:
            self._session.open_failed(error, time.monotonic())
        else:
            self._intrinsics = {c.camera_id: c.intrinsics for c in job.hello.cameras}
            self._log = self._log.bind(vehicle=job.hello.vehicle_id)
            self._metrics.forget()
            self._metrics = around.metrics.of(job.hello.vehicle_id)
            self._log.info("vehicle welcomed", fields=job.hello.field_ids, exact=job.exact)
            self._session.opened(job, time.monotonic())
        self._wake.set()

    # --- numerical work

    def _reconstruct(self, job: DecodeJob) -> Worked | None:
        """Runs on a worker; nobody waits for the frames of a stream that was left."""
        hello = self._session.hello
        if self._left or hello is None:
            return None
        started_s = time.perf_counter()
        done = self._decoders[job.frame.camera_id].reconstruct(job)
        seconds = time.perf_counter() - started_s
        if self._around.recorder is not None:
            self._around.recorder.save(Recording(hello.vehicle_id, job.frame, done.picture))
        return done, seconds

    def _finished(self, job: DecodeJob, outcome: Worked | Exception | None) -> None:
        """Runs on the loop: what became of a frame."""
        if self._left or outcome is None:
            return
        try:
            if isinstance(outcome, tuple):
                self._reconstructed(job, *outcome)
            elif isinstance(outcome, PacketRejected):
                self._rejected(job, outcome)
            else:
                raise outcome
        except Exception as error:  # a fault of ours ends the stream it met, loudly
            self._fault = error
            self._wake.set()
        else:
            self._advance()

    def _reconstructed(self, job: DecodeJob, done: Reconstruction, seconds: float) -> None:
        now = time.monotonic()
        self._around.admission.worked(self._session.session_id, seconds)
        self._deal_out()
        self._session.decoded(job, done.outcome, now)
        latency_s = max(0.0, (time.time_ns() - job.frame.capture_time_ns) / 1e9)
        self._metrics.reconstructed(latency_s)
        if not done.outcome.exact:
            self._around.metrics.inexact.inc()
        self._show(job, done, now, latency_s)

    def _rejected(self, job: DecodeJob, error: PacketRejected) -> None:
        self._log.warning(
            "frame rejected",
            camera=job.frame.camera_id,
            epoch=job.frame.packet.epoch,
            seq=job.frame.packet.sequence,
            reason=str(error.reason),
            problem=error.problem,
        )
        now = time.monotonic()
        self._session.rejected(job, error, now)
        if self._allowance is not None and isinstance(error.__cause__, DecoderLost):
            try:
                self._allowance.lost_decoder(now)
            except LimitExceeded as barred:
                self._session.end(barred)

    def _show(self, job: DecodeJob, done: Reconstruction, now: float, latency_s: float) -> None:
        hello, session = self._session.hello, self._session
        if hello is None or session.closed is not None:
            return
        self._around.twin.show(
            TwinView(
                vehicle_id=hello.vehicle_id,
                session_id=session.session_id,
                frame=job.frame,
                intrinsics=self._intrinsics[job.frame.camera_id],
                field_id=job.field_id,
                picture=done.picture,
                digest=done.outcome.reconstruction_digest,
                reconstructed_s=now,
                latency_s=latency_s,
            )
        )


def _close_decoders(opening: asyncio.Future[dict[str, Decoder]]) -> None:
    """Close, on threads, what was opened for a stream that is over."""
    if opening.cancelled() or opening.exception() is not None:
        return
    loop = asyncio.get_running_loop()
    for decoder in opening.result().values():
        loop.run_in_executor(None, decoder.close)
