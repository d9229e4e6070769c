"""The agent on grpc.aio: keeps a stream to the server, and moves pictures through the session.

Three coroutines: ``_drive`` captures, encodes (on a thread) and reports; ``_stay_connected`` opens
stream after stream; inside it a reader and a writer move bytes. All decisions are the session's
and the pace's.
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass

import grpc
import structlog

from cav_agent.capture_schedule import CaptureSchedule
from cav_agent.config import AgentLimits
from cav_agent.frames import Capture, EncodedFrame, EncodeJob, FrameResult
from cav_agent.session import AgentSession, LinkState
from rfcore.errors import ProtocolError, RfedgeError
from rfcore.views import PosedPicture
from rfcore.wire.conventions import RETRY_AFTER, STREAM_METHOD
from rfcore.wire.convert import client_message_to_bytes
from rfcore.wire.convert_answers import server_messages_from_bytes
from rfcore.wire.messages import FieldNotice, Welcome

__all__ = ["Agent", "Equipment"]

log = structlog.get_logger()
Stream = grpc.aio.StreamStreamCall[bytes, bytes]

FINAL = frozenset(
    {
        grpc.StatusCode.INVALID_ARGUMENT,
        grpc.StatusCode.NOT_FOUND,
        grpc.StatusCode.FAILED_PRECONDITION,
        grpc.StatusCode.UNIMPLEMENTED,
        grpc.StatusCode.PERMISSION_DENIED,
        grpc.StatusCode.UNAUTHENTICATED,
        grpc.StatusCode.DATA_LOSS,
    }
)
"""Statuses that another try would only repeat."""

FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.02, 1.0
"""Between streams: short after one that was welcomed, doubling while none is."""

LONGEST_ASKED_S = 30.0
"""A server that is full says when to come again; nobody waits longer."""


@dataclass(frozen=True)
class Equipment:
    """What the agent works with: a drive, a way to encode, and who wants to know.

    ``reached`` waits so many seconds for the server (None: for ever) or raises ``TimeoutError``.
    ``ended`` is told of every picture's end, ``connected`` when the server welcomed us or was lost,
    ``noticed`` when it says that it publishes something else.
    """

    pictures: tuple[PosedPicture, ...]
    pace: CaptureSchedule
    encode: Callable[[EncodeJob], EncodedFrame]
    executor: Executor
    reached: Callable[[float | None], Awaitable[None]]
    ended: Callable[[FrameResult], None]
    connected: Callable[[bool], None]
    noticed: Callable[[], None]


class Agent:
    """One camera's drive over one channel."""

    def __init__(
        self,
        channel: grpc.aio.Channel,
        session: AgentSession,
        equipment: Equipment,
        limits: AgentLimits,
    ) -> None:
        self._channel = channel
        self._session = session
        self._equipment = equipment
        self._limits = limits
        self._stream: Stream | None = None
        self._stopping_until_s: float | None = None
        self._finished = False
        self._asked_pause_s = 0.0
        self._streaming_at_s = time.monotonic()
        self._drive_wake = asyncio.Event()
        self._write_wake = asyncio.Event()
        self.counts: Counter[str] = Counter()

    @property
    def state(self) -> LinkState:
        """Where the conversation with the server is."""
        return self._session.state

    def wake(self) -> None:
        """Look at the pace again."""
        self._drive_wake.set()

    def withdraw(self) -> None:
        """Let the picture go that waits for the encoder: another server takes the vehicle over."""
        self._session.withdraw()
        self._drive_wake.set()

    def stop(self) -> None:
        """Capture no more; ``run`` ends when the frame in flight was answered."""
        if self._stopping_until_s is None:
            self._stopping_until_s = time.monotonic() + self._limits.drain_s
            self._drive_wake.set()

    async def run(self) -> None:
        """Drive to the end, then close the stream; raise ``RfedgeError`` if that cannot be."""
        connecting = asyncio.create_task(self._stay_connected())
        driving = asyncio.create_task(self._drive())
        try:
            await asyncio.wait({connecting, driving}, return_when=asyncio.FIRST_COMPLETED)
            if connecting.done():
                connecting.result()
            await driving
            await self._close(connecting)
        finally:
            for task in (driving, connecting):
                task.cancel()
            await asyncio.gather(driving, connecting, return_exceptions=True)

    # --- pictures

    async def _drive(self) -> None:
        encoding: asyncio.Task[None] | None = None
        while True:
            now = time.monotonic()
            self._advance(now)
            if self._is_done(now):
                break
            job = self._session.job_to_start(now)
            if job is not None:
                encoding = asyncio.create_task(self._encode(job))
            self._write_wake.set()
            await self._rest(now)
            if encoding is not None and encoding.done():
                encoding.result()

    def _advance(self, now: float) -> None:
        """Let session and pace know the time, and move what is ready between them."""
        session, pace = self._session, self._equipment.pace
        session.handle_timer(now)
        if session.failed is not None:
            raise session.failed
        if session.broken is not None and self._stream is not None:
            self._stream.cancel()
        for result in session.take_results():
            self.counts[str(result.outcome)] += 1
            self._equipment.ended(result)
            pace.ended(result)
        if self._stopping_until_s is not None:
            session.stop()
            return
        while (index := pace.next_capture(now)) is not None:
            session.offer(Capture(index, self._equipment.pictures[index], now, time.time_ns()))

    def _is_done(self, now: float) -> bool:
        if self._stopping_until_s is not None:
            return self._session.is_idle or now >= self._stopping_until_s
        return self._equipment.pace.finished and self._session.is_idle

    async def _rest(self, now: float) -> None:
        """Wait until something happens or the earliest timer runs out."""
        timers = [self._session.get_timer(), self._stopping_until_s]
        if self._stopping_until_s is None:
            timers.append(self._equipment.pace.get_timer())
        due = [timer for timer in timers if timer is not None]
        with suppress(TimeoutError):
            async with asyncio.timeout(max(0.0, min(due) - now) if due else None):
                await self._drive_wake.wait()
        self._drive_wake.clear()

    async def _encode(self, job: EncodeJob) -> None:
        loop, equipment = asyncio.get_running_loop(), self._equipment
        try:
            encoded = await loop.run_in_executor(equipment.executor, equipment.encode, job)
        except RfedgeError as error:
            self._session.encoding_failed(error)
        else:
            self._session.encoded(encoded, time.monotonic())
        finally:
            self._drive_wake.set()

    # --- the stream

    async def _stay_connected(self) -> None:
        pause_s = FIRST_PAUSE_S
        while not self._finished:
            await self._wait_for_server()
            reason = await self._one_stream()
            if self._finished:
                return
            welcomed = self._session.state is LinkState.STREAMING
            if welcomed:
                self._streaming_at_s = time.monotonic()
                self._equipment.connected(False)
            self._session.connection_lost(reason, time.monotonic())
            self._drive_wake.set()
            log.warning("stream lost", reason=reason)
            pause_s = FIRST_PAUSE_S if welcomed else min(2 * pause_s, LONGEST_PAUSE_S)
            await asyncio.sleep(max(pause_s, self._asked_pause_s))

    async def _wait_for_server(self) -> None:
        limit_s = self._limits.give_up_s
        left_s = self._streaming_at_s + limit_s - time.monotonic() if limit_s else None
        try:
            await self._equipment.reached(left_s)
        except TimeoutError as error:
            raise RfedgeError(f"no server welcomed this vehicle within {limit_s:g} s") from error

    async def _one_stream(self) -> str:
        """Open a stream and serve it to its end; return why it ended."""
        self._asked_pause_s = 0.0
        stream: Stream = self._channel.stream_stream(STREAM_METHOD)()
        self._stream = stream
        self._session.connected(time.monotonic())
        self._drive_wake.set()
        writer = asyncio.create_task(self._write(stream))
        try:
            await self._read(stream)
        except grpc.aio.AioRpcError as error:
            if error.code() in FINAL:
                raise ProtocolError(f"{error.details()}") from error
            self._asked_pause_s = _retry_after_s(error)
            return f"{error.code().name}: {error.details()}"
        except asyncio.CancelledError:
            if self._session.broken is None:
                raise
            return self._session.broken
        finally:
            self._stream = None
            writer.cancel()
            stream.cancel()
            await asyncio.gather(writer, return_exceptions=True)
        return "the server closed the stream"

    async def _read(self, stream: Stream) -> None:
        async for data in stream:
            for message in server_messages_from_bytes(data):
                self._session.receive(message, time.monotonic())
                if isinstance(message, Welcome):
                    self._equipment.connected(True)
                    self._equipment.pace.limit(message.rate_hz)
                elif isinstance(message, FieldNotice):
                    self._equipment.noticed()
            self._drive_wake.set()

    async def _write(self, stream: Stream) -> None:
        with suppress(grpc.aio.AioRpcError, asyncio.InvalidStateError):
            while True:
                self._write_wake.clear()
                for message in self._session.messages_to_send(time.monotonic()):
                    await stream.write(client_message_to_bytes(message))
                await self._write_wake.wait()

    async def _close(self, connecting: asyncio.Task[None]) -> None:
        """Say that no more frames come, and let the server finish."""
        self._finished = True
        if self._stream is None:
            return
        with suppress(grpc.aio.AioRpcError, asyncio.InvalidStateError, TimeoutError):
            async with asyncio.timeout(self._limits.drain_s):
                await self._stream.done_writing()
                await asyncio.wait({connecting})


def _retry_after_s(error: grpc.aio.AioRpcError) -> float:
    """Return how long a server that refused us wants to be left alone."""
    for key, value in error.trailing_metadata():
        if key == RETRY_AFTER and isinstance(value, str) and value.isdecimal():
            return min(int(value) / 1e3, LONGEST_ASKED_S)
    return 0.0
