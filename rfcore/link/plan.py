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
    [uplink.outage]             # or jitter (see below), delay_trace (.traces)
    at_s = [[10.0, 2.0]]
    [downlink]
    rate_mbps = 20.0
    loss_percent = 1.0          # packets that are lost, in either direction on its own
    loss_burst = 2.0            # lost in a row on average; 1 (each by itself) unless given
    [connection_loss]
    mean_life_s = 30.0          # connections are cut at random

``delivery_times`` runs a plan without waiting, for experiments. Its sizes are packet bytes (pose +
header + payload), as the paper's tau has them; the proxy on real sockets counts wire bytes instead.

Two impairments are computed, outages and jitter; recorded ones are in ``rfcore.link.traces``. Lost
packets are a matter of their own: TCP sends them again (``rfcore.link.lossy``).

*Outage*: nothing gets through, as in a tunnel, during a handover or in a dead spot. The
transmission stands still, and so does a trace; what is in propagation arrives. Afterwards it goes
on where it was. In a profile: ``[uplink.outage]`` with ``at_s = [[from, for], ...]`` and
``repeat_s``, or with ``mean_up_s`` and ``mean_down_s`` for exponentially distributed lengths.

*Jitter*: a random delay on top of the constant one. Packets keep their order: one that draws little
waits behind one that drew much, as with a radio link that retransmits. In a profile:
``[uplink.jitter]`` with ``spread_ms`` and ``distribution``, which is ``uniform`` (between 0 and the
spread) or ``exponential`` (the spread is the mean, cut off at ten times that).
"""

from __future__ import annotations

import itertools
import tomllib
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from random import Random
from typing import Any, Protocol

from rfcore.errors import InvalidData, InvalidInput
from rfcore.link.lossy import MAX_LOSS_PERCENT, LossyLink, PacketLoss
from rfcore.link.shaper import (
    MAX_DELAY_S,
    MAX_RATE_BPS,
    ConstantRate,
    Link,
    LinkParts,
    LinkProfile,
    Transmission,
)
from rfcore.link.traces import parse_recording
from rfcore.tables import Range, Table, shortened

Window = tuple[float, float]
"""(first second without the link, first second with it)"""

MAX_S = 1e6
LENGTH_S = Range(1e-3, MAX_S)
MAX_SPREAD_S = 5.0
LONGEST = 10.0
"""Cut of the exponential distribution, in means: one packet in 22 000 is beyond it."""


@dataclass(frozen=True)
class Outage:
    """The link is out during ``windows_s``, ascending and apart, and again every ``repeat_s``."""

    windows_s: tuple[Window, ...]
    repeat_s: float | None = None
    name: str = "outage"

    def __post_init__(self) -> None:
        edges = [edge for window in self.windows_s for edge in window]
        if not edges or edges[0] < 0 or any(not a < b for a, b in itertools.pairwise(edges)):
            raise InvalidInput("outage", f"{self.windows_s} must be times that ascend, apart")
        if self.repeat_s is not None and not self.repeat_s >= edges[-1]:
            raise InvalidInput(
                "outage.repeat_s", f"{self.repeat_s} s is before the last outage ends, {edges[-1]}"
            )

    def windows(self) -> Iterator[Window]:
        """Yield the outages in order, without end if they repeat."""
        if self.repeat_s is None:
            yield from self.windows_s
            return
        for number in itertools.count():
            shift_s = number * self.repeat_s
            yield from ((begin + shift_s, end + shift_s) for begin, end in self.windows_s)

    def apply(self, parts: LinkParts, random: Random) -> LinkParts:  # noqa: ARG002
        """Interrupt the transmission."""
        outages = OutageTransmission(parts.transmission, self.windows())
        return replace(parts, transmission=outages)


@dataclass(frozen=True)
class RandomOutage:
    """The link is up and down in turn, for exponentially distributed times of these means."""

    mean_up_s: float
    mean_down_s: float
    name: str = "outage"

    def windows(self, random: Random) -> Iterator[Window]:
        """Yield outages without end."""
        now_s = 0.0
        while True:
            begin_s = now_s + random.expovariate(1.0 / self.mean_up_s)
            now_s = begin_s + random.expovariate(1.0 / self.mean_down_s)
            if now_s > begin_s:
                yield begin_s, now_s

    def apply(self, parts: LinkParts, random: Random) -> LinkParts:
        """Interrupt the transmission."""
        outages = OutageTransmission(parts.transmission, self.windows(random))
        return replace(parts, transmission=outages)


class OutageTransmission:
    """Runs ``inner`` on a clock that stands still during ``windows``; time does not run back."""

    def __init__(self, inner: Transmission, windows: Iterator[Window]) -> None:
        self._inner = inner
        self._windows = windows
        self._ahead: deque[Window] = deque()
        self._down_s = 0.0

    def schedule(self, size_bytes: int, at_s: float) -> tuple[float, float]:
        """Return start and end of transmission."""
        up_s, ready_s = self._up_until(at_s)
        start_s, end_s = self._inner.schedule(size_bytes, up_s)
        return max(ready_s, self._wall(start_s)), max(ready_s, self._wall(end_s))

    def _up_until(self, at_s: float) -> tuple[float, float]:
        """Return how long the link was up before ``at_s``, and when it is up from then on."""
        for begin_s, end_s in self._coming():
            if begin_s > at_s:
                break
            if at_s < end_s:
                return begin_s - self._down_s, end_s
            self._down_s += end_s - begin_s
            self._ahead.popleft()
        return at_s - self._down_s, at_s

    def _wall(self, up_s: float) -> float:
        """Return the earliest second at which the link has been up for ``up_s`` seconds."""
        wall_s = up_s + self._down_s
        for begin_s, end_s in self._coming():
            if begin_s >= wall_s:
                break
            wall_s += end_s - begin_s
        return wall_s

    def _coming(self) -> Iterator[Window]:
        """Yield the outages that are not over, in order; drawn as far as somebody looks."""
        yield from tuple(self._ahead)
        for window in self._windows:
            self._ahead.append(window)
            yield window


class JitterDistribution(StrEnum):
    """The distribution that delays are drawn from."""

    UNIFORM = "uniform"
    EXPONENTIAL = "exponential"


@dataclass(frozen=True)
class Jitter:
    """``spread_s`` is the longest delay if uniform, the mean if exponential."""

    spread_s: float
    distribution: JitterDistribution = JitterDistribution.UNIFORM
    name: str = "jitter"

    def __post_init__(self) -> None:
        if not 0.0 <= self.spread_s <= MAX_SPREAD_S:
            raise InvalidInput("jitter", f"{self.spread_s} s is outside 0..{MAX_SPREAD_S:g} s")

    def apply(self, parts: LinkParts, random: Random) -> LinkParts:
        """Add this delay."""

        def delay_s(at_s: float) -> float:  # noqa: ARG001
            if self.distribution is JitterDistribution.UNIFORM:
                return random.uniform(0.0, self.spread_s)
            return self.spread_s * min(LONGEST, random.expovariate(1.0))

        return parts.with_delay(delay_s)


def parse_impairment(name: str, table: Table) -> Outage | RandomOutage | Jitter:
    """Return the impairment that a profile's table of that name declares."""
    if name == "outage":
        return _outage(table)
    spread_s = table.number("spread_ms", Range(0.0, 1e3 * MAX_SPREAD_S)) / 1e3
    named = table.choice("distribution", JitterDistribution, "uniform")
    table.finish()
    return Jitter(spread_s, JitterDistribution(named))


def _outage(table: Table) -> Outage | RandomOutage:
    if "at_s" not in table:
        up_s, down_s = (table.number(f"mean_{name}_s", LENGTH_S) for name in ("up", "down"))
        table.finish("at_s")
        return RandomOutage(up_s, down_s)
    windows = []
    for index, pair in enumerate(table.items("at_s")):
        if not isinstance(pair, list) or len(pair) != 2:
            raise table.error(f"at_s[{index}]", f"is {shortened(pair)}, not [from_s, for_s]")
        begin_s = table.checked(f"at_s[{index}][0]", pair[0], Range(0.0, MAX_S))
        windows.append((begin_s, begin_s + table.checked(f"at_s[{index}][1]", pair[1], LENGTH_S)))
    repeat_s = table.number("repeat_s", LENGTH_S) if "repeat_s" in table else None
    table.finish("repeat_s")
    return Outage(tuple(windows), repeat_s)


UNBOUNDED_BYTES = 2**62
MAX_QUEUE_KIB = 1 << 20
LIFE_S = Range(0.05, 1e6)
IMPAIRMENTS = ("outage", "delay_trace", "jitter")
"""Impairments in the order in which they act, not that of the file; a trace replaces a rate."""


NO_LOSS = PacketLoss(0.0)


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
    loss: PacketLoss | None = None

    def link(self, origin_s: float = 0.0) -> Link[Any]:
        """Return the machine without loss; traces, outages and the like begin at ``origin_s``."""
        parts = LinkParts(ConstantRate(self.profile.rate_bps))
        for impairment in self.impairments:
            parts = impairment.apply(parts, Random(f"{self.seed}/{impairment.name}"))
        return Link(self.profile, parts, origin_s)

    def lossy_link(self, back: DirectionPlan, origin_s: float = 0.0) -> LossyLink[Any]:
        """Return the machine with loss; acknowledgements take the way ``back``."""
        lost, lost_back = ((plan.loss or NO_LOSS).losses for plan in (self, back))
        return LossyLink(
            self.link(origin_s),
            lost(Random(f"{self.seed}/loss")),
            back.profile.delay_s,
            lost_back(Random(f"{self.seed}/loss of acknowledgements")),
        )

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

    @property
    def is_lossy(self) -> bool:
        """Whether packets are lost in a direction."""
        return self.uplink.loss is not None or self.downlink.loss is not None

    def with_loss(self, loss: PacketLoss) -> LinkPlan:
        """Return the plan with this loss in both directions."""
        uplink, downlink = (replace(way, loss=loss) for way in (self.uplink, self.downlink))
        return replace(self, uplink=uplink, downlink=downlink)

    def with_jitter(self, jitter: Jitter) -> LinkPlan:
        """Return the plan with this jitter in both directions, in place of any other."""

        def jittery(way: DirectionPlan) -> DirectionPlan:
            others = [each for each in way.impairments if each.name != jitter.name]
            return replace(way, impairments=(*others, jitter))

        return replace(self, uplink=jittery(self.uplink), downlink=jittery(self.downlink))

    def described(self) -> str:
        """Return the link in a few words: rates, delays, what is lost and what else is done."""
        return "; ".join(
            [
                f"up {_described(self.uplink)}",
                f"down {_described(self.downlink)}",
                *([f"connections cut every {self.mean_life_s:g} s"] if self.mean_life_s else []),
            ]
        )

    def connection_lives_s(self) -> Iterator[float] | None:
        """Return the seconds after which one connection after another is cut; None: never."""
        if self.mean_life_s is None:
            return None
        return _exponential(self.mean_life_s, Random(f"{self.seed}/connection_loss"))


def _described(way: DirectionPlan) -> str:
    profile = way.profile
    words = [f"{profile.rate_bps / 1e6:g} Mbit/s", f"{1e3 * profile.delay_s:g} ms"]
    if way.loss is not None:
        burst = f" in bursts of {way.loss.burst:g}" if way.loss.burst > 1 else ""
        words.append(f"{way.loss.percent:g} % of packets lost{burst}")
    return ", ".join([*words, *(impairment.name for impairment in way.impairments)])


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
    if plan.loss is not None:
        raise InvalidInput("link.loss", f"{plan.loss.percent} %: lossy_link() needs the way back")
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
    >>> from rfcore.link.plan import read_link
    >>> plan = read_link(Path("samples/links/tunnel.toml"))
    >>> plan.uplink.profile.rate_bps, [impairment.name for impairment in plan.uplink.impairments]
    (10000000.0, ['outage'])

    Raises ``InvalidInput`` naming the file, the key, its value and the limit, ``InvalidData`` for a
    file that is no TOML or a trace that is none, ``OSError`` for one that cannot be read.
    """
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
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
    loss = None
    if "loss_percent" in table:
        percent = table.number("loss_percent", Range(0.0, MAX_LOSS_PERCENT))
        loss = PacketLoss(percent, table.number("loss_burst", Range(1.0, 1000.0), 1.0))
    table.finish("rate_mbps", "trace", *IMPAIRMENTS)
    profile = LinkProfile(rate_bps, delay_ms / 1e3, int(queue_kib * 1024))
    return DirectionPlan(profile, tuple(impairments), seed, loss)


def _impairment(name: str, table: Table, folder: Path) -> Any:
    """Return what the table of that name declares."""
    if name in ("trace", "delay_trace"):
        return parse_recording(name, table.table(name), folder)
    return parse_impairment(name, table.table(name))
