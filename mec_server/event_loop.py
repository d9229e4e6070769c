"""Worker threads that serve their owners in turn, tasks that outlive errors, and cheap deadlines.

``loop.run_in_executor`` makes three futures for each piece of work, wakes the loop through a socket
for each outcome and needs a task to wait for it: too much for each frame. ``Workers`` gathers
outcomes in a queue, wakes the loop only if it has not been woken already, and calls back on the
loop. ``LazyTimer`` is a timer that is restarted with every message.
"""

from __future__ import annotations

import asyncio
import threading
from collections import OrderedDict, deque
from collections.abc import Awaitable, Callable
from functools import partial
from queue import SimpleQueue
from typing import Any, Generic, TypeVar

__all__ = ["FairQueue", "LazyTimer", "Workers", "repeat_forever"]

R = TypeVar("R")
T = TypeVar("T")
Work = Callable[[], Any]
Done = Callable[[Any], None]


class FairQueue(Generic[T]):
    """Items of several owners, taken in turn: one of each owner that has any, again and again.

    An owner's items keep their order. Whoever has no item waiting gets a turn after at most one
    item of each other owner, however many those have. Sans-IO and not thread-safe.
    """

    def __init__(self) -> None:
        self._waiting: OrderedDict[str, deque[T]] = OrderedDict()

    def put(self, owner: str, item: T) -> None:
        """Add ``item`` behind the other items of ``owner``."""
        self._waiting.setdefault(owner, deque()).append(item)

    def take(self) -> T:
        """Remove and return the item whose turn it is; raise ``IndexError`` if there is none."""
        if not self._waiting:
            raise IndexError("take from an empty queue")
        owner, items = self._waiting.popitem(last=False)
        item = items.popleft()
        if items:
            self._waiting[owner] = items
        return item


class Workers:
    """``count`` threads that work for one event loop: the one from which work is submitted.

    ``callback_failed`` is called on the loop with what a ``done`` raised; the others still run.
    """

    def __init__(
        self, count: int, callback_failed: Callable[[Exception], None], name: str = "worker"
    ) -> None:
        self._count = count
        self._callback_failed = callback_failed
        self._name = name
        self._threads: list[threading.Thread] = []
        self._waiting: FairQueue[tuple[Work, Done]] = FairQueue()
        self._lock = threading.Lock()
        self._permits: SimpleQueue[bool] = SimpleQueue()
        """True for each piece of work that waits, then False for each thread that is to end."""
        self._finished: deque[Callable[[], None]] = deque()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._woken = False

    def submit(
        self, owner: str, work: Callable[[], R], done: Callable[[R | Exception], None]
    ) -> None:
        """Run ``work`` on a thread, then call ``done`` on the loop with what it returned or raised.

        Owners take turns: work of one that has a long queue delays work of another by one piece
        at most, beside what has begun. The work of one owner begins in the order of submission.
        """
        if self._loop is None:
            self._start(asyncio.get_running_loop())
        with self._lock:
            self._waiting.put(owner, (work, done))
        self._permits.put(True)

    def close(self) -> None:
        """Finish the work that was submitted, then end the threads; waits for them."""
        for _ in self._threads:
            self._permits.put(False)
        for thread in self._threads:
            thread.join()

    def _start(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        for number in range(self._count):
            thread = threading.Thread(
                target=self._run, args=(loop,), name=f"{self._name}_{number}", daemon=True
            )
            thread.start()
            self._threads.append(thread)

    def _run(self, loop: asyncio.AbstractEventLoop) -> None:
        while self._permits.get():
            with self._lock:
                work, done = self._waiting.take()
            self._finished.append(partial(done, _outcome(work)))
            if not self._woken:  # after appending: ``_deliver`` clears it before it looks
                self._woken = True
                loop.call_soon_threadsafe(self._deliver)

    def _deliver(self) -> None:
        self._woken = False
        while self._finished:
            done = self._finished.popleft()
            try:
                done()
            except Exception as error:
                self._callback_failed(error)


def _outcome(work: Callable[[], R]) -> R | Exception:
    try:
        return work()
    except Exception as error:
        return error


async def repeat_forever(
    work: Callable[[], Awaitable[object]], every_s: float, failed: Callable[[Exception], None]
) -> None:
    """Do ``work`` every ``every_s`` seconds; one that raises is reported to ``failed``, and the
    next one is done as planned."""
    while True:
        await asyncio.sleep(every_s)
        try:
            await work()
        except Exception as error:
            failed(error)


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
