"""Worker threads for an event loop: work goes out piece by piece, outcomes come back together.

``loop.run_in_executor`` makes three futures for each piece, wakes the loop through a socket for
each outcome and needs a task to wait for it. Here outcomes gather in a queue, and the loop is woken
only if it has not been already; whoever asked is called back on the loop.
"""

from __future__ import annotations

import asyncio
import threading
from collections import deque
from collections.abc import Callable
from functools import partial
from queue import SimpleQueue
from typing import Any, TypeVar

__all__ = ["Workers"]

R = TypeVar("R")
Work = Callable[[], Any]
Done = Callable[[Any], None]


class Workers:
    """``count`` threads that work for one event loop, the one that submits first."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._threads: list[threading.Thread] = []
        self._waiting: SimpleQueue[tuple[Work, Done] | None] = SimpleQueue()
        self._finished: deque[Callable[[], None]] = deque()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._woken = False

    def submit(self, work: Callable[[], R], done: Callable[[R | Exception], None]) -> None:
        """Have ``work`` done on a thread; then, on the loop, ``done`` is given what it returned or
        raised. Begun in the order of asking."""
        if self._loop is None:
            self._start(asyncio.get_running_loop())
        self._waiting.put((work, done))

    def close(self) -> None:
        """Do what was asked for, then end the threads; waits for them."""
        for _ in self._threads:
            self._waiting.put(None)
        for thread in self._threads:
            thread.join()

    def _start(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        for number in range(self._count):
            thread = threading.Thread(
                target=self._run, args=(loop,), name=f"worker_{number}", daemon=True
            )
            thread.start()
            self._threads.append(thread)

    def _run(self, loop: asyncio.AbstractEventLoop) -> None:
        while (asked := self._waiting.get()) is not None:
            work, done = asked
            self._finished.append(partial(done, _outcome(work)))
            if not self._woken:  # after appending: ``_deliver`` clears it before it looks
                self._woken = True
                loop.call_soon_threadsafe(self._deliver)

    def _deliver(self) -> None:
        self._woken = False
        while self._finished:
            self._finished.popleft()()


def _outcome(work: Callable[[], R]) -> R | Exception:
    try:
        return work()
    except Exception as error:
        return error
