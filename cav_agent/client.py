"""A vehicle's stream to one server on grpc.aio.

Three coroutines: ``_encode_pictures`` has captured pictures encoded (on the encoder's thread) and
reports how they ended; ``_stay_connected`` opens stream after stream; inside it a reader and a
writer move bytes. ``cav_agent.session`` makes all decisions.
"""

from __future__ import annotations

import asyncio
import time
import uuid
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass
from typing import Protocol

import grpc
import structlog

from cav_agent.backoff import Backoff
from cav_agent.config import AgentLimits
from cav_agent.frame_log import DriveObserver
from cav_agent.frames import (
    Capture,
    EncodedFrame,
    EncodeJob,
    EndReason,
    FrameResult,
    RetryReason,
    StreamEnd,
)
from cav_agent.server_connection import ServerConnection
from cav_agent.session import AgentSession, LinkState
from rfcore.errors import ProtocolError, RfedgeError
from rfcore.wire.conventions import AGENT_PROCESS, STREAM_METHOD, TILE, VEHICLE, retry_after_s
from rfcore.wire.convert_answers import AnswerReader
from rfcore.wire.messages import FieldNotice, PoseAhead, Welcome
from rfcore.wire.notices import StreetNotice

log = structlog.get_logger()
Stream = grpc.aio.StreamStreamCall[bytes, bytes]

PROCESS = uuid.uuid4().hex
"""Lets a server know which streams are of one process, so that no other sends the same camera."""

FINAL = frozenset(
    {
        grpc.StatusCode.INVALID_ARGUMENT,
        grpc.StatusCode.UNIMPLEMENTED,
        grpc.StatusCode.PERMISSION_DENIED,
        grpc.StatusCode.UNAUTHENTICATED,
        grpc.StatusCode.DATA_LOSS,
    }
)
"""Statuses that another try on the same terms would only repeat: they end the client.
``cav_agent.handover_controller`` decides whether the drive ends with it."""

FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.02, 1.0
"""Pauses between streams: short after a welcomed one, doubling while none is welcomed."""

CAMERA_TAKEN = "camera_taken"
"""First word of the details with which a server refuses a camera that another agent sends."""

CAMERA_TAKEN_TRIES = 2
"""A server says when to try again. By then, an agent that has died no longer holds its camera."""


class CameraTaken(ProtocolError):
    """Another agent sends a camera with the names of this vehicle and camera."""


class FieldNotServed(ProtocolError):
    """The server does not hold the stream's field (any more); its tiles are to be relearned."""


class StreamOwner(Protocol):
    """Opens a stream and gives it pictures."""

    def ended(self, result: FrameResult) -> None:
        """A captured picture came to its end; raise ``RfedgeError`` to end the stream."""

    def welcomed(self) -> None:
        """The server takes pictures now."""


@dataclass(frozen=True)
class CameraSource:
    """Takes the pictures at a place of the drive, posed for the stream's tile, and encodes them."""

    take: Callable[[int], Sequence[Capture]]
    encode: Callable[[EncodeJob, Callable[[PoseAhead], None]], EncodedFrame]
    executor: Executor


class StreamClient:
    """Streams what ``capture`` takes to one server, until ``finish``.

    ``tile``: the name of the tile, by which a proxy places the stream.
    """

    def __init__(
        self,
        server: ServerConnection,
        session: AgentSession,
        source: CameraSource,
        owner: StreamOwner,
        observer: DriveObserver,
        limits: AgentLimits,
        *,
        tile: str,
    ) -> None:
        names = {AGENT_PROCESS: PROCESS, VEHICLE: session.vehicle_id, TILE: tile}
        self._metadata = tuple(names.items())
        self._server = server
        self._session = session
        self._source = source
        self._owner = owner
        self._observer = observer
        self._limits = limits
        self._stream: Stream | None = None
        self._is_finishing = False
        self._stopping_until_s: float | None = None
        self._finished = False
        self._retry_after_s = 0.0
        self._times_taken = 0
        self._streaming_at_s = time.monotonic()
        self._changed = asyncio.Event()
        self._may_write = asyncio.Event()

    @property
    def is_streaming(self) -> bool:
        """Return whether the server has welcomed the vehicle and pictures may be captured."""
        return not self._is_finishing and self._session.state is LinkState.STREAMING

    @property
    def waits_for(self) -> str:
        """Return what keeps a picture from being sent or answered; "" for nothing."""
        return self._session.waits_for

    @property
    def is_draining(self) -> bool:
        """Return whether the server is draining: it takes pictures until another one does."""
        return self._session.is_draining

    @property
    def rate_limit_hz(self) -> float:
        """Pictures per second that the server lets the camera send; 0: as many as Credit allows."""
        return self._session.rate_limit_hz

    def capture(self, index: int) -> None:
        """Take the pictures at place ``index`` of the drive now."""
        self._session.offer(*self._source.take(index))
        self._changed.set()

    def withdraw(self) -> None:
        """Drop the picture that waits for the encoder: another server takes the vehicle over."""
        self._session.withdraw()
        self._changed.set()

    def finish(self) -> None:
        """Expect no further picture; ``run`` ends when all that were captured have ended."""
        self._is_finishing = True
        self._changed.set()

    def stop(self) -> None:
        """Drop what waits for the encoder; ``run`` ends when the frame in flight was answered."""
        if self._stopping_until_s is None:
            self._is_finishing = True
            self._stopping_until_s = time.monotonic() + self._limits.drain_s
            self._changed.set()

    def abandon(self, problem: str) -> None:
        """Report the pictures that ``run`` left without an end."""
        self._session.abandon(StreamEnd(EndReason.ABANDONED, problem), time.monotonic())
        self._report_ended()

    async def run(self) -> None:
        """Stream until all is answered, then close; raise ``RfedgeError`` if that cannot be."""
        connecting = asyncio.create_task(self._stay_connected())
        encoding = asyncio.create_task(self._encode_pictures())
        try:
            await asyncio.wait({connecting, encoding}, return_when=asyncio.FIRST_COMPLETED)
            if connecting.done():
                connecting.result()
            await encoding
            await self._close(connecting)
        finally:
            for task in (encoding, connecting):
                task.cancel()
            await asyncio.gather(encoding, connecting, return_exceptions=True)

    # --- pictures

    async def _encode_pictures(self) -> None:
        encoding: asyncio.Task[None] | None = None
        try:
            while True:
                now = time.monotonic()
                self._advance(now)
                job = self._session.job_to_start(now)
                if job is not None:
                    encoding = asyncio.create_task(self._encode(job))
                self._report_ended()  # also the pictures that job_to_start dropped as too late
                if self._is_done(now):
                    break
                self._may_write.set()
                await self._rest(now)
                if encoding is not None and encoding.done():
                    encoding.result()
        finally:
            if encoding is not None:
                encoding.cancel()

    def _advance(self, now: float) -> None:
        """Pass the time to the session, and act on what it decides."""
        session = self._session
        session.handle_timer(now)
        if session.failed is not None:
            raise session.failed
        if session.broken is not None and self._stream is not None:
            self._stream.cancel()
        if self._stopping_until_s is not None:
            session.stop()

    def _report_ended(self) -> None:
        for result in self._session.take_results():
            self._owner.ended(result)

    def _is_done(self, now: float) -> bool:
        if self._stopping_until_s is not None and now >= self._stopping_until_s:
            return True
        return self._is_finishing and self._session.is_idle

    async def _rest(self, now: float) -> None:
        """Wait until something happens or the earliest timer runs out."""
        timers = (self._session.get_timer(), self._stopping_until_s)
        due = [timer for timer in timers if timer is not None]
        with suppress(TimeoutError):
            async with asyncio.timeout(max(0.0, min(due) - now) if due else None):
                await self._changed.wait()
        self._changed.clear()

    async def _encode(self, job: EncodeJob) -> None:
        loop, source = asyncio.get_running_loop(), self._source

        def announce(ahead: PoseAhead) -> None:
            loop.call_soon_threadsafe(self._located, job, ahead)

        try:
            encoded = await loop.run_in_executor(source.executor, source.encode, job, announce)
        except RfedgeError as error:
            self._session.encoding_failed(error)
        else:
            self._session.encoded(encoded, time.monotonic())
        finally:
            self._changed.set()

    def _located(self, job: EncodeJob, ahead: PoseAhead) -> None:
        self._session.located(job, ahead)
        self._may_write.set()

    # --- the stream

    async def _stay_connected(self) -> None:
        backoff = Backoff(FIRST_PAUSE_S, LONGEST_PAUSE_S)
        while not self._finished:
            await self._wait_for_server()
            end = await self._one_stream()
            if self._finished:
                return
            welcomed = self._session.state is LinkState.STREAMING
            if welcomed:
                self._streaming_at_s = time.monotonic()
                self._observer.connected(False)
            self._session.connection_lost(end, time.monotonic())
            self._changed.set()
            log.warning("stream lost", reason=str(end.reason), problem=end.problem)
            self._observer.retrying(RetryReason.STREAM)
            if welcomed:
                backoff.reset()
            await asyncio.sleep(max(backoff.next_s(), self._retry_after_s))

    async def _wait_for_server(self) -> None:
        limit_s = self._limits.give_up_s
        left_s = self._streaming_at_s + limit_s - time.monotonic() if limit_s else None
        try:
            await self._server.wait_until_ready(left_s)
        except TimeoutError as error:
            raise RfedgeError(f"no server welcomed this vehicle within {limit_s:g} s") from error

    async def _one_stream(self) -> StreamEnd:
        """Open a stream and serve it to its end; return why it ended."""
        self._retry_after_s = 0.0
        stream: Stream = self._server.channel.stream_stream(STREAM_METHOD)(metadata=self._metadata)
        self._stream = stream
        self._session.connected(time.monotonic())
        self._changed.set()
        writer = asyncio.create_task(self._write(stream))
        try:
            await self._read(stream)
        except grpc.aio.AioRpcError as error:
            return self._ended_by(error)
        except ProtocolError as error:
            return StreamEnd(EndReason.STREAM_LOST, str(error))
        except asyncio.CancelledError:
            if self._session.broken is None:
                raise
            return self._session.broken
        finally:
            self._stream = None
            writer.cancel()
            stream.cancel()
            await asyncio.gather(writer, return_exceptions=True)
        return StreamEnd(EndReason.SERVER_CLOSED, "the server closed the stream")

    def _ended_by(self, error: grpc.aio.AioRpcError) -> StreamEnd:
        """Return why the stream ended; raise ``ProtocolError`` if another would end the same way.

        A camera that another agent sends is final at the second refusal in a row.
        """
        details = error.details() or ""
        if error.code() is grpc.StatusCode.NOT_FOUND:
            self._server.fields_changed.set()
            raise FieldNotServed(details) from error
        if error.code() in FINAL:
            raise ProtocolError(details) from error
        is_taken = details.partition(":")[0] == CAMERA_TAKEN
        self._times_taken = self._times_taken + 1 if is_taken else 0
        if self._times_taken >= CAMERA_TAKEN_TRIES:
            raise CameraTaken(details) from error
        self._retry_after_s = retry_after_s(error.trailing_metadata())
        return StreamEnd(EndReason.STREAM_LOST, f"{error.code().name}: {details}")

    async def _read(self, stream: Stream) -> None:
        reader = AnswerReader(self._session.camera_ids)
        async for data in stream:
            messages = reader.messages(data)
            if not messages:
                self._observer.message_unknown()
            for message in messages:
                self._session.receive(message, time.monotonic())
                if isinstance(message, Welcome):
                    self._times_taken = 0
                    self._observer.connected(True)
                    self._owner.welcomed()
                elif isinstance(message, FieldNotice):
                    self._server.fields_changed.set()
                elif isinstance(message, StreetNotice):
                    self._observer.noticed(message)
            self._changed.set()

    async def _write(self, stream: Stream) -> None:
        with suppress(grpc.aio.AioRpcError, asyncio.InvalidStateError):
            while True:
                self._may_write.clear()
                for outgoing in self._session.messages_to_send(time.monotonic()):
                    await stream.write(outgoing.data)
                await self._may_write.wait()

    async def _close(self, connecting: asyncio.Task[None]) -> None:
        """Announce that no more frames come, and let the server finish."""
        self._finished = True
        if self._stream is None:
            return
        with suppress(grpc.aio.AioRpcError, asyncio.InvalidStateError, TimeoutError):
            async with asyncio.timeout(self._limits.drain_s):
                await self._stream.done_writing()
                await asyncio.wait({connecting})
