"""What a link is made of: a profile for each direction, and the stages it names.

A stage changes how a link transmits (a trace, an outage) or adds to its delay (jitter, a recorded
delay). Each is a module of its own that only a profile naming it imports. Chance comes from a seed:
every stage of every direction draws from its own generator, so that adding one changes no other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from random import Random
from typing import Any, Protocol

from rfcore.link.profile import LinkProfile
from rfcore.link.shaper import ConstantRate, Delay, Link, Transmission

__all__ = ["ConnectionLife", "DirectionPlan", "LinkPlan", "Parts", "Stage"]

UNBOUNDED_BYTES = 2**62


@dataclass(frozen=True)
class Parts:
    """How a link transmits, and what adds to its delay."""

    transmission: Transmission
    delays: tuple[Delay, ...] = ()

    def with_delay(self, delay: Delay) -> Parts:
        """Return these parts and one more delay."""
        return replace(self, delays=(*self.delays, delay))


class Stage(Protocol):
    """One impairment, as a profile declares it."""

    @property
    def name(self) -> str:
        """Its section in a profile."""

    def apply(self, parts: Parts, random: Random) -> Parts:
        """Return the parts of a link with this impairment; all chance comes from ``random``."""


class ConnectionLife(Protocol):
    """How long connections live."""

    def lifetime_s(self) -> float:
        """Return the seconds after which the next connection is cut."""


class ConnectionLoss(Protocol):
    """Cuts connections, as a profile declares it."""

    def lives(self, random: Random) -> ConnectionLife:
        """Return the machine that says how long connections live."""


@dataclass(frozen=True)
class DirectionPlan:
    """One direction: ``stages`` are applied in order; ``seed`` names its chance."""

    profile: LinkProfile
    stages: tuple[Stage, ...] = ()
    seed: str = ""

    def link(self, origin_s: float = 0.0) -> Link[Any]:
        """Return the machine; traces, outages and the like begin at ``origin_s``."""
        parts = Parts(ConstantRate(self.profile.rate_bps))
        for stage in self.stages:
            parts = stage.apply(parts, Random(f"{self.seed}/{stage.name}"))
        return Link(self.profile, parts.transmission, parts.delays, origin_s)

    def unbounded(self) -> DirectionPlan:
        """Return the plan with a queue that never fills: for schedules that nobody can hold."""
        return replace(self, profile=replace(self.profile, queue_limit_bytes=UNBOUNDED_BYTES))


@dataclass(frozen=True)
class LinkPlan:
    """A whole link. ``connection_loss`` cuts connections at random; None: never."""

    uplink: DirectionPlan
    downlink: DirectionPlan
    connection_loss: ConnectionLoss | None = None
    seed: str = ""
    description: str = ""

    def connection_lives(self) -> ConnectionLife | None:
        """Return the machine that says how long connections live, or None: for ever."""
        if self.connection_loss is None:
            return None
        return self.connection_loss.lives(Random(f"{self.seed}/connection_loss"))

    @property
    def stage_names(self) -> Sequence[str]:
        """What the profile names beside rates and delays."""
        named = [stage.name for plan in (self.uplink, self.downlink) for stage in plan.stages]
        return named + (["connection_loss"] if self.connection_loss else [])
