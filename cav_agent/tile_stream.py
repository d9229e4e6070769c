"""One tile on the vehicle's way: its field prepared, and a stream to its server while wanted.

``cav_agent.handover_controller`` holds one per tile and gives it the pictures that the tile takes.
A stream that is closed first finishes what it has taken.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

from cav_agent.backoff import Backoff
from cav_agent.client import StreamClient, StreamObserver
from cav_agent.handover import ServedTile

__all__ = ["OpenStream", "PrepareStream", "TileStream"]

OpenStream = Callable[[StreamObserver], StreamClient]
"""Returns a client for a new stream to a tile that was prepared."""

PrepareStream = Callable[[ServedTile], Awaitable[OpenStream]]
"""Fetches and opens a tile's field; returns how to open streams with it."""

FIRST_RETRY_S, LONGEST_RETRY_S = 1.0, 30.0
"""Until a stream that failed is opened again: longer with every failure in a row."""


class TileStream:
    """A tile's stream: prepared, open, or closed; ``retry_at_s`` holds both back after an error."""

    def __init__(
        self, served: ServedTile, prepare: PrepareStream, observer: StreamObserver
    ) -> None:
        self.served = served
        self.retry_at_s = 0.0
        self.client: StreamClient | None = None
        self._prepare = prepare
        self._observer = observer
        self._open: OpenStream | None = None
        self._preparing: asyncio.Task[OpenStream] | None = None
        self._running: asyncio.Task[None] | None = None
        self._backoff = Backoff(FIRST_RETRY_S, LONGEST_RETRY_S)

    @property
    def is_streaming(self) -> bool:
        """Whether the server has welcomed the vehicle and takes pictures."""
        return self.client is not None and self.client.is_streaming

    @property
    def tasks(self) -> list[asyncio.Task[OpenStream] | asyncio.Task[None]]:
        """The tasks that have not been collected."""
        return [task for task in (self._preparing, self._running) if task is not None]

    def prepare(self, now: float) -> None:
        """Begin to fetch and open the field, unless that is done or going on."""
        if self._open is None and self._preparing is None and now >= self.retry_at_s:
            self._preparing = asyncio.create_task(self._run_prepare())

    def open(self, now: float) -> None:
        """Hold a stream to the server, as soon as the field is prepared."""
        self.prepare(now)
        if self._open is None or self._running is not None or now < self.retry_at_s:
            return
        self.client = self._open(self._observer)
        self._running = asyncio.create_task(self.client.run())

    def close(self) -> None:
        """Finish what was taken, then close the stream."""
        if self.client is not None:
            self.client.finish()

    def stop(self) -> None:
        """Finish the frame in flight, drop what waits, then close the stream."""
        if self.client is not None:
            self.client.stop()

    def capture(self, index: int) -> None:
        """Take picture ``index`` of the drive now."""
        if self.client is not None:
            self.client.capture(index)

    def withdraw(self) -> None:
        """Let a picture go that waits for a server which does not answer: another takes over."""
        if self.client is not None and not self.client.is_streaming:
            self.client.withdraw()

    async def wait_closed(self) -> None:
        """Wait until the stream has ended; raise the error with which it did."""
        if self._running is not None:
            await self._running

    def hold_back(self, now: float) -> float:
        """Try nothing for a while, since something failed; return for how many seconds."""
        pause_s = self._backoff.next_s()
        self.retry_at_s = now + pause_s
        return pause_s

    def collect(self) -> BaseException | None:
        """Take note of tasks that ended; return the error with which one did."""
        error = None
        if self.is_streaming:
            self._backoff.reset()
        if self._preparing is not None and self._preparing.done():
            error = self._preparing.exception()
            self._preparing = None
        if self._running is not None and self._running.done():
            error = error or self._running.exception()
            client, self._running, self.client = self.client, None, None
            if client is not None:
                client.abandon("its stream was given up")
        return error

    async def _run_prepare(self) -> OpenStream:
        self._open = await self._prepare(self.served)
        return self._open
