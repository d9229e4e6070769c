"""Worker threads that serve their owners in turn, tasks that outlive errors, and cheap deadlines.

``loop.run_in_executor`` makes three futures for each piece of work, wakes the loop through a socket
for each outcome and needs a task to wait for it: too much for each frame. ``Workers`` gathers
outcomes in a queue, wakes the loop only if it has not been woken already, and calls back on the
loop. ``LazyTimer`` is a timer that is restarted with every message.
"""

from __future__ import annotations

import asyncio
import os
import threading
from collections import Counter, OrderedDict, deque
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import count as count_up
from queue import SimpleQueue
from typing import Any, Generic, TypeVar

R = TypeVar("R")
T = TypeVar("T")
Work = Callable[[], Any]
Done = Callable[[Any], None]

BACKGROUND_NICE = 10
"""Niceness of threads whose work can wait: beside busy ones they get a tenth of a processor."""

MAX_SUBSTITUTES = 16
"""Most threads that work in place of waiting ones."""


class FairQueue(Generic[T]):
    """A queue that takes items of several owners in turn: one of each owner that has any, again and
    again.

    An owner's items keep their order. An owner that has no item waiting gets a turn after at most
    one item of each other owner, however many those have. Sans-IO and not thread-safe.
    """

    def __init__(self) -> None:
        self._waiting: OrderedDict[str, deque[T]] = OrderedDict()

    def __bool__(self) -> bool:
        return bool(self._waiting)

    def put(self, owner: str, item: T) -> None:
        """Add ``item`` behind the other items of ``owner``."""
        self._waiting.setdefault(owner, deque()).append(item)

    def take(self, may: Callable[[str], bool] = lambda _: True) -> T:
        """Remove and return the item whose turn it is, of the owners that ``may`` have one.

        Raises ``IndexError`` if there is none.
        """
        owner = next((owner for owner in self._waiting if may(owner)), None)
        if owner is None:
            raise IndexError("take from a queue without an item that may be taken")
        items = self._waiting.pop(owner)
        item = items.popleft()
        if items:
            self._waiting[owner] = items
        return item


class Workers:
    """``count`` threads that work for one event loop: the one from which work is submitted.

    ``callback_failed`` is called on the loop with what a ``done`` raised; the others still run.
    While ``crowded``, no owner keeps more than all threads but one busy: work cannot be
    interrupted, and a thread is to be there for the others when one's pieces take long. Each thread
    calls ``begin`` first, for its priority (``give_way``, ``work_when_idle``).
    """

    def __init__(
        self,
        count: int,
        callback_failed: Callable[[Exception], None],
        name: str = "worker",
        crowded: Callable[[], bool] = lambda: False,
        begin: Callable[[], object] = lambda: None,
    ) -> None:
        self.count = count
        self._begin = begin
        self._callback_failed = callback_failed
        self._name = name
        self._threads: list[threading.Thread] = []
        self._numbers = count_up()
        self._substitutes = 0
        self._crowded = crowded
        self._closing = False
        self._waiting: FairQueue[tuple[str, Work, Done]] = FairQueue()
        self._in_work: Counter[str] = Counter()
        self._deferred = 0
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
            self._waiting.put(owner, (owner, work, done))
        self._permits.put(True)

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """Let another thread work while the block waits for something outside of this process.

        Without effect on a thread that is none of these, and where ``MAX_SUBSTITUTES`` work
        already: then the block holds its worker.
        """
        if threading.current_thread() not in self._threads or not self._substitute():
            yield
            return
        try:
            yield
        finally:
            self._permits.put(False)  # ends whichever thread gets to it first
            with self._lock:
                self._substitutes -= 1

    @property
    def has_room(self) -> bool:
        """Whether a thread is free, and no work waits for one."""
        with self._lock:
            return not self._waiting and self._in_work.total() < self.count

    def close(self) -> None:
        """Finish the work that was submitted, then end the threads; waits for them."""
        with self._lock:
            self._closing = True
        self._resume_deferred()
        for _ in range(self.count):
            self._permits.put(False)
        for thread in self._threads:
            thread.join()

    def _substitute(self) -> bool:
        with self._lock:
            if self._substitutes >= MAX_SUBSTITUTES or self._loop is None:
                return False
            self._substitutes += 1
            self._threads = [thread for thread in self._threads if thread.is_alive()]
            self._start_thread(self._loop)
        return True

    def _start(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        for _ in range(self.count):
            self._start_thread(loop)

    def _start_thread(self, loop: asyncio.AbstractEventLoop) -> None:
        thread = threading.Thread(
            target=self._run, args=(loop,), name=f"{self._name}_{next(self._numbers)}", daemon=True
        )
        thread.start()
        self._threads.append(thread)

    def _run(self, loop: asyncio.AbstractEventLoop) -> None:
        self._begin()
        while self._permits.get():
            self._work_next(loop)

    def _may_begin(self, owner: str) -> bool:
        most = max(1, self.count - 1)
        return self._in_work[owner] < most or self._closing or not self._crowded()

    def _work_next(self, loop: asyncio.AbstractEventLoop) -> None:
        """Do the next piece of work of an owner that may begin one.

        What may not begin yet gets another permit when a piece of work ends.
        """
        with self._lock:
            try:
                owner, work, done = self._waiting.take(self._may_begin)
            except IndexError:
                self._deferred += 1
                return
            self._in_work[owner] += 1
        self._finished.append(partial(done, _outcome(work)))
        with self._lock:
            self._in_work -= Counter((owner,))  # drops those that reach zero
        self._resume_deferred()
        if not self._woken:  # after appending: ``_deliver`` clears it before it looks
            self._woken = True
            loop.call_soon_threadsafe(self._deliver)

    def _resume_deferred(self) -> None:
        with self._lock:
            deferred, self._deferred = self._deferred, 0
        for _ in range(deferred):
            self._permits.put(True)

    def _deliver(self) -> None:
        self._woken = False
        while self._finished:
            done = self._finished.popleft()
            try:
                done()
            except Exception as error:
                self._callback_failed(error)


async def on_every_thread(
    pools: Sequence[Workers], work: Callable[[], object], within_s: float
) -> None:
    """Do ``work`` once on each thread of ``pools``, on all of them at the same time.

    Raises what it raised, and ``threading.BrokenBarrierError`` if one is not free ``within_s``.
    """
    together = threading.Barrier(sum(pool.count for pool in pools), timeout=within_s)

    def begin() -> object:
        together.wait()
        return work()

    async def done(pool: Workers, owner: str) -> None:
        outcome: asyncio.Future[object] = asyncio.get_running_loop().create_future()
        pool.submit(owner, begin, outcome.set_result)
        if isinstance(raised := await outcome, Exception):
            raise raised

    owners = ((pool, f"thread {number}") for pool in pools for number in range(pool.count))
    await asyncio.gather(*(done(*owner) for owner in owners))


def _outcome(work: Callable[[], R]) -> R | Exception:
    try:
        return work()
    except Exception as error:
        return error


def give_way(nice: int) -> None:
    """Lower the priority of the calling thread, where processors are scarce (setpriority(2))."""
    thread = threading.get_native_id()
    before = os.getpriority(os.PRIO_PROCESS, thread)
    os.setpriority(os.PRIO_PROCESS, thread, before + nice)  # kept in range there


def work_when_idle() -> None:
    """Let the calling thread, and what it starts, work only while a processor is idle.

    Sets SCHED_IDLE, see sched(7). The lowest nice value is not enough: beside four vehicles it took
    the p99 of decoding from 58 to 78 ms, SCHED_IDLE to 62.
    """
    os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))


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
