"""An event by a deadline that is moved with every message: one timer in a minute, not one a frame.

Arming and cancelling a timer for each of thousands of messages a second costs more than waking up
once too early: a deadline that moves later is looked at when the earlier one has passed.
"""

from __future__ import annotations

import asyncio

__all__ = ["LazyTimer"]


class LazyTimer:
    """Sets ``event`` at the latest ``at`` (seconds of the loop's clock), or earlier."""

    def __init__(self, event: asyncio.Event) -> None:
        self._event = event
        self._timer: asyncio.TimerHandle | None = None

    def by(self, at: float | None) -> None:
        """Have the event set by ``at``; None: not needed."""
        if at is None:
            self.cancel()
        elif self._timer is None or at < self._timer.when():
            self.cancel()
            self._timer = asyncio.get_running_loop().call_at(at, self._ring)

    def cancel(self) -> None:
        """Leave the event alone."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _ring(self) -> None:
        self._timer = None
        self._event.set()
