"""One tile on the vehicle's way: its field prepared, and a stream to its server while wanted.

``cav_agent.handover_controller`` holds one per tile and gives it the pictures that the tile takes.
A stream that is closed first finishes what it has taken. Where the server asks to be left, a second
stream to the same address is opened beside the first: a proxy places it on another server, which
takes over as soon as it has welcomed the vehicle.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

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


@dataclass(frozen=True)
class RunningClient:
    """A client and the task in which it runs."""

    client: StreamClient
    task: asyncio.Task[None]


class TileStream:
    """A tile's stream: prepared, open, or closed; ``retry_at_s`` holds both back after an error."""

    def __init__(
        self, served: ServedTile, prepare: PrepareStream, observer: StreamObserver
    ) -> None:
        self.served = served
        self.retry_at_s = 0.0
        self._prepare = prepare
        self._observer = observer
        self._open: OpenStream | None = None
        self._preparing: asyncio.Task[OpenStream] | None = None
        self._current: RunningClient | None = None
        self._successor: RunningClient | None = None
        self._closing: list[RunningClient] = []
        self._backoff = Backoff(FIRST_RETRY_S, LONGEST_RETRY_S)

    @property
    def client(self) -> StreamClient | None:
        """The client that takes pictures; None while none is open, or the last one is closing."""
        return None if self._current is None else self._current.client

    @property
    def is_streaming(self) -> bool:
        """Whether the server has welcomed the vehicle and takes pictures."""
        return self.client is not None and self.client.is_streaming

    @property
    def is_sent_away(self) -> bool:
        """Whether the server is about to stop, and takes pictures until another one does."""
        return self.client is not None and self.client.is_sent_away

    @property
    def tasks(self) -> list[asyncio.Task[OpenStream] | asyncio.Task[None]]:
        """The tasks that have not been collected."""
        preparing = [] if self._preparing is None else [self._preparing]
        return [*preparing, *(running.task for running in self._running())]

    def prepare(self, now: float) -> None:
        """Begin to fetch and open the field, unless that is done or going on."""
        if self._open is None and self._preparing is None and now >= self.retry_at_s:
            self._preparing = asyncio.create_task(self._run_prepare())

    def open(self, now: float) -> None:
        """Hold a stream to the server, as soon as the field is prepared."""
        self.prepare(now)
        if self._open is None or now < self.retry_at_s:
            return
        if self._closing:
            return
        if self._current is None:
            self._current = self._run(self._open)
        elif self.is_sent_away and self._successor is None:
            self._successor = self._run(self._open)

    def close(self) -> None:
        """Finish what was taken, then close the stream."""
        self._closing = self._running()
        self._current = self._successor = None
        for running in self._closing:
            running.client.finish()

    def stop(self) -> None:
        """Finish the frame in flight, drop what waits, then close the stream."""
        for running in self._running():
            running.client.stop()
        self.close()

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
        for running in self._running():
            await running.task

    def hold_back(self, now: float) -> float:
        """Try nothing for a while, since something failed; return for how many seconds."""
        pause_s = self._backoff.next_s()
        self.retry_at_s = now + pause_s
        return pause_s

    def collect(self) -> BaseException | None:
        """Take note of tasks that ended; return the error with which one did."""
        if self.is_streaming:
            self._backoff.reset()
        ended: list[asyncio.Task[OpenStream] | asyncio.Task[None]] = []
        if self._preparing is not None and self._preparing.done():
            ended.append(self._preparing)
            self._preparing = None
        for running in self._running():
            if running.task.done():
                running.client.abandon("its stream was given up")
                ended.append(running.task)
                self._forget(running)
        self._take_over()
        errors = (task.exception() for task in ended)
        return next((error for error in errors if error is not None), None)

    def _take_over(self) -> None:
        """Give the pictures to the successor once its server has welcomed the vehicle, or once the
        first stream has ended."""
        current, successor = self._current, self._successor
        if successor is None or not (successor.client.is_streaming or current is None):
            return
        if current is not None:
            current.client.finish()
            self._closing.append(current)
        self._current, self._successor = successor, None

    def _running(self) -> list[RunningClient]:
        open_clients = (self._current, self._successor)
        return [*self._closing, *(running for running in open_clients if running is not None)]

    def _forget(self, ended: RunningClient) -> None:
        if ended is self._current:
            self._current = None
        elif ended is self._successor:
            self._successor = None
        else:
            self._closing.remove(ended)

    def _run(self, open_stream: OpenStream) -> RunningClient:
        client = open_stream(self._observer)
        return RunningClient(client, asyncio.create_task(client.run()))

    async def _run_prepare(self) -> OpenStream:
        self._open = await self._prepare(self.served)
        return self._open
