"""A drive past one server or several: each picture goes to the stop whose ground it was taken on.

One loop captures (by the pace), gives pictures to legs (by ``cav_agent.handover``), opens the next
leg before it is needed and closes the last one when it is not. The next tile's field is fetched
while the present one is in use; a leg that has been made ready stays so while it lies ahead.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import structlog

from cav_agent.capture_schedule import CaptureSchedule, Lockstep, Realtime
from cav_agent.config import AgentConfig, PaceKind
from cav_agent.frames import FrameResult
from cav_agent.handover import LOST_AFTER_S, Cause, Handover, Position, Route, Stop
from cav_agent.tile_stream import Ready, TileStream
from rfcore.errors import RfedgeError

__all__ = ["HandoverController", "Hooks"]

log = structlog.get_logger()

NEAR_S, NEAR_PICTURES = 2.0, 3
"""How long before a border the next stream is opened; in lockstep, how many pictures."""

AHEAD_S, AHEAD_PICTURES = 30.0, 30
"""How long before a border the next field is fetched."""

RETRY_S = 2.0
SHORTEST_REST_S = 0.001
LOOK_EVERY_S = 0.25
"""A stream that opens or breaks between two pictures is noticed so soon."""


@dataclass(frozen=True)
class Hooks:
    """``prepare`` makes a stop's leg ready; ``moved`` is told of every handover."""

    prepare: Callable[[Stop], Awaitable[Ready]]
    ended: Callable[[FrameResult], None]
    moved: Callable[[Stop, Cause], None]


class HandoverController:
    """Drives ``positions`` past the stops that ``found`` tells of."""

    def __init__(self, config: AgentConfig, positions: Sequence[Position], hooks: Hooks) -> None:
        self.counts: Counter[str] = Counter()
        self._config = config
        self._positions = tuple(positions)
        self._hooks = hooks
        self._pace = _pace(config, len(positions))
        self._stops: dict[int, tuple[Stop, ...]] = {}
        self._legs: dict[Stop, TileStream] = {}
        self._handover: Handover | None = None
        self._next = 0
        self._wake = asyncio.Event()
        self._stopping = False
        self._began_s = self._streaming_at_s = time.monotonic()

    def found(self, server: int, stops: Sequence[Stop]) -> None:
        """Follow what a server publishes now."""
        self._stops[server] = tuple(stops)
        every = [stop for number in sorted(self._stops) for stop in self._stops[number]]
        if not every:
            return
        route = Route(every, self._positions)
        if self._handover is None:
            self._handover = Handover(route, self._pictures(NEAR_S, NEAR_PICTURES))
        else:
            self._handover.follow(route)
        self._wake.set()

    def stop(self) -> None:
        """Capture no more; ``run`` ends when what is in flight was answered."""
        self._stopping = True
        for leg in self._legs.values():
            if leg.agent is not None:
                leg.agent.stop()
        self._wake.set()

    async def run(self) -> None:
        """Drive to the end; raise ``RfedgeError`` if that cannot be."""
        try:
            while not self._is_done():
                now = time.monotonic()
                self._collect(now)
                knows_home = 0 in self._stops or now - self._began_s >= LOST_AFTER_S
                if self._handover is not None and knows_home:
                    self._advance(self._handover, now)
                await self._rest(now)
            await self._finish()
        finally:
            tasks = [task for leg in self._legs.values() for task in leg.tasks]
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    def _is_done(self) -> bool:
        return self._stopping or self._pace.finished

    def _advance(self, handover: Handover, now: float) -> None:
        """Open and close legs, then give away the pictures that are due."""
        self._hold(handover, now)
        while self._leg(handover.taker(self._next, self._streaming(), now)).agent is not None:
            index = self._pace.next_capture(now)
            if index is None:
                return
            self._give(handover, index, now)

    def _give(self, handover: Handover, index: int, now: float) -> None:
        before = handover.in_charge
        stop, cause = handover.choose(index, self._streaming(), now)
        if cause is not None:
            self._hooks.moved(stop, cause)
            if before in self._legs and before is not None:
                self._legs[before].withdraw()
                self._legs[before].close()  # or its server would go on showing the vehicle
        leg = self._leg(stop)
        self._pace.limit(leg.pace.limit_hz)
        leg.give(index)
        self._next = index + 1

    def _hold(self, handover: Handover, now: float) -> None:
        wanted = handover.wanted(self._next, self._streaming(), now)
        ahead = handover.route.ahead(self._next, self._pictures(AHEAD_S, AHEAD_PICTURES))
        for stop in wanted:
            self._leg(stop).open(now)
        if self._streaming():
            for stop in ahead[:2]:
                self._leg(stop).make_ready(now)
        for stop, leg in tuple(self._legs.items()):
            if stop not in wanted:
                leg.close()
                if stop not in ahead and not leg.tasks:
                    del self._legs[stop]

    def _leg(self, stop: Stop) -> TileStream:
        if stop not in self._legs:
            self._legs[stop] = TileStream(stop, self._hooks.prepare, self._ended)
        return self._legs[stop]

    def _streaming(self) -> frozenset[Stop]:
        return frozenset(stop for stop, leg in self._legs.items() if leg.is_streaming)

    def _ended(self, result: FrameResult) -> None:
        self.counts[str(result.outcome)] += 1
        self._hooks.ended(result)
        self._pace.ended(result)
        self._wake.set()

    def _collect(self, now: float) -> None:
        """Learn of legs that ended; a trip ends with its only leg, or when nobody takes it."""
        if self._streaming():
            self._streaming_at_s = now
        limit_s = self._config.limits.give_up_s or math.inf
        is_over = now - self._streaming_at_s >= limit_s or len(self._legs) == 1
        for leg in self._legs.values():
            error = leg.collect(now)
            if error is None:
                continue
            if is_over or not isinstance(error, RfedgeError):
                raise error
            leg.retry_at_s = now + RETRY_S
            log.warning("leg given up for now", tile=leg.stop.tile.name, problem=str(error))

    async def _rest(self, now: float) -> None:
        due = [now + LOOK_EVERY_S]
        timer = self._pace.get_timer()
        if timer is not None:
            due.append(max(timer, now + SHORTEST_REST_S))
        with suppress(TimeoutError):
            async with asyncio.timeout(max(0.0, min(due) - now)):
                await self._wake.wait()
        self._wake.clear()

    async def _finish(self) -> None:
        """Let every leg finish what it has."""
        for leg in self._legs.values():
            leg.close()
        driving = [task for leg in self._legs.values() for task in leg.tasks[-1:] if leg.agent]
        for result in await asyncio.gather(*driving, return_exceptions=True):
            if isinstance(result, BaseException):
                raise result

    def _pictures(self, seconds: float, in_lockstep: int) -> int:
        if self._config.pace is PaceKind.LOCKSTEP:
            return in_lockstep
        return max(in_lockstep, math.ceil(seconds * self._config.rate))


def _pace(config: AgentConfig, pictures: int) -> CaptureSchedule:
    if config.pace is PaceKind.LOCKSTEP:
        return Lockstep(pictures, loop=config.loop)
    return Realtime(pictures, config.rate, loop=config.loop)
