"""Describe a link per direction, read it from a file, and run it on a virtual clock.

An impairment changes how a link transmits (a trace, an outage) or adds to its delay (jitter, a
recorded delay). Randomness comes from a seed: every impairment of every direction draws from its
own generator, so that adding one changes no other.

A profile is a TOML file with a table for each direction and, in it, for each impairment::

    description = "a drive through a town with a tunnel"
    seed = 7
    [uplink]
    rate_mbps = 4.0             # or a table [uplink.trace]: see rfcore.link.traces
    delay_ms = 20.0
    queue_kib = 64
    [uplink.outage]             # or jitter (rfcore.link.impairments), delay_trace (.traces)
    at_s = [[10.0, 2.0]]
    [downlink]
    rate_mbps = 20.0
    [connection_loss]
    mean_life_s = 30.0          # connections are cut at random: a TCP proxy can lose no packets

``delivery_times`` runs a plan without waiting, for experiments. Its sizes are packet bytes (pose +
header + payload), as the paper's tau has them; the proxy on real sockets counts wire bytes instead.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random
from typing import Any, Protocol

from rfcore.errors import InvalidData, InvalidInput
from rfcore.link.shaper import (
    MAX_DELAY_S,
    MAX_RATE_BPS,
    ConstantRate,
    Link,
    LinkParts,
    LinkProfile,
)
from rfcore.tables import Range, Table

UNBOUNDED_BYTES = 2**62
MAX_QUEUE_KIB = 1 << 20
LIFE_S = Range(0.05, 1e6)
IMPAIRMENTS = ("outage", "delay_trace", "jitter")
"""In the order in which they act, whatever the order in the file; a trace is in place of a rate."""


class Impairment(Protocol):
    """One impairment, as a profile declares it."""

    @property
    def name(self) -> str:
        """Its table in a profile."""

    def apply(self, parts: LinkParts, random: Random) -> LinkParts:
        """Return the parts of a link with this impairment; all randomness comes from ``random``."""


@dataclass(frozen=True)
class DirectionPlan:
    """One direction: ``impairments`` are applied in order, with generators made from ``seed``."""

    profile: LinkProfile
    impairments: tuple[Impairment, ...] = ()
    seed: str = ""

    def link(self, origin_s: float = 0.0) -> Link[Any]:
        """Return the machine; traces, outages and the like begin at ``origin_s``."""
        parts = LinkParts(ConstantRate(self.profile.rate_bps))
        for impairment in self.impairments:
            parts = impairment.apply(parts, Random(f"{self.seed}/{impairment.name}"))
        return Link(self.profile, parts, origin_s)

    def unbounded(self) -> DirectionPlan:
        """Return the plan with a queue that never fills: for schedules that nobody can hold."""
        return replace(self, profile=replace(self.profile, queue_limit_bytes=UNBOUNDED_BYTES))


@dataclass(frozen=True)
class LinkPlan:
    """A whole link. Connections live for ``mean_life_s`` on average; None: for ever."""

    uplink: DirectionPlan
    downlink: DirectionPlan
    mean_life_s: float | None = None
    seed: str = ""
    description: str = ""

    def connection_lives_s(self) -> Iterator[float] | None:
        """Return the seconds after which one connection after another is cut; None: never."""
        if self.mean_life_s is None:
            return None
        return _exponential(self.mean_life_s, Random(f"{self.seed}/connection_loss"))


def _exponential(mean: float, random: Random) -> Iterator[float]:
    while True:
        yield mean * random.expovariate(1.0)


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


def read_link(path: Path) -> LinkPlan:
    """Read a profile.

    >>> from pathlib import Path
    >>> from rfcore.link import read_link
    >>> plan = read_link(Path("samples/links/tunnel.toml"))
    >>> plan.uplink.profile.rate_bps, [impairment.name for impairment in plan.uplink.impairments]
    (10000000.0, ['outage'])

    Raises ``InvalidInput`` naming the file, the key, its value and the limit, ``InvalidData`` for a
    file that is no TOML or a trace that is none, ``OSError`` for one that cannot be read.
    """
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InvalidData(f"{path}: not a link profile ({error})") from error
    try:
        return _link(Table(values, InvalidInput), path.parent)
    except InvalidInput as error:
        raise InvalidInput(f"{path}: {error.field}", error.problem) from error


def _link(top: Table, folder: Path) -> LinkPlan:
    seed = str(top.whole("seed", Range(0, 2**53), 0))
    description = str(top.value("description", ""))
    uplink = _direction(top.table("uplink"), folder, f"{seed}/uplink")
    downlink = _direction(top.table("downlink"), folder, f"{seed}/downlink")
    mean_life_s = None
    if "connection_loss" in top:
        loss = top.table("connection_loss")
        mean_life_s = loss.number("mean_life_s", LIFE_S)
        loss.finish()
    top.finish("connection_loss")
    return LinkPlan(uplink, downlink, mean_life_s, seed, description)


def _direction(table: Table, folder: Path, seed: str) -> DirectionPlan:
    impairments: list[Impairment] = []
    if "trace" in table:
        if "rate_mbps" in table:
            raise table.error("rate_mbps", "is given beside a trace; give one")
        trace = _impairment("trace", table, folder)
        impairments.append(trace)
        rate_bps = trace.mean_rate_bps
    else:
        rate_bps = 1e6 * table.number("rate_mbps", Range(1e-6, MAX_RATE_BPS / 1e6))
    delay_ms = table.number("delay_ms", Range(0.0, 1e3 * MAX_DELAY_S), 0.0)
    queue_kib = table.number("queue_kib", Range(1, MAX_QUEUE_KIB), 64)
    impairments += [_impairment(name, table, folder) for name in IMPAIRMENTS if name in table]
    table.finish("rate_mbps", "trace", *IMPAIRMENTS)
    profile = LinkProfile(rate_bps, delay_ms / 1e3, int(queue_kib * 1024))
    return DirectionPlan(profile, tuple(impairments), seed)


def _impairment(name: str, table: Table, folder: Path) -> Any:
    """Return what the table of that name declares; only what a profile names is imported."""
    if name in ("trace", "delay_trace"):
        from rfcore.link.traces import parse_recording

        return parse_recording(name, table.table(name), folder)
    from rfcore.link.impairments import parse_impairment

    return parse_impairment(name, table.table(name))
