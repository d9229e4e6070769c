"""One direction of the link on real time: a ``rfcore.link`` machine with a pump.

Packets are callbacks: what is pushed is called when it is due. Used by ``rfedge.link_proxy``.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import Protocol

from rfcore.link import Link, LinkProfile
from rfcore.link.meter import BusyMeter

__all__ = ["Direction", "Sender"]

SPIN_S = 0.0002
"""How long before a release the pump stops sleeping and yields in a loop: the kernel's timer slack
of 50 us and the loop's own time. Longer would make the scheduler see a busy process and interrupt
it just when it matters."""


class Sender(Protocol):
    """Who pushes into a direction, and can be told to wait."""

    def hold(self, reason: str) -> None:
        """Push nothing until ``go_on`` with the same reason."""

    def go_on(self, reason: str) -> None:
        """Push again, if no other reason holds."""

    def abort(self) -> None:
        """Push nothing any more."""


class Direction:
    """One direction of the link: senders push, the pump releases to receivers on time."""

    def __init__(self, profile: LinkProfile) -> None:
        self.meter = BusyMeter(profile)
        self.senders: set[Sender] = set()
        self._link: Link[Callable[[], None]] = Link(profile)
        self._arrived = asyncio.Event()

    @property
    def room_bytes(self) -> int:
        """How much may still be pushed."""
        return self._link.profile.held_limit_bytes - self._link.held_bytes

    def push(self, release: Callable[[], None], size_bytes: int) -> None:
        """Let ``release`` be called when ``size_bytes`` have been through the link."""
        self._link.push(release, size_bytes, time.perf_counter())
        self._arrived.set()
        if self._link.is_full:
            for sender in self.senders:
                sender.hold("link")

    async def pump(self) -> None:
        """Release packets when they are due, for ever."""
        while True:
            due_s = self._link.next_event_at()
            if due_s is None:
                self._arrived.clear()
                await self._arrived.wait()
                continue
            await _sleep_until(due_s)
            for delivery in self._link.pop_due(time.perf_counter()):
                delivery.item()
                self.meter.released(delivery, time.perf_counter())
            if not self._link.is_full:
                for sender in self.senders:
                    sender.go_on("link")

    def report(self) -> dict[str, float | int | None]:
        """Return what was measured."""
        meter, profile = self.meter, self._link.profile
        return {
            "rate_bps": profile.rate_bps,
            "delay_s": profile.delay_s,
            "bytes": meter.wire_bytes,
            "busy_s": meter.busy_s,
            "expected_s": meter.expected_s,
            "tau_error_percent": meter.tau_error_percent,
            "busy_periods": meter.periods,
            "largest_lateness_s": meter.largest_lateness_s,
        }


async def _sleep_until(due_s: float) -> None:
    ahead_s = due_s - time.perf_counter() - SPIN_S
    if ahead_s > 0:
        await asyncio.sleep(ahead_s)
    while time.perf_counter() < due_s:
        await asyncio.sleep(0)
