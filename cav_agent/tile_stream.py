"""One stop of a trip: its field made ready, and a stream to its server while one is wanted.

The trip hands pictures over through the leg's ``AssignedCaptures``; everything else about a stream
is the agent's. A leg that is let go finishes what it has taken, and closes its stream.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from cav_agent.client import Agent
from cav_agent.frames import Capture, FrameResult, Outcome
from cav_agent.handover import Stop
from cav_agent.session import LinkState
from rfcore.views import PosedPicture

__all__ = ["AssignedCaptures", "Ready", "TileStream"]


class AssignedCaptures:
    """The pictures that the trip gives one leg; a ``cav_agent.capture_schedule.Pace``."""

    def __init__(self, ended: Callable[[FrameResult], None]) -> None:
        self.closed = False
        self.limit_hz = 0.0
        self._given: deque[int] = deque()
        self._unended: dict[int, int] = {}
        self._ended = ended

    def give(self, index: int) -> None:
        """Have picture ``index`` captured now."""
        self._given.append(index)
        self._unended[index] = self._unended.get(index, 0) + 1

    def next_capture(self, now: float) -> int | None:  # noqa: ARG002
        """Return, once, a picture that was given."""
        return self._given.popleft() if self._given else None

    def ended(self, result: FrameResult) -> None:
        """Pass on how a picture ended."""
        index = result.capture.index
        self._unended[index] = self._unended.get(index, 0) - 1
        if self._unended[index] <= 0:
            del self._unended[index]
        self._ended(result)

    def abandon(self, pictures: tuple[PosedPicture, ...], reason: str, now: float) -> None:
        """End what the leg took and will not finish."""
        for index, count in list(self._unended.items()):
            capture = Capture(index, pictures[index], now, time.time_ns())
            for _ in range(count):
                self.ended(FrameResult(capture, Outcome.LOST, reason))
        self._given.clear()

    def limit(self, rate_hz: float) -> None:
        """Note what the leg's server lets us send a second; it holds while the leg is in charge."""
        self.limit_hz = rate_hz

    @property
    def finished(self) -> bool:
        """Whether no further picture will come."""
        return self.closed and not self._given

    def get_timer(self) -> float | None:
        """Return None: the trip looks at the time."""
        return None


@dataclass(frozen=True)
class Ready:
    """What a leg drives with: its pictures, posed for its tile, and how to make its agent."""

    pictures: tuple[PosedPicture, ...]
    agent: Callable[[AssignedCaptures], Agent]


class TileStream:
    """One stop; ``prepare`` fetches and opens its field."""

    def __init__(
        self,
        stop: Stop,
        prepare: Callable[[Stop], Awaitable[Ready]],
        ended: Callable[[FrameResult], None],
    ) -> None:
        self.stop = stop
        self.retry_at_s = 0.0
        self.ready: Ready | None = None
        self.agent: Agent | None = None
        self.pace = AssignedCaptures(ended)
        self._prepare = prepare
        self._ended = ended
        self._preparing: asyncio.Task[Ready] | None = None
        self._driving: asyncio.Task[None] | None = None

    @property
    def is_streaming(self) -> bool:
        """Whether the server has welcomed us and a picture can be given."""
        agent = self.agent
        return agent is not None and not self.pace.closed and agent.state is LinkState.STREAMING

    @property
    def tasks(self) -> list[asyncio.Task[Ready] | asyncio.Task[None]]:
        """What goes on."""
        return [task for task in (self._preparing, self._driving) if task is not None]

    def make_ready(self, now: float) -> None:
        """Begin to fetch and open the field, unless that is done or going on."""
        if self.ready is None and self._preparing is None and now >= self.retry_at_s:
            self._preparing = asyncio.create_task(self._run_prepare())

    def open(self, now: float) -> None:
        """Hold a stream to the server, as soon as the field is there."""
        self.make_ready(now)
        if self.ready is None or self._driving is not None or now < self.retry_at_s:
            return
        self.pace = AssignedCaptures(self._ended)
        self.agent = self.ready.agent(self.pace)
        self._driving = asyncio.create_task(self.agent.run())

    def close(self) -> None:
        """Finish what was taken, then close the stream."""
        if self.agent is not None:
            self.pace.closed = True
            self.agent.wake()

    def give(self, index: int) -> None:
        """Take a picture."""
        if self.agent is None:
            return
        self.pace.give(index)
        self.agent.wake()

    def withdraw(self) -> None:
        """Let a picture go that waits for a server which does not answer: another takes over."""
        if self.agent is not None and not self.is_streaming:
            self.agent.withdraw()

    def collect(self, now: float) -> BaseException | None:
        """Take note of what ended; return the error with which it did."""
        error = None
        if self._preparing is not None and self._preparing.done():
            error = self._preparing.exception()
            self._preparing = None
        if self._driving is not None and self._driving.done():
            error = error or self._driving.exception()
            self._driving, self.agent = None, None
            if self.ready is not None:
                self.pace.abandon(self.ready.pictures, "the leg was given up", now)
        return error

    async def _run_prepare(self) -> Ready:
        self.ready = await self._prepare(self.stop)
        return self.ready
