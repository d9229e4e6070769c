"""Which rung of the ladder the next frame is coded on: always the same, or what a deadline allows.

Used on the encoder's thread alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

from cav_agent.deadline import DeadlineController, Step
from rfcore.codec.ladder import Rung

__all__ = ["DeadlineRungs", "FixedRung", "Rungs", "sender_ms"]

NOT_THE_SENDERS = frozenset({"read"})
"""Stages that a vehicle does not have: its camera hands the picture over."""


def sender_ms(stage_s: Mapping[str, float]) -> float:
    """Return what a frame took the sender, from the picture in memory to the packet."""
    return 1e3 * sum(spent for stage, spent in stage_s.items() if stage not in NOT_THE_SENDERS)


class Rungs(Protocol):
    """Says how to code, and is told what it took."""

    @property
    def current(self) -> Rung:
        """The rung for the next frame."""

    def coded(self, stage_s: Mapping[str, float], now: float) -> None:
        """A frame on ``current`` took so many seconds by stage, until ``now``."""


class FixedRung:
    """One rung for the whole drive."""

    def __init__(self, rung: Rung) -> None:
        self.current = rung

    def coded(self, stage_s: Mapping[str, float], now: float) -> None:
        """Nothing follows from it."""


class DeadlineRungs:
    """What ``controller`` says; ``told`` hears of every frame: the controller, and its step."""

    def __init__(
        self,
        controller: DeadlineController,
        told: Callable[[DeadlineController, Step | None], None],
    ) -> None:
        self._controller = controller
        self._told = told

    @property
    def current(self) -> Rung:
        """The rung for the next frame."""
        return self._controller.current.rung

    def coded(self, stage_s: Mapping[str, float], now: float) -> None:
        """Let the controller know, and pass on what it makes of it."""
        controller = self._controller
        step = controller.measured(controller.current, sender_ms(stage_s), now)
        self._told(controller, step)
