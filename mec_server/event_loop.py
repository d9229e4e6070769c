"""What asyncio does at too high a cost per frame: worker threads, and deadlines that keep moving.

``loop.run_in_executor`` makes three futures for each piece of work, wakes the loop through a socket
for each outcome and needs a task to wait for it. ``Workers`` gathers outcomes in a queue, wakes the
loop only if it has not been woken already, and calls back on the loop. ``LazyTimer`` is a timer
that is restarted with every message.
"""

from __future__ import annotations

import asyncio
import threading
from collections import deque
from collections.abc import Callable
from functools import partial
from queue import SimpleQueue
from typing import Any, TypeVar

__all__ = ["LazyTimer", "Workers"]

R = TypeVar("R")
Work = Callable[[], Any]
Done = Callable[[Any], None]


class Workers:
    """``count`` threads that work for one event loop: the one from which work is submitted."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._threads: list[threading.Thread] = []
        self._waiting: SimpleQueue[tuple[Work, Done] | None] = SimpleQueue()
        self._finished: deque[Callable[[], None]] = deque()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._woken = False

    def submit(self, work: Callable[[], R], done: Callable[[R | Exception], None]) -> None:
        """Run ``work`` on a thread, then call ``done`` on the loop with what it returned or raised.

        Work begins in the order in which it was submitted.
        """
        if self._loop is None:
            self._start(asyncio.get_running_loop())
        self._waiting.put((work, done))

    def close(self) -> None:
        """Finish the work that was submitted, then end the threads; waits for them."""
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


class LazyTimer:
    """Resettable timer: restarts its deadline without rescheduling the event-loop callback.

    Sets ``event`` by the deadline at the latest. A deadline that moves later keeps the callback of
    the earlier one, so the event may be set too early and its waiter has to look at the time. That
    costs one needless wake-up per deadline instead of two calls of the event loop per message.
    """

    def __init__(self, event: asyncio.Event) -> None:
        self._event = event
        self._callback: asyncio.TimerHandle | None = None

    def restart(self, deadline_s: float | None) -> None:
        """Have the event set by ``deadline_s`` (the loop's clock); None: cancel."""
        if deadline_s is None:
            self.cancel()
        elif self._callback is None or deadline_s < self._callback.when():
            self.cancel()
            self._callback = asyncio.get_running_loop().call_at(deadline_s, self._expire)

    def cancel(self) -> None:
        """Do not set the event."""
        if self._callback is not None:
            self._callback.cancel()
            self._callback = None

    def _expire(self) -> None:
        self._callback = None
        self._event.set()
