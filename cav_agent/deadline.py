"""Chooses the rung of the ladder for the next frame, so that it is ready within a deadline.

A rung is one setting of the sender; the ladder says what each took and cost on the machine that
measured it. ``slowness`` is how much longer a frame takes here and now, a running mean over the
last few frames; a rung is predicted to take its ladder time times that. After a late frame the best
rung that is predicted to fit is taken at once. A better one is taken only when it has been
predicted to fit with room to spare for a while. That while doubles each time that a climb was soon
taken back, so that a load near a rung's edge does not make it alternate.

``DeadlineController`` is the state machine. ``Rungs`` is what ``cav_agent.pipeline`` asks, on the
encoder's thread alone: one rung for ever, or the controller's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from rfcore.codec.sender.ladder import MeasuredRung, Rung
from rfcore.errors import InvalidInput

ROOM = 0.85
"""Share of the deadline that a better rung must be predicted to stay below."""

CLIMB_DELAY_S, MAX_CLIMB_DELAY_S = 2.0, 60.0
"""Time for which it must be predicted to do so: at first, and at most."""

NEWEST_WEIGHT = 0.25
"""Weight of the newest frame in the running mean."""


@dataclass(frozen=True)
class Step:
    """A change of rung: ``down`` to a faster one, or up."""

    before: MeasuredRung
    after: MeasuredRung
    slowness: float

    @property
    def down(self) -> bool:
        """Return whether accuracy was given up."""
        return self.after.rate_percent > self.before.rate_percent


class DeadlineController:
    """Chooses among ``rungs``, fewest bits first, each faster than the one before it."""

    def __init__(self, rungs: Sequence[MeasuredRung], deadline_ms: float) -> None:
        if not rungs:
            raise InvalidInput("ladder", "has no rungs")
        if not (math.isfinite(deadline_ms) and deadline_ms > 0):
            raise InvalidInput("deadline_ms", f"{deadline_ms} must be above 0 ms")
        self._rungs = tuple(rungs)
        self._deadline_ms = deadline_ms
        self._climb_delay_s = CLIMB_DELAY_S
        self._room_since_s: float | None = None
        self._climbed_s = -math.inf
        self.slowness: float | None = None
        self.late = False
        """Whether the last frame missed the deadline."""
        self.current = self._best(1.0)

    @property
    def position(self) -> int:
        """Return how many better rungs there are."""
        return self._rungs.index(self.current)

    def measured(
        self, rung: MeasuredRung, sender_ms: float, now: float, *, in_field: bool = True
    ) -> Step | None:
        """Take a frame's time on ``rung``; return the change of rung that follows, if any.

        The first frame alone says how fast this machine is, whatever rung it was on. A frame that
        was not coded ``in_field`` leaves out some of what ``rung`` does, such as rendering: that it
        was quick says nothing of this machine; that it was late does.
        """
        if not (math.isfinite(sender_ms) and sender_ms > 0):
            raise InvalidInput("sender_ms", f"{sender_ms} must be above 0 ms")
        self.late = late = sender_ms > self._deadline_ms
        if not (in_field or late):
            return None
        ratio = sender_ms / rung.sender_ms
        is_first = self.slowness is None
        before = ratio if self.slowness is None else self.slowness
        self.slowness = before + NEWEST_WEIGHT * (ratio - before)
        if is_first:
            return self._move(self._best(1 / ROOM))
        if rung is not self.current:
            return None  # a frame that was begun before the last change
        if late and self._predicted_ms(self.current) > self._deadline_ms:
            return self._fall(now)
        return self._climb(now)

    def _fall(self, now: float) -> Step | None:
        if now - self._climbed_s < 2 * self._climb_delay_s:
            self._climb_delay_s = min(2 * self._climb_delay_s, MAX_CLIMB_DELAY_S)
        self._room_since_s = None
        return self._move(self._best(1.0))

    def _climb(self, now: float) -> Step | None:
        better = self._best(1 / ROOM)
        if better.rate_percent >= self.current.rate_percent:
            self._room_since_s = None
            return None
        if self._room_since_s is None:
            self._room_since_s = now
        if now - self._room_since_s < self._climb_delay_s:
            return None
        if now - self._climbed_s > 4 * self._climb_delay_s:
            self._climb_delay_s = CLIMB_DELAY_S
        self._room_since_s, self._climbed_s = None, now
        return self._move(better)

    def _best(self, factor: float) -> MeasuredRung:
        """Return the first rung whose predicted time, times ``factor``, fits; else the fastest."""
        fitting = (r for r in self._rungs if factor * self._predicted_ms(r) <= self._deadline_ms)
        return next(fitting, self._rungs[-1])

    def _predicted_ms(self, rung: MeasuredRung) -> float:
        return rung.sender_ms * (1.0 if self.slowness is None else self.slowness)

    def _move(self, after: MeasuredRung) -> Step | None:
        before, self.current = self.current, after
        if before is after:
            return None
        return Step(before, after, 1.0 if self.slowness is None else self.slowness)


class Rungs(Protocol):
    """Decides on which rung each frame is coded, from what the frames before it took."""

    @property
    def current(self) -> Rung:
        """The rung for the next frame."""

    def coded(self, sender_s: float, now: float, instant: int, *, in_field: bool) -> None:
        """A frame on ``current`` took ``sender_s`` from picture to packet, until ``now``.

        ``instant``: the number of the rig's instant that it belongs to; 0: its camera is alone.
        ``in_field``: its camera was found, so everything was done that the rung has a time for.
        """


class FixedRung:
    """One rung for the whole drive."""

    def __init__(self, rung: Rung) -> None:
        self.current = rung

    def coded(self, sender_s: float, now: float, instant: int, *, in_field: bool) -> None:
        """Do nothing: the rung does not depend on it."""


class DeadlineRungs:
    """The rungs ``controller`` chooses; ``on_coded`` gets the controller and its step per frame.

    The deadline of a rig is that of all cameras together: the frames of an instant count as one
    that took as long as their sum. It is measured when the first frame of the next comes.
    """

    def __init__(
        self,
        controller: DeadlineController,
        on_coded: Callable[[DeadlineController, Step | None], None],
    ) -> None:
        self._controller = controller
        self._on_coded = on_coded
        self._instant, self._instant_s, self._instant_in_field = 0, 0.0, True

    @property
    def current(self) -> Rung:
        """The rung for the next frame."""
        return self._controller.current.rung

    def coded(self, sender_s: float, now: float, instant: int, *, in_field: bool) -> None:
        """Let the controller choose anew, and report what it did."""
        if instant and instant == self._instant:
            self._instant_s += sender_s
            self._instant_in_field &= in_field
            return
        measured_s, is_whole = sender_s, in_field
        if instant:
            measured_s, is_whole = self._instant_s, self._instant_in_field
        self._instant, self._instant_s, self._instant_in_field = instant, sender_s, in_field
        if measured_s:
            controller = self._controller
            step = controller.measured(controller.current, 1e3 * measured_s, now, in_field=is_whole)
            self._on_coded(controller, step)
