"""Workers take turns among owners, bring every outcome back to the loop, and wake it once."""

import asyncio
import os
import threading
from collections import Counter, defaultdict
from functools import partial

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
"""What happens to a queue: an owner puts an item, or the next one is taken."""


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


def test_one_frame_behind_a_hundred_of_another_owner_is_the_second_to_begin() -> None:
    queue: FairQueue[str] = FairQueue()
    for _ in range(100):
        queue.put("greedy", "greedy")
    queue.put("modest", "modest")
    assert [queue.take() for _ in range(3)] == ["greedy", "modest", "greedy"]


# --- workers


def test_what_was_returned_or_raised_reaches_the_loop_that_asked() -> None:
    async def run() -> list[int | Exception]:
        workers, outcomes, all_here = (
            Workers(2, unexpected),
            list[int | Exception](),
            asyncio.Event(),
        )
        here = threading.get_ident()

        def done(outcome: int | Exception) -> None:
            assert threading.get_ident() == here
            outcomes.append(outcome)
            if len(outcomes) == 3:
                all_here.set()

        for divisor in (1, 0, 2):
            workers.submit("cav-1", lambda divisor=divisor: 10 // divisor, done)
        await all_here.wait()
        await asyncio.to_thread(workers.close)
        return outcomes

    outcomes = asyncio.run(run())
    assert sorted(o for o in outcomes if isinstance(o, int)) == [5, 10]
    assert [type(o) for o in outcomes if isinstance(o, Exception)] == [ZeroDivisionError]


def test_one_worker_does_work_in_the_order_of_asking() -> None:
    async def run() -> list[int]:
        workers, order, last = Workers(1, unexpected), list[int](), asyncio.Event()
        for number in range(100):
            workers.submit("cav-1", lambda number=number: order.append(number), lambda _: None)
        workers.submit("cav-1", lambda: None, lambda _: last.set())
        await last.wait()
        await asyncio.to_thread(workers.close)
        return order

    assert asyncio.run(run()) == list(range(100))


def test_every_thread_of_all_workers_begins_at_the_same_time() -> None:
    async def run() -> list[str]:
        pools = Workers(3, unexpected), Workers(1, unexpected, "background")
        here, all_here = list[str](), threading.Barrier(4, timeout=30)

        def work() -> None:
            all_here.wait()
            here.append(threading.current_thread().name)

        await on_every_thread(pools, work, 30.0)
        for pool in pools:
            await asyncio.to_thread(pool.close)
        return sorted(here)

    assert asyncio.run(run()) == ["background_0", "worker_0", "worker_1", "worker_2"]


def test_what_one_thread_raised_is_raised() -> None:
    async def run() -> None:
        pool, first = Workers(2, unexpected), threading.Lock()
        try:
            await on_every_thread((pool,), lambda: 1 // (not first.acquire(blocking=False)), 30.0)
        finally:
            await asyncio.to_thread(pool.close)

    with pytest.raises(ZeroDivisionError):
        asyncio.run(run())


def test_threads_of_background_work_give_way_and_no_other_thread_does() -> None:
    async def niceness(workers: Workers) -> int:
        found: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        workers.submit("cav-1", own_niceness, found.set_result)
        try:
            return await asyncio.wait_for(found, 30)
        finally:
            await asyncio.to_thread(workers.close)

    def own_niceness() -> int:
        return os.getpriority(os.PRIO_PROCESS, threading.get_native_id())

    own = own_niceness()
    for nice, expected in ((0, own), (4, min(19, own + 4)), (40, 19)):
        assert (
            asyncio.run(niceness(Workers(1, unexpected, begin=partial(give_way, nice)))) == expected
        )


def test_threads_of_idle_work_are_of_the_kernels_idle_class_and_no_other_thread_is() -> None:
    async def policy(workers: Workers) -> int:
        found: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        workers.submit("cav-1", lambda: os.sched_getscheduler(0), found.set_result)
        try:
            return await asyncio.wait_for(found, 30)
        finally:
            await asyncio.to_thread(workers.close)

    own = os.sched_getscheduler(0)
    assert asyncio.run(policy(Workers(1, unexpected))) == own
    assert asyncio.run(policy(Workers(1, unexpected, begin=work_when_idle))) == os.SCHED_IDLE
    assert os.sched_getscheduler(0) == own


def test_while_others_come_one_owner_leaves_them_a_worker_and_all_its_work_is_done() -> None:
    async def run() -> tuple[int, int]:
        workers = Workers(3, unexpected, crowded=lambda: True)
        gate, lock = threading.Event(), threading.Lock()
        two_busy, all_ended, done = threading.Event(), asyncio.Event(), asyncio.Event()
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
        workers.submit("modest", lambda: None, lambda _: done.set())
        await asyncio.wait_for(done.wait(), 30)
        assert await asyncio.to_thread(two_busy.wait, 30)
        gate.set()
        await asyncio.wait_for(all_ended.wait(), 30)  # closing keeps no worker back for others
        await asyncio.to_thread(workers.close)
        await asyncio.sleep(0)
        return most, len(ended)

    assert asyncio.run(run()) == (2, 8)


def test_outcomes_that_wait_together_wake_the_loop_once() -> None:
    async def run() -> int:
        workers, loop = Workers(1, unexpected), asyncio.get_running_loop()
        woken, finished, last = 0, threading.Event(), asyncio.Event()
        wake = loop.call_soon_threadsafe

        def count(*args: object) -> asyncio.Handle:
            nonlocal woken
            woken += 1
            return wake(*args)

        loop.call_soon_threadsafe = count
        for _ in range(10):
            workers.submit("cav-1", lambda: None, lambda _: None)
        workers.submit("cav-1", finished.set, lambda _: None)
        workers.submit("cav-1", lambda: None, lambda _: last.set())
        assert finished.wait(10), "the loop is held up, and the worker is not"
        await last.wait()
        loop.call_soon_threadsafe = wake
        await asyncio.to_thread(workers.close)
        return woken

    assert asyncio.run(run()) <= 2, "one for those before, perhaps one for the last"


def test_close_waits_for_what_was_asked_for() -> None:
    async def run() -> list[int]:
        workers, done = Workers(2, unexpected), list[int]()
        for number in range(20):
            workers.submit("cav-1", lambda number=number: done.append(number), lambda _: None)
        await asyncio.to_thread(workers.close)
        return done

    assert sorted(asyncio.run(run())) == list(range(20))


async def test_workers_let_owners_take_turns() -> None:
    workers, order = Workers(1, unexpected), list[str]()
    begun, gate, last = threading.Event(), threading.Event(), asyncio.Event()

    def hold() -> None:
        begun.set()
        assert gate.wait(10)

    workers.submit("greedy", hold, lambda _: None)
    assert await asyncio.to_thread(begun.wait, 10)
    for _ in range(5):
        workers.submit("greedy", lambda: order.append("greedy"), lambda _: None)
    workers.submit("modest", lambda: order.append("modest"), lambda _: None)
    workers.submit("last", lambda: None, lambda _: last.set())
    gate.set()
    await last.wait()
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


async def test_a_later_deadline_keeps_the_timer_and_an_earlier_one_replaces_it(
    event: asyncio.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = asyncio.get_running_loop()
    armed: list[float] = []
    call_at = loop.call_at

    def counting(when: float, ring: object, *args: object) -> asyncio.TimerHandle:
        armed.append(when)
        return call_at(when, ring, *args)  # type: ignore[arg-type]

    monkeypatch.setattr(loop, "call_at", counting)
    now = loop.time()
    timer = LazyTimer(event)
    for later in range(100):
        timer.restart(now + 60.0 + later)
    timer.restart(now + 30.0)
    assert armed == [now + 60.0, now + 30.0]
    timer.restart(None)
    timer.restart(now + 50.0)
    assert armed[-1] == now + 50.0
    timer.cancel()
    assert not event.is_set()
