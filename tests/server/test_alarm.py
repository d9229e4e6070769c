"""The alarm rings by its deadline, with one timer however often the deadline moves later."""

import asyncio

import pytest

from mec_server.lazy_timer import LazyTimer


@pytest.fixture
def event() -> asyncio.Event:
    return asyncio.Event()


async def test_a_deadline_that_has_come_sets_the_event(event: asyncio.Event) -> None:
    alarm = LazyTimer(event)
    alarm.by(asyncio.get_running_loop().time() + 3600.0)
    alarm.by(asyncio.get_running_loop().time() - 1.0)
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
    alarm = LazyTimer(event)
    for later in range(100):
        alarm.by(now + 60.0 + later)
    alarm.by(now + 30.0)
    assert armed == [now + 60.0, now + 30.0]
    alarm.by(None)
    alarm.by(now + 50.0)
    assert armed[-1] == now + 50.0
    alarm.cancel()
    assert not event.is_set()
