"""Workers take turns among owners, bring every outcome back to the loop, and wake it once."""

import asyncio
import os
import threading
from collections import Counter, defaultdict
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack
from functools import partial
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mec_server import event_loop
from mec_server.event_loop import (
    FairQueue,
    LazyTimer,
    Workers,
    give_way,
    on_every_thread,
    repeat_forever,
    work_when_idle,
)


def unexpected(error: Exception) -> None:
    """Take what a callback raised, where none may."""
    raise AssertionError(f"a callback raised {error!r}")


# --- turns

OWNERS = ("cav-1", "cav-2", "cav-3")
steps = st.lists(st.sampled_from([*OWNERS, "take"]), max_size=60)
"""Steps of a queue: an owner puts an item, or the next one is taken."""


@given(steps)
def test_every_item_is_taken_once_and_in_the_order_of_its_owner(plan: list[str]) -> None:
    queue: FairQueue[tuple[str, int]] = FairQueue()
    put: Counter[str] = Counter()
    taken: dict[str, list[int]] = defaultdict(list)

    def take() -> None:
        owner, number = queue.take()
        taken[owner].append(number)

    for step in plan:
        waiting = sum(put.values()) - sum(map(len, taken.values()))
        if step != "take":
            queue.put(step, (step, put[step]))
            put[step] += 1
        elif waiting:
            take()
        else:
            with pytest.raises(IndexError):
                queue.take()
    while sum(map(len, taken.values())) < sum(put.values()):
        take()
    assert {owner: list(range(count)) for owner, count in put.items()} == dict(taken)
    with pytest.raises(IndexError):
        queue.take()


@given(steps)
def test_an_item_waits_for_at_most_one_item_of_each_other_owner_per_own_item(
    plan: list[str],
) -> None:
    queue: FairQueue[tuple[str, Counter[str]]] = FairQueue()
    taken: Counter[str] = Counter()
    waiting: Counter[str] = Counter()

    def take() -> None:
        owner, before = queue.take()
        own = 1 + taken[owner] - before[owner]  # how many items of its own it waited for, with it
        for other in OWNERS:
            if other != owner:
                assert taken[other] - before[other] <= own
        taken[owner] += 1
        waiting[owner] -= 1

    for step in plan:
        if step != "take":
            queue.put(step, (step, Counter(taken)))
            waiting[step] += 1
        elif waiting.total():
            take()
    while waiting.total():
        take()


# --- workers


MakeWorkers = Callable[..., Workers]


@pytest.fixture
async def make_workers() -> AsyncIterator[MakeWorkers]:
    """Make pools of threads that are closed after the test."""
    async with AsyncExitStack() as stack:

        def make(
            threads: int, failed: Callable[[Exception], None] = unexpected, **options: Any
        ) -> Workers:
            workers = Workers(threads, failed, **options)
            stack.push_async_callback(asyncio.to_thread, workers.close)
            return workers

        yield make


async def result_of(workers: Workers, work: Callable[[], Any]) -> Any:
    """Do ``work`` on a thread of ``workers``."""
    found: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
    workers.submit("cav-1", work, found.set_result)
    return await asyncio.wait_for(found, 30)


async def test_what_was_returned_or_raised_reaches_the_loop_that_asked(
    make_workers: MakeWorkers,
) -> None:
    outcomes, all_here = list[int | Exception](), asyncio.Event()
    here = threading.get_ident()

    def done(outcome: int | Exception) -> None:
        assert threading.get_ident() == here
        outcomes.append(outcome)
        if len(outcomes) == 3:
            all_here.set()

    workers = make_workers(2)
    for divisor in (1, 0, 2):
        workers.submit("cav-1", lambda divisor=divisor: 10 // divisor, done)
    await all_here.wait()
    assert sorted(o for o in outcomes if isinstance(o, int)) == [5, 10]
    assert [type(o) for o in outcomes if isinstance(o, Exception)] == [ZeroDivisionError]


async def test_there_is_room_while_a_thread_is_free_and_nothing_waits(
    make_workers: MakeWorkers,
) -> None:
    workers, begun, go_on = make_workers(2), threading.Semaphore(0), threading.Event()

    def work() -> None:
        begun.release()
        go_on.wait(30)

    room, results = [workers.has_room], []
    for _ in range(3):
        results.append(asyncio.create_task(result_of(workers, work)))
        await asyncio.sleep(0)
        if len(results) < 3:
            assert await asyncio.to_thread(begun.acquire, timeout=30)
        room.append(workers.has_room)
    assert room == [True, True, False, False]
    go_on.set()
    await asyncio.gather(*results)
    await result_of(workers, go_on.set)
    assert await asyncio.to_thread(_soon, lambda: workers.has_room)


def _soon(holds: Callable[[], bool]) -> bool:
    """Wait for something that follows within moments."""
    return any(holds() or threading.Event().wait(0.01) for _ in range(3000))


async def test_every_thread_of_all_workers_begins_at_the_same_time(
    make_workers: MakeWorkers,
) -> None:
    pools = make_workers(3), make_workers(1, name="background")
    here, all_here = list[str](), threading.Barrier(4, timeout=30)

    def work() -> None:
        all_here.wait()
        here.append(threading.current_thread().name)

    await on_every_thread(pools, work, 30.0)
    assert sorted(here) == ["background_0", "worker_0", "worker_1", "worker_2"]


async def test_what_one_thread_raised_is_raised(make_workers: MakeWorkers) -> None:
    first = threading.Lock()
    with pytest.raises(ZeroDivisionError):
        await on_every_thread(
            (make_workers(2),), lambda: 1 // (not first.acquire(blocking=False)), 30.0
        )


def own_niceness() -> int:
    return os.getpriority(os.PRIO_PROCESS, threading.get_native_id())


def own_policy() -> int:
    return os.sched_getscheduler(0)


async def test_threads_of_background_work_give_way_and_no_other_thread_does(
    make_workers: MakeWorkers,
) -> None:
    own = own_niceness()
    for nice, expected in ((0, own), (4, min(19, own + 4)), (40, 19)):
        workers = make_workers(1, begin=partial(give_way, nice))
        assert await result_of(workers, own_niceness) == expected
    assert own_niceness() == own


async def test_threads_of_idle_work_are_of_the_kernels_idle_class_and_no_other_thread_is(
    make_workers: MakeWorkers,
) -> None:
    own = own_policy()
    assert await result_of(make_workers(1), own_policy) == own
    assert await result_of(make_workers(1, begin=work_when_idle), own_policy) == os.SCHED_IDLE
    assert own_policy() == own


async def test_while_others_come_one_owner_leaves_them_a_worker_and_all_its_work_is_done(
    make_workers: MakeWorkers,
) -> None:
    workers = make_workers(3, crowded=lambda: True)
    gate, lock = threading.Event(), threading.Lock()
    two_busy, all_ended = threading.Event(), asyncio.Event()
    busy = most = 0

    def work() -> None:
        nonlocal busy, most
        with lock:
            busy += 1
            most = max(most, busy)
            if busy == 2:
                two_busy.set()
        assert gate.wait(30)
        with lock:
            busy -= 1

    def end(outcome: object) -> None:
        ended.append(outcome)
        if len(ended) == 8:
            all_ended.set()

    ended: list[object] = []
    for _ in range(8):
        workers.submit("greedy", work, end)
    await result_of(workers, lambda: None)
    assert await asyncio.to_thread(two_busy.wait, 30)
    gate.set()
    await asyncio.wait_for(all_ended.wait(), 30)  # closing keeps no worker back for others
    assert (most, ended) == (2, [None] * 8)


async def test_close_waits_for_what_was_asked_for() -> None:
    workers, done = Workers(2, unexpected), list[int]()
    for number in range(20):
        workers.submit("cav-1", lambda number=number: done.append(number), lambda _: None)
    await asyncio.to_thread(workers.close)
    assert sorted(done) == list(range(20))


async def test_workers_let_owners_take_turns() -> None:
    workers, order = Workers(1, unexpected), list[str]()
    begun, gate = threading.Event(), threading.Event()

    def hold() -> None:
        begun.set()
        assert gate.wait(10)

    workers.submit("greedy", hold, lambda _: None)
    assert await asyncio.to_thread(begun.wait, 10)
    for _ in range(5):
        workers.submit("greedy", lambda: order.append("greedy"), lambda _: None)
    workers.submit("modest", lambda: order.append("modest"), lambda _: None)
    gate.set()
    await asyncio.to_thread(workers.close)
    assert order == ["greedy", "modest", "greedy", "greedy", "greedy", "greedy"]


async def test_another_thread_works_while_a_worker_waits_for_something_outside() -> None:
    workers = Workers(1, unexpected)
    answered, waited = threading.Event(), asyncio.Event()

    def wait() -> None:
        with workers.waiting():
            assert answered.wait(60), "the only worker was held"

    for _ in range(3):
        waited.clear()
        workers.submit("cav-1", wait, lambda _: waited.set())
        workers.submit("cav-2", answered.set, lambda _: None)
        await waited.wait()
        answered.clear()
    with workers.waiting():  # not a worker: nobody stands in for it
        pass
    workers.close()
    assert not any(thread.is_alive() for thread in workers._threads)


async def test_no_more_threads_than_the_limit_stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(event_loop, "MAX_SUBSTITUTES", 2)
    workers, all_done = Workers(1, unexpected), asyncio.Event()
    waiting = threading.Semaphore(0)
    end = threading.Event()

    def wait() -> None:
        with workers.waiting():
            waiting.release()
            end.wait(60)

    for number in range(8):
        last = number == 7
        workers.submit("cav-1", wait, lambda _, last=last: all_done.set() if last else None)
    for _ in range(3):
        await asyncio.to_thread(waiting.acquire)
    assert len(workers._threads) == 3
    end.set()
    await all_done.wait()
    workers.close()


async def test_a_callback_that_raises_is_reported_and_the_next_ones_run() -> None:
    failures: list[Exception] = []
    workers, last, begun = Workers(1, failures.append), asyncio.Event(), threading.Event()
    error = ValueError("of the callback")

    def fail(_: object) -> None:
        raise error

    workers.submit("cav-1", lambda: None, fail)
    workers.submit("cav-1", begun.set, lambda _: last.set())
    assert begun.wait(10), "the loop is held up: both outcomes are delivered together"
    async with asyncio.timeout(10.0):
        await last.wait()
    await asyncio.to_thread(workers.close)
    assert failures == [error]


async def test_what_is_repeated_goes_on_after_an_error_that_is_reported() -> None:
    failures: list[Exception] = []
    error, again, calls = ValueError("the first time"), asyncio.Event(), 0

    async def work() -> None:
        nonlocal calls
        calls += 1
        if calls == 1:
            raise error
        again.set()

    task = asyncio.create_task(repeat_forever(work, 0.0, failures.append))
    async with asyncio.timeout(10.0):
        await again.wait()
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert failures == [error]


# --- deadlines


@pytest.fixture
def event() -> asyncio.Event:
    return asyncio.Event()


async def test_a_deadline_that_has_come_sets_the_event(event: asyncio.Event) -> None:
    timer = LazyTimer(event)
    timer.restart(asyncio.get_running_loop().time() + 3600.0)
    timer.restart(asyncio.get_running_loop().time() - 1.0)
    async with asyncio.timeout(10.0):
        await event.wait()
