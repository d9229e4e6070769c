"""The drive itself: captures pictures in time and gives each to the stream of its tile.

One loop asks ``cav_agent.capture_schedule`` which picture is due and ``cav_agent.handover`` which
tile takes it. It opens the next tile's stream before it is needed, and closes the last one's when
it is not needed any more. The next tile's field is fetched while the present one is in use, and
stays prepared while its tile lies ahead.

``TileStream`` is one tile on the vehicle's way: its field prepared, and a stream to its server
while that is wanted. A stream that is closed first finishes what it has taken. Where the server is
draining, a second stream to the same address is opened beside the first: a proxy places it on
another server, which takes over as soon as it has welcomed the vehicle.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from typing import Any

import structlog

from cav_agent.backoff import Backoff
from cav_agent.cameras import Position
from cav_agent.capture_schedule import CaptureSchedule
from cav_agent.client import CameraTaken, FieldNotServed, StreamClient, StreamOwner
from cav_agent.config import AgentConfig, PaceKind
from cav_agent.frame_log import DriveObserver
from cav_agent.frames import FrameResult, Outcome, RetryReason
from cav_agent.handover import LOST_AFTER_S, Handover, ServedTile, TileRoute
from rfcore.errors import ProtocolError, RfedgeError
from rfcore.wire.waits import WaitLog, log_wait

log = structlog.get_logger()

NEAR_S, NEAR_PICTURES = 2.0, 3
"""Time before a border at which the next stream is opened; in lockstep, number of pictures."""

AHEAD_S, AHEAD_PICTURES = 30.0, 30
"""Time before a border at which the next field is fetched; in lockstep, number of pictures."""

SHORTEST_REST_S = 0.001
POLL_S = 0.25
"""A stream that breaks between two pictures is noticed within this time."""

ANSWERED_S = 1.0
"""A drive whose last answer is not older waits for nothing."""

FIRST_RETRY_S, LONGEST_RETRY_S = 1.0, 30.0
"""Pauses before a stream that failed is opened again: longer with every failure in a row."""

OpenStream = Callable[[StreamOwner], StreamClient]
"""Returns a client for a new stream to a tile that was prepared."""

PrepareStream = Callable[[ServedTile], Awaitable[OpenStream]]
"""Fetches and opens a tile's field; returns how to open streams with it."""


class HandoverController:
    """Drives along ``positions`` across the tiles that ``tiles_published`` names.

    It owns every stream: each result is counted here once, and passed on to ``schedule`` and
    ``observer``. ``changed`` is set to wake its loop, for example when a live picture has arrived.
    """

    def __init__(
        self,
        config: AgentConfig,
        positions: Sequence[Position],
        schedule: CaptureSchedule,
        prepare: PrepareStream,
        observer: DriveObserver,
        changed: asyncio.Event,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._config = config
        self._positions = tuple(positions)
        self._schedule = schedule
        self._prepare = prepare
        self._observer = observer
        self._changed = changed
        self._tiles: dict[int, tuple[ServedTile, ...]] = {}
        self._streams: dict[ServedTile, TileStream] = {}
        self._handover: Handover | None = None
        self._next = 0
        self._stopping = False
        self._was_welcomed = False
        self._failed: RfedgeError | None = None
        self._began_s = self._streaming_at_s = self._answered_at_s = time.monotonic()
        self._waits = WaitLog(log_wait)

    def tiles_published(self, server: int, tiles: Sequence[ServedTile]) -> None:
        """Follow what a server publishes now."""
        self._tiles[server] = tuple(tiles)
        every = [served for number in sorted(self._tiles) for served in self._tiles[number]]
        if not every:
            return
        route = TileRoute(every, self._positions)
        if self._handover is None:
            self._handover = Handover(route, self._pictures(NEAR_S, NEAR_PICTURES))
        else:
            self._handover.follow(route)
        self._changed.set()

    def stop(self) -> None:
        """Capture no more; ``run`` ends when what is in flight was answered."""
        self._stopping = True
        for stream in self._streams.values():
            stream.stop()
        self._changed.set()

    async def run(self) -> None:
        """Drive to the end; raise ``RfedgeError`` if that cannot be."""
        try:
            while not self._is_done():
                now = time.monotonic()
                if self._failed is not None:
                    raise self._failed
                self._collect(now)
                knows_first = 0 in self._tiles or now - self._began_s >= LOST_AFTER_S
                if self._handover is not None and knows_first:
                    self._advance(self._handover, now)
                    self._waits.note(self._waits_for(self._handover, now), now)
                await self._rest(now)
            await self._finish()
        finally:
            tasks = [task for stream in self._streams.values() for task in stream.tasks]
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    def _is_done(self) -> bool:
        return self._stopping or self._schedule.finished

    # --- what streams report

    def ended(self, result: FrameResult) -> None:
        """Count a picture that came to its end; the schedule may end the drive with an error."""
        self.counts[str(result.outcome)] += 1
        if result.outcome in (Outcome.ACKED, Outcome.NACKED):
            self._answered_at_s = time.monotonic()
        self._observer.ended(result)
        try:
            self._schedule.ended(result)
        except RfedgeError as error:
            self._failed = error
        self._changed.set()

    def welcomed(self) -> None:
        """Note that a server has welcomed the vehicle."""
        self._was_welcomed = True
        self._changed.set()

    def _waits_for(self, handover: Handover, now: float) -> str:
        """Return what the drive waits for, once no picture was answered for ``ANSWERED_S``."""
        if now - self._answered_at_s < ANSWERED_S:
            return ""
        waits_for = self._candidate(handover, now).waits_for(now)
        if not waits_for and self._schedule.get_timer() is None and not self._is_done():
            return "the next picture of the camera" if self._streaming() else ""
        return waits_for

    # --- pictures

    def _advance(self, handover: Handover, now: float) -> None:
        """Open and close streams, then capture the pictures that are due."""
        self._hold_streams(handover, now)
        while self._candidate(handover, now).client is not None:
            index = self._schedule.next_capture(now)
            if index is None:
                return
            self._capture(handover, index, now)

    def _candidate(self, handover: Handover, now: float) -> TileStream:
        return self._stream(handover.candidate(self._next, self._streaming(), now))

    def _capture(self, handover: Handover, index: int, now: float) -> None:
        before = handover.current
        served, cause = handover.choose(index, self._streaming(), now)
        if cause is not None:
            self._observer.handed_over(served, cause)
            if before in self._streams and before is not None:
                self._streams[before].withdraw()
                self._streams[before].close()  # or its server would go on showing the vehicle
        client = self._stream(served).client
        self._schedule.limit(0.0 if client is None else client.rate_limit_hz)
        if client is not None:
            client.capture(index)
        self._next = index + 1

    # --- streams

    def _hold_streams(self, handover: Handover, now: float) -> None:
        """Open what is wanted, prepare what lies ahead, and close the rest."""
        streams = self._streams.items()
        handover.draining = frozenset(tile for tile, stream in streams if stream.is_draining)
        wanted = handover.wanted(self._next, self._streaming(), now)
        ahead = handover.route.ahead(self._next, self._pictures(AHEAD_S, AHEAD_PICTURES))
        for served in wanted:
            self._stream(served).open(now)
        if self._streaming():
            for served in ahead[:2]:
                self._stream(served).prepare(now)
        for served, stream in tuple(self._streams.items()):
            if served not in wanted:
                stream.close()
                if served not in ahead and not stream.tasks:
                    del self._streams[served]

    def _stream(self, served: ServedTile) -> TileStream:
        if served not in self._streams:
            self._streams[served] = TileStream(served, self._prepare, self, self._changed)
        return self._streams[served]

    def _streaming(self) -> frozenset[ServedTile]:
        streams = self._streams.items()
        return frozenset(served for served, stream in streams if stream.is_streaming)

    def _collect(self, now: float) -> None:
        """Note streams that ended: tried again, unless the error ends the drive."""
        if self._streaming():
            self._streaming_at_s = now
        for stream in self._streams.values():
            error = stream.collect()
            if error is None:
                continue
            if self._is_final(error, now):
                raise error
            pause_s = stream.hold_back(now)
            self._observer.retrying(_retry_reason(error))
            log.warning(
                "stream given up for now",
                tile=stream.served.tile.name,
                problem=str(error),
                again_in_s=round(pause_s, 2),
            )

    def _is_final(self, error: BaseException, now: float) -> bool:
        """Return whether ``error`` ends the drive.

        It does if another agent sends the camera, or no server has taken the vehicle for as long as
        it may. What says that the vehicle was set up wrongly ends it only at the start: once a
        server has welcomed it, the same words are about the server, which can change again.
        """
        if isinstance(error, CameraTaken) or not isinstance(error, RfedgeError):
            return True
        limit_s = self._config.limits.give_up_s or math.inf
        if now - self._streaming_at_s >= limit_s:
            return True
        is_transport = type(error) is RfedgeError
        return not (self._was_welcomed or is_transport or len(self._streams) > 1)

    async def _rest(self, now: float) -> None:
        due = [now + POLL_S]
        timer = self._schedule.get_timer()
        if timer is not None:
            due.append(max(timer, now + SHORTEST_REST_S))
        with suppress(TimeoutError):
            async with asyncio.timeout(max(0.0, min(due) - now)):
                await self._changed.wait()
        self._changed.clear()

    async def _finish(self) -> None:
        """Let every stream finish what it has taken."""
        for stream in self._streams.values():
            stream.close()
        closing = (stream.wait_closed() for stream in self._streams.values())
        for result in await asyncio.gather(*closing, return_exceptions=True):
            if isinstance(result, BaseException):
                raise result

    def _pictures(self, seconds: float, in_lockstep: int) -> int:
        if self._config.pace is PaceKind.LOCKSTEP:
            return in_lockstep
        return max(in_lockstep, math.ceil(seconds * self._config.rate))


def _retry_reason(error: BaseException) -> RetryReason:
    if isinstance(error, FieldNotServed):
        return RetryReason.FIELD_GONE
    return RetryReason.REFUSED if isinstance(error, ProtocolError) else RetryReason.FIELD


class TileStream:
    """A tile's stream: prepared, open, or closed; ``retry_at_s`` holds both back after an error."""

    def __init__(
        self,
        served: ServedTile,
        prepare: PrepareStream,
        owner: StreamOwner,
        changed: asyncio.Event,
    ) -> None:
        self.served = served
        self.retry_at_s = 0.0
        self.client: StreamClient | None = None
        """Takes the pictures; None while none is open, or the last one is closing."""
        self._prepare = prepare
        self._owner = owner
        self._changed = changed
        self._open: OpenStream | None = None
        self._preparing: asyncio.Task[OpenStream] | None = None
        self._successor: StreamClient | None = None
        self._running: dict[StreamClient, asyncio.Task[None]] = {}
        """Every client that was opened and not collected, with its task."""
        self._backoff = Backoff(FIRST_RETRY_S, LONGEST_RETRY_S)

    @property
    def is_streaming(self) -> bool:
        """Return whether the server has welcomed the vehicle and takes pictures."""
        return self.client is not None and self.client.is_streaming

    @property
    def is_draining(self) -> bool:
        """Return whether the server is draining: it takes pictures until another one does."""
        return self.client is not None and self.client.is_draining

    def waits_for(self, now: float) -> str:
        """Return what the stream waits for; "" for nothing, or for what was logged already."""
        if now < self.retry_at_s:
            return ""
        if self._open is None:
            return f"field {self.served.tile.field_id} of tile {self.served.tile.name}"
        return "" if self.client is None else self.client.waits_for

    @property
    def tasks(self) -> list[asyncio.Task[OpenStream] | asyncio.Task[None]]:
        """The tasks that have not been collected."""
        preparing = [] if self._preparing is None else [self._preparing]
        return [*preparing, *self._running.values()]

    def prepare(self, now: float) -> None:
        """Begin to fetch and open the field, unless that is done or going on."""
        if self._open is None and self._preparing is None and now >= self.retry_at_s:
            self._preparing = asyncio.create_task(self._run_prepare())
            self._preparing.add_done_callback(self._task_ended)

    def open(self, now: float) -> None:
        """Hold a stream to the server, as soon as the field is prepared."""
        self.prepare(now)
        if self._open is None or now < self.retry_at_s:
            return
        if self._running.keys() - {self.client, self._successor}:
            return  # one is closing
        if self.client is None:
            self.client = self._run(self._open)
        elif self.is_draining and self._successor is None:
            self._successor = self._run(self._open)

    def close(self) -> None:
        """Finish what was taken, then close the stream."""
        self.client = self._successor = None
        for client in self._running:
            client.finish()

    def stop(self) -> None:
        """Finish the frame in flight, drop what waits, then close the stream."""
        self.client = self._successor = None
        for client in self._running:
            client.stop()

    def withdraw(self) -> None:
        """Drop a picture that waits for a server which does not answer: another takes over."""
        if self.client is not None and not self.client.is_streaming:
            self.client.withdraw()

    async def wait_closed(self) -> None:
        """Wait until the stream has ended; raise the error with which it did."""
        for task in tuple(self._running.values()):
            await task

    def hold_back(self, now: float) -> float:
        """Try nothing for a while, since something failed; return for how many seconds."""
        pause_s = self._backoff.next_s()
        self.retry_at_s = now + pause_s
        return pause_s

    def collect(self) -> BaseException | None:
        """Note the tasks that ended; return the error with which one did."""
        if self.is_streaming:
            self._backoff.reset()
        ended: list[asyncio.Task[OpenStream] | asyncio.Task[None]] = []
        if self._preparing is not None and self._preparing.done():
            ended.append(self._preparing)
            self._preparing = None
        for client, task in tuple(self._running.items()):
            if task.done():
                client.abandon("its stream was given up")
                ended.append(task)
                del self._running[client]
                self.client = None if client is self.client else self.client
                self._successor = None if client is self._successor else self._successor
        self._take_over()
        errors = (task.exception() for task in ended)
        return next((error for error in errors if error is not None), None)

    def _take_over(self) -> None:
        """Give the pictures to the successor once its server has welcomed the vehicle, or once the
        first stream has ended."""
        current, successor = self.client, self._successor
        if successor is None or not (successor.is_streaming or current is None):
            return
        if current is not None:
            current.finish()
        self.client, self._successor = successor, None

    def _run(self, open_stream: OpenStream) -> StreamClient:
        client = open_stream(self._owner)
        task = self._running[client] = asyncio.create_task(client.run())
        task.add_done_callback(self._task_ended)
        return client

    def _task_ended(self, _: asyncio.Task[Any]) -> None:
        self._changed.set()

    async def _run_prepare(self) -> OpenStream:
        self._open = await self._prepare(self.served)
        return self._open
