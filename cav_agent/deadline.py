"""Which rung of the ladder the next frame is coded on, so that it is ready within a deadline.

A rung is one setting of the sender; the ladder says what each took and cost on the machine that
measured it. ``slowness`` is how much longer a frame takes here and now, a running mean over the
last few; a rung is predicted to take its ladder time times that. After a late frame the best rung
that is predicted to fit is taken at once. A better one is taken only when it has been predicted to
fit with room to spare for a while, which doubles each time a climb was soon taken back, so that a
load near a rung's edge does not make it alternate.

``DeadlineController`` is the state machine; ``Rungs`` is what ``cav_agent.pipeline`` asks, on the
encoder's thread alone: one rung for ever, or the controller's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from rfcore.codec.sender.ladder import MeasuredRung, Rung
from rfcore.errors import InvalidInput

__all__ = [
    "DeadlineController",
    "DeadlineLimits",
    "DeadlineRungs",
    "FixedRung",
    "Rungs",
    "Step",
]


@dataclass(frozen=True)
class DeadlineLimits:
    """When to take a better rung: once it was predicted to stay below the share ``room`` of the
    deadline for ``climb_delay_s``, which grows to ``max_climb_delay_s`` at most. ``memory``: weight
    of the newest frame in the running mean."""

    room: float = 0.85
    climb_delay_s: float = 2.0
    max_climb_delay_s: float = 60.0
    memory: float = 0.25

    def __post_init__(self) -> None:
        for name in ("room", "memory"):
            if not 0 < getattr(self, name) <= 1:
                raise InvalidInput(f"deadline.{name}", f"{getattr(self, name)} is outside 0..1")
        if not 0 < self.climb_delay_s <= self.max_climb_delay_s:
            raise InvalidInput(
                "deadline.climb_delay_s",
                f"{self.climb_delay_s} s is outside 0..{self.max_climb_delay_s:g} s",
            )


@dataclass(frozen=True)
class Step:
    """A change of rung: ``down`` to a faster one, or up."""

    before: MeasuredRung
    after: MeasuredRung
    slowness: float

    @property
    def down(self) -> bool:
        """Whether accuracy was given up."""
        return self.after.rate_percent > self.before.rate_percent


class DeadlineController:
    """Chooses among ``rungs``, fewest bits first, each faster than the one before it."""

    def __init__(
        self,
        rungs: Sequence[MeasuredRung],
        deadline_ms: float,
        limits: DeadlineLimits | None = None,
    ) -> None:
        if not rungs:
            raise InvalidInput("ladder", "has no rungs")
        if not (math.isfinite(deadline_ms) and deadline_ms > 0):
            raise InvalidInput("deadline_ms", f"{deadline_ms} must be above 0 ms")
        self._rungs = tuple(rungs)
        self._deadline_ms = deadline_ms
        self._limits = limits or DeadlineLimits()
        self._climb_delay_s = self._limits.climb_delay_s
        self._room_since_s: float | None = None
        self._climbed_s = -math.inf
        self.slowness: float | None = None
        self.late = False
        self.current = self._best(1.0)

    @property
    def position(self) -> int:
        """How many better rungs there are."""
        return self._rungs.index(self.current)

    def measured(self, rung: MeasuredRung, sender_ms: float, now: float) -> Step | None:
        """Take a frame's time on ``rung``; return the change of rung that follows, if any.

        The first frame alone says how fast this machine is, whatever rung it was on.
        """
        if not (math.isfinite(sender_ms) and sender_ms > 0):
            raise InvalidInput("sender_ms", f"{sender_ms} must be above 0 ms")
        ratio = sender_ms / rung.sender_ms
        first = self.slowness is None
        before = ratio if self.slowness is None else self.slowness
        self.slowness = before + self._limits.memory * (ratio - before)
        self.late = late = sender_ms > self._deadline_ms
        if first:
            return self._move(self._best(1 / self._limits.room))
        if rung is not self.current:
            return None  # a frame that was begun before the last change
        if late and self._predicted_ms(self.current) > self._deadline_ms:
            return self._fall(now)
        return self._climb(now)

    def measured_in_part(self, rung: MeasuredRung, sender_ms: float, now: float) -> Step | None:
        """Take the time of a frame that left out some of what ``rung`` does, like rendering.

        That it was quick says nothing of this machine; that it was late does.
        """
        if sender_ms > self._deadline_ms:
            return self.measured(rung, sender_ms, now)
        self.late = False
        return None

    def _fall(self, now: float) -> Step | None:
        if now - self._climbed_s < 2 * self._climb_delay_s:
            self._climb_delay_s = min(2 * self._climb_delay_s, self._limits.max_climb_delay_s)
        self._room_since_s = None
        return self._move(self._best(1.0))

    def _climb(self, now: float) -> Step | None:
        better = self._best(1 / self._limits.room)
        if better.rate_percent >= self.current.rate_percent:
            self._room_since_s = None
            return None
        if self._room_since_s is None:
            self._room_since_s = now
        if now - self._room_since_s < self._climb_delay_s:
            return None
        if now - self._climbed_s > 4 * self._climb_delay_s:
            self._climb_delay_s = self._limits.climb_delay_s
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

    def coded(
        self, sender_s: float, now: float, instant: int = 0, *, in_field: bool = True
    ) -> None:
        """A frame on ``current`` took ``sender_s`` from picture to packet, until ``now``.

        ``instant``: of a rig, which its frame belongs to; 0: it stands alone. ``in_field``: its
        camera was found, so that all was done that the rung has a time for.
        """


class FixedRung:
    """One rung for the whole drive."""

    def __init__(self, rung: Rung) -> None:
        self.current = rung

    def coded(
        self, sender_s: float, now: float, instant: int = 0, *, in_field: bool = True
    ) -> None:
        """Do nothing: the rung does not depend on it."""


class DeadlineRungs:
    """The rungs ``controller`` chooses; ``on_coded`` gets the controller and its step per frame.

    The deadline of a rig is that of all cameras together: the frames of an instant count as one,
    which took as long as they did in sum.
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

    def coded(
        self, sender_s: float, now: float, instant: int = 0, *, in_field: bool = True
    ) -> None:
        """Let the controller choose anew, and report what it did; of an instant's frames with the
        first of the next."""
        if instant and instant == self._instant:
            self._instant_s += sender_s
            self._instant_in_field &= in_field
            return
        measured_s, whole = sender_s, in_field
        if instant:
            measured_s, whole = self._instant_s, self._instant_in_field
        self._instant, self._instant_s, self._instant_in_field = instant, sender_s, in_field
        if measured_s:
            self._measured(measured_s, now, whole)

    def _measured(self, sender_s: float, now: float, whole: bool) -> None:
        controller = self._controller
        take = controller.measured if whole else controller.measured_in_part
        step = take(controller.current, 1e3 * sender_s, now)
        self._on_coded(controller, step)
