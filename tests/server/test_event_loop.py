"""Workers bring every outcome back to the loop, in the order of finishing, and wake it once."""

import asyncio
import threading

import pytest

from mec_server.event_loop import LazyTimer, Workers


def test_what_was_returned_or_raised_reaches_the_loop_that_asked() -> None:
    async def run() -> list[int | Exception]:
        workers, outcomes, all_here = Workers(2), list[int | Exception](), asyncio.Event()
        here = threading.get_ident()

        def done(outcome: int | Exception) -> None:
            assert threading.get_ident() == here
            outcomes.append(outcome)
            if len(outcomes) == 3:
                all_here.set()

        for divisor in (1, 0, 2):
            workers.submit(lambda divisor=divisor: 10 // divisor, done)
        await all_here.wait()
        await asyncio.to_thread(workers.close)
        return outcomes

    outcomes = asyncio.run(run())
    assert sorted(o for o in outcomes if isinstance(o, int)) == [5, 10]
    assert [type(o) for o in outcomes if isinstance(o, Exception)] == [ZeroDivisionError]


def test_one_worker_does_work_in_the_order_of_asking() -> None:
    async def run() -> list[int]:
        workers, order, last = Workers(1), list[int](), asyncio.Event()
        for number in range(100):
            workers.submit(lambda number=number: order.append(number), lambda _: None)
        workers.submit(lambda: None, lambda _: last.set())
        await last.wait()
        await asyncio.to_thread(workers.close)
        return order

    assert asyncio.run(run()) == list(range(100))


def test_outcomes_that_wait_together_wake_the_loop_once() -> None:
    async def run() -> int:
        workers, loop = Workers(1), asyncio.get_running_loop()
        woken, finished, last = 0, threading.Event(), asyncio.Event()
        wake = loop.call_soon_threadsafe

        def count(*args: object) -> asyncio.Handle:
            nonlocal woken
            woken += 1
            return wake(*args)

        loop.call_soon_threadsafe = count
        for _ in range(10):
            workers.submit(lambda: None, lambda _: None)
        workers.submit(finished.set, lambda _: None)
        workers.submit(lambda: None, lambda _: last.set())
        assert finished.wait(10), "the loop is held up, and the worker is not"
        await last.wait()
        loop.call_soon_threadsafe = wake
        await asyncio.to_thread(workers.close)
        return woken

    assert asyncio.run(run()) <= 2, "one for those before, perhaps one for the last"


def test_close_waits_for_what_was_asked_for() -> None:
    async def run() -> list[int]:
        workers, done = Workers(2), list[int]()
        for number in range(20):
            workers.submit(lambda number=number: done.append(number), lambda _: None)
        await asyncio.to_thread(workers.close)
        return done

    assert sorted(asyncio.run(run())) == list(range(20))


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
