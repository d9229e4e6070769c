"""The drive itself: captures pictures in time and gives each to the stream of its tile.

One loop asks ``cav_agent.capture_schedule`` which picture is due and ``cav_agent.handover`` which
tile takes it, opens the next tile's stream before it is needed and closes the last one's when it is
not. The next tile's field is fetched while the present one is in use, and stays prepared while its
tile lies ahead.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress

import structlog

from cav_agent.capture_schedule import CaptureSchedule, Lockstep, Realtime
from cav_agent.client import CameraTaken, FieldNotServed
from cav_agent.config import AgentConfig, PaceKind
from cav_agent.frame_log import DriveObserver
from cav_agent.frames import FrameResult, RetryReason
from cav_agent.handover import LOST_AFTER_S, Handover, Position, ServedTile, TileRoute
from cav_agent.tile_stream import PrepareStream, TileStream
from rfcore.errors import ProtocolError, RfedgeError
from rfcore.wire.notices import StreetNotice

__all__ = ["HandoverController"]

log = structlog.get_logger()

NEAR_S, NEAR_PICTURES = 2.0, 3
"""How long before a border the next stream is opened; in lockstep, how many pictures."""

AHEAD_S, AHEAD_PICTURES = 30.0, 30
"""How long before a border the next field is fetched; in lockstep, how many pictures."""

SHORTEST_REST_S = 0.001
POLL_S = 0.25
"""A stream that opens or breaks between two pictures is noticed within this time."""


class HandoverController:
    """Drives along ``positions`` across the tiles that ``tiles_published`` names.

    It is the ``StreamObserver`` of every stream: each result passes here once, is counted, and goes
    on to the schedule and to ``observer``.
    """

    def __init__(
        self,
        config: AgentConfig,
        positions: Sequence[Position],
        prepare: PrepareStream,
        observer: DriveObserver,
        schedule: CaptureSchedule | None = None,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._config = config
        self._positions = tuple(positions)
        self._prepare = prepare
        self._observer = observer
        self._schedule = schedule or _schedule(config, len(positions))
        self._tiles: dict[int, tuple[ServedTile, ...]] = {}
        self._streams: dict[ServedTile, TileStream] = {}
        self._handover: Handover | None = None
        self._next = 0
        self._changed = asyncio.Event()
        self._stopping = False
        self._was_welcomed = False
        self._failed: RfedgeError | None = None
        self._began_s = self._streaming_at_s = time.monotonic()

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

    def picture_arrived(self) -> None:
        """Look at the schedule: a live camera has a new picture, or has ended."""
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
        self._observer.ended(result)
        try:
            self._schedule.ended(result)
        except RfedgeError as error:
            self._failed = error
        self._changed.set()

    def connected(self, is_connected: bool) -> None:
        """Pass on that a server welcomed the vehicle, or that its stream was lost."""
        self._was_welcomed = self._was_welcomed or is_connected
        self._observer.connected(is_connected)

    def retrying(self, reason: RetryReason) -> None:
        """Pass on that something is tried again."""
        self._observer.retrying(reason)

    def noticed(self, notice: StreetNotice) -> None:
        """Pass on what a server tells of the street."""
        self._observer.noticed(notice)

    def message_unknown(self) -> None:
        """Pass on that a server sent something unknown."""
        self._observer.message_unknown()

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
        stream = self._stream(served)
        self._schedule.limit(0.0 if stream.client is None else stream.client.rate_limit_hz)
        stream.capture(index)
        self._next = index + 1

    # --- streams

    def _hold_streams(self, handover: Handover, now: float) -> None:
        """Open what is wanted, prepare what lies ahead, and close the rest."""
        streams = self._streams.items()
        handover.draining = frozenset(tile for tile, stream in streams if stream.is_sent_away)
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
            self._streams[served] = TileStream(served, self._prepare, self)
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


def _schedule(config: AgentConfig, pictures: int) -> CaptureSchedule:
    if config.pace is PaceKind.LOCKSTEP:
        return Lockstep(pictures, loop=config.loop)
    return Realtime(pictures, config.rate, loop=config.loop)
