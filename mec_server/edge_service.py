"""EdgeService over grpc.aio: moves bytes between streams and sessions, and work to threads.

Messages travel as bytes here and are parsed by ``rfcore.wire.convert``: a message that cannot be
parsed is then a Nack like any other, instead of the end of the stream.
"""

from __future__ import annotations

import asyncio
import time
import uuid
from collections.abc import AsyncIterator, Callable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass

import grpc
import structlog

from mec_server.admission import Admission
from mec_server.alarm import Alarm
from mec_server.config import SessionLimits
from mec_server.decoder_process import DecoderLost
from mec_server.handlers import Decoder, FieldSource, OpenCameras, Reconstruction, Tools
from mec_server.jobs import DecodeJob, End, OpenJob
from mec_server.metrics import ServerMetrics
from mec_server.quotas import Allowance, Limit, Quotas
from mec_server.recorder import Recorder, Recording
from mec_server.session import ServerSession, SessionState
from mec_server.twin import Twin, TwinView
from rfcore.errors import InvalidInput, LimitExceeded, PacketRejected, RfedgeError
from rfcore.wire.conventions import RETRY_AFTER, STREAM_METHOD
from rfcore.wire.convert import client_message_from_bytes
from rfcore.wire.convert_answers import server_messages_to_bytes
from rfcore.wire.identity import peer_identity
from rfcore.wire.messages import Frame, Hello
from rfcore.wire.status import status_of

__all__ = ["EdgeService", "Surroundings"]

log = structlog.get_logger()
Context = grpc.aio.ServicerContext[bytes, bytes]

UNKNOWN_VEHICLE = ""
"""Whom a stream counts for until its Hello was accepted."""


@dataclass(frozen=True)
class Surroundings:
    """What the sessions of one server share.

    ``executor`` decodes, ``opener`` makes ready for new vehicles: a crowd of them, or a decoder
    process that takes its time, shall not hold up frames.
    """

    fields: FieldSource
    held_field_ids: Callable[[], tuple[str, ...]]
    executor: Executor
    opener: Executor
    tools: Tools
    metrics: ServerMetrics
    limits: SessionLimits
    quotas: Quotas
    admission: Admission
    max_streams: int
    twin: Twin
    open_cameras: OpenCameras
    recorder: Recorder | None = None


class EdgeService:
    """Accepts streams and lets them go when the server drains."""

    def __init__(self, around: Surroundings) -> None:
        self._around = around
        self._streams: set[_Stream] = set()

    def register(self, server: grpc.aio.Server) -> None:
        """Add the service to a server that has not started."""
        _, service, method = STREAM_METHOD.split("/")
        handler: grpc.RpcMethodHandler[bytes, bytes] = grpc.stream_stream_rpc_method_handler(
            self._handle
        )
        server.add_generic_rpc_handlers(
            (grpc.method_handlers_generic_handler(service, {method: handler}),)
        )

    def drain(self) -> None:
        """Let every stream finish what it has taken, then end it."""
        for stream in self._streams:
            stream.drain()

    def fields_changed(self, current_field_ids: tuple[str, ...]) -> None:
        """Tell every vehicle which fields are current now."""
        for stream in self._streams:
            stream.fields_changed(current_field_ids)

    async def _handle(self, requests: AsyncIterator[bytes], context: Context) -> None:
        if len(self._streams) >= self._around.max_streams:
            await self._turn_away(context)
        stream = _Stream(self._around, context, self._deal_out)
        self._streams.add(stream)
        self._around.metrics.sessions.inc()
        try:
            end = await stream.run(requests)
        finally:
            self._streams.discard(stream)
            self._around.metrics.sessions.dec()
            stream.leave()
        if end.error is not None:
            if isinstance(end.error, LimitExceeded):
                self._around.metrics.limited.labels(end.error.limit).inc()
            await context.abort(status_of(end.error), str(end.error), _retry_after(end.error))

    def _deal_out(self) -> None:
        """Tell vehicles whose rate changes."""
        changed = self._around.admission.review(time.monotonic())
        if changed:
            for stream in self._streams:
                stream.regrant(changed)

    async def _turn_away(self, context: Context) -> None:
        error = LimitExceeded(
            Limit.SERVER_STREAMS,
            f"{len(self._streams)} streams are open, as many as may be; try again later",
        )
        self._around.metrics.limited.labels(error.limit).inc()
        log.warning("stream refused", peer=context.peer(), problem=str(error))
        await context.abort(status_of(error), str(error))


class _Stream:
    """Pumps one session: one reader, one writer, and tasks that wait for worker threads."""

    def __init__(
        self, around: Surroundings, context: Context, deal_out: Callable[[], None]
    ) -> None:
        self._around = around
        self._deal_out = deal_out
        self._context = context
        self._wake = asyncio.Event()
        self._alarm = Alarm(self._wake)
        self._identity = peer_identity(context.auth_context())
        self._allowance: Allowance | None = None
        self._overrunning = False
        self._opening: asyncio.Future[dict[str, Decoder]] | None = None
        self._decoders: dict[str, Decoder] = {}
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

    def leave(self) -> None:
        """Let nothing remain of this stream, in the twin or in the metrics."""
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
        async with asyncio.TaskGroup() as tasks:
            reader = tasks.create_task(self._read(requests))
            while self._session.closed is None:
                for job in self._session.jobs_to_start(time.monotonic()):
                    tasks.create_task(self._work(job))
                await self._write()
                await self._rest()
            await self._write()
            reader.cancel()

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
            self._wake.set()
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

    def regrant(self, changed: Mapping[str, float]) -> None:
        """Tell the vehicle its new rate, if it is among ``changed``."""
        rate_hz = changed.get(self._session.session_id)
        if rate_hz is not None:
            self._log.info("rate granted", rate_hz=rate_hz)
            self._session.grant(rate_hz)
            self._wake.set()

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

    async def _write(self) -> None:
        messages = self._session.messages_to_send(time.monotonic())
        self._metrics.answered(messages)
        for data in server_messages_to_bytes(messages):
            await self._context.write(data)

    async def _rest(self) -> None:
        """Wait until something happens or the session's timer runs out."""
        if self._session.closed is not None:
            return
        self._alarm.by(self._session.get_timer())
        await self._wake.wait()
        self._wake.clear()
        self._session.handle_timer(time.monotonic())

    async def _work(self, job: OpenJob | DecodeJob) -> None:
        if isinstance(job, OpenJob):
            await self._open(job)
        else:
            await self._decode(job)
        self._wake.set()

    async def _open(self, job: OpenJob) -> None:
        around = self._around
        self._opening = asyncio.get_running_loop().run_in_executor(
            around.opener, around.open_cameras, job, around.fields, around.tools
        )
        try:
            self._decoders = await asyncio.shield(self._opening)
        except RfedgeError as error:
            self._session.open_failed(error, time.monotonic())
            return
        self._log = self._log.bind(vehicle=job.hello.vehicle_id)
        self._metrics.forget()
        self._metrics = around.metrics.of(job.hello.vehicle_id)
        self._log.info("vehicle welcomed", fields=job.hello.field_ids, exact=job.exact)
        self._session.opened(job, time.monotonic())

    async def _decode(self, job: DecodeJob) -> None:
        try:
            done = await self._reconstruct(job)
        except PacketRejected as error:
            self._log.warning(
                "frame rejected",
                camera=job.frame.camera_id,
                epoch=job.frame.packet.epoch,
                seq=job.frame.packet.sequence,
                reason=str(error.reason),
                problem=error.problem,
            )
            self._session.rejected(job, error, time.monotonic())
            self._count_lost_decoder(error)
            return
        now = time.monotonic()
        self._session.decoded(job, done.outcome, now)
        latency_s = max(0.0, (time.time_ns() - job.frame.capture_time_ns) / 1e9)
        self._metrics.reconstructed(latency_s)
        if not done.outcome.exact:
            self._around.metrics.inexact.inc()
        self._show(job, done, now, latency_s)

    def _count_lost_decoder(self, error: PacketRejected) -> None:
        if self._allowance is None or not isinstance(error.__cause__, DecoderLost):
            return
        try:
            self._allowance.lost_decoder(time.monotonic())
        except LimitExceeded as barred:
            self._session.end(barred)

    def _show(self, job: DecodeJob, done: Reconstruction, now: float, latency_s: float) -> None:
        hello, session = self._session.hello, self._session
        if hello is None or session.closed is not None:
            return
        camera_id = job.frame.camera_id
        camera = next(camera for camera in hello.cameras if camera.camera_id == camera_id)
        self._around.twin.show(
            TwinView(
                vehicle_id=hello.vehicle_id,
                session_id=session.session_id,
                frame=job.frame,
                intrinsics=camera.intrinsics,
                field_id=job.field_id,
                picture=done.picture,
                digest=done.outcome.reconstruction_digest,
                reconstructed_s=now,
                latency_s=latency_s,
            )
        )

    async def _reconstruct(self, job: DecodeJob) -> Reconstruction:
        decoder = self._decoders[job.frame.camera_id]
        loop, executor = asyncio.get_running_loop(), self._around.executor
        done, seconds = await loop.run_in_executor(executor, _timed, decoder, job)
        self._around.admission.worked(self._session.session_id, seconds)
        self._deal_out()
        recorder, hello = self._around.recorder, self._session.hello
        if recorder is not None and hello is not None:
            kept = Recording(hello.vehicle_id, job.frame, done.picture)
            await loop.run_in_executor(executor, recorder.save, kept)
        return done


def _timed(decoder: Decoder, job: DecodeJob) -> tuple[Reconstruction, float]:
    """Reconstruct, and say how long that took a worker."""
    started_s = time.perf_counter()
    done = decoder.reconstruct(job)
    return done, time.perf_counter() - started_s


def _retry_after(error: RfedgeError) -> tuple[tuple[str, str], ...]:
    after_s = error.retry_after_s if isinstance(error, LimitExceeded) else None
    return () if after_s is None else ((RETRY_AFTER, str(round(1e3 * after_s))),)


def _close_decoders(opening: asyncio.Future[dict[str, Decoder]]) -> None:
    """Close, on threads, what was opened for a stream that is over."""
    if opening.cancelled() or opening.exception() is not None:
        return
    loop = asyncio.get_running_loop()
    for decoder in opening.result().values():
        loop.run_in_executor(None, decoder.close)
