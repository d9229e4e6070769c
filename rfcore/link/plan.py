"""What a link is made of, per direction (profile and impairments), and a run on a virtual clock.

An impairment changes how a link transmits (a trace, an outage) or adds to its delay (jitter, a
recorded delay). Each is a module of its own that only a profile naming it imports. Randomness comes
from a seed: every impairment of every direction draws from its own generator, so that adding one
changes no other.

``delivery_times`` runs a plan without waiting, for experiments. Its sizes are packet bytes (pose +
header + payload), as the paper's tau has them; the proxy on real sockets counts wire bytes instead.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from random import Random
from typing import Any, Protocol

from rfcore.errors import InvalidInput
from rfcore.link.profile import LinkProfile
from rfcore.link.shaper import ConstantRate, Delay, Link, Transmission

__all__ = [
    "Arrival",
    "ConnectionLife",
    "DirectionPlan",
    "Impairment",
    "LinkPlan",
    "Parts",
    "delivery_times",
]

UNBOUNDED_BYTES = 2**62


@dataclass(frozen=True)
class Parts:
    """How a link transmits, and what adds to its delay."""

    transmission: Transmission
    delays: tuple[Delay, ...] = ()

    def with_delay(self, delay: Delay) -> Parts:
        """Return these parts and one more delay."""
        return replace(self, delays=(*self.delays, delay))


class Impairment(Protocol):
    """One impairment, as a profile declares it."""

    @property
    def name(self) -> str:
        """Its table in a profile."""

    def apply(self, parts: Parts, random: Random) -> Parts:
        """Return the parts of a link with this impairment; all randomness comes from ``random``."""


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
    """One direction: ``impairments`` are applied in order, with generators made from ``seed``."""

    profile: LinkProfile
    impairments: tuple[Impairment, ...] = ()
    seed: str = ""

    def link(self, origin_s: float = 0.0) -> Link[Any]:
        """Return the machine; traces, outages and the like begin at ``origin_s``."""
        parts = Parts(ConstantRate(self.profile.rate_bps))
        for impairment in self.impairments:
            parts = impairment.apply(parts, Random(f"{self.seed}/{impairment.name}"))
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


@dataclass(frozen=True)
class Arrival:
    """A packet handed to the link: ``at_s`` seconds on the virtual clock, ``size_bytes`` long."""

    at_s: float
    size_bytes: int


def delivery_times(link: LinkProfile | DirectionPlan, schedule: Iterable[Arrival]) -> list[float]:
    """Return the second at which each packet of ``schedule`` is delivered; traces begin at 0 s.

    The queue is unbounded here: a schedule is a given, there is no sender to hold back. Raises
    ``InvalidInput`` when the schedule is not in time order.
    """
    plan = DirectionPlan(link) if isinstance(link, LinkProfile) else link
    machine = plan.unbounded().link()
    times: list[float] = []
    previous_s = float("-inf")
    for index, arrival in enumerate(schedule):
        if not arrival.at_s >= previous_s:
            raise InvalidInput(
                f"schedule[{index}].at_s", f"{arrival.at_s} s is before {previous_s} s; sort it"
            )
        previous_s = arrival.at_s
        times.append(machine.push(index, arrival.size_bytes, arrival.at_s).due_s)
        machine.pop_due(arrival.at_s)
    return times
