"""Which resource broke first in a run that was not held, or would in one that was, and its use.

Each resource has a share that it can be used to before others wait for it. The generator comes
first among those beyond it: where the test's own vehicles are the limit, nothing is said about the
server.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

__all__ = ["Resources", "limit", "nearest"]

BUSY = 0.85
"""A core, a link or a worker that is busier than this makes others wait: at 85 % the mean queue of
an M/D/1 server is already three services long."""

MACHINE_BUSY = 0.95
OTHERS = 0.3
"""Cores; a run beside more than this says little about an idle machine."""

LAG_MS = 20.0
"""A generator whose own event loop is later than this measures itself."""


@dataclass(frozen=True)
class Resources:
    """How busy everything was, as shares of what it has (0..1), and how late the generator was.

    ``server_loop``: the server's event loop, of one core; ``workers``: the server's other threads,
    of the cores they can have; ``link``: the busiest vehicle's uplink; ``generator``: the busiest
    process that plays vehicles or links, of one core (0 for live vehicles: they are what is
    tested). ``machine``: all cores, of which the test's own processes used the share ``test``, and
    others ``others`` cores.
    """

    server_loop: float
    workers: float
    link: float
    generator: float
    machine: float
    test: float
    others: float
    generator_lag_ms: float


@dataclass(frozen=True)
class Use:
    """What a resource was used to (``share``), of what it bears; ``said`` names both."""

    said: str
    share: float
    bearable: float

    @property
    def is_over(self) -> bool:
        """Whether others had to wait for it."""
        return self.share > self.bearable


def limit(resources: Resources) -> str:
    """Name the first resource that was at its limit and its use, else the one nearest to it."""
    r = resources
    machine = Use(
        f"CPU of the machine, at {_percent(r.machine)}{_beside(r)}", r.machine, MACHINE_BUSY
    )
    uses = (_lag(r), *_on_one_core(r), machine, _workers(r))
    over = next((use for use in uses if use.is_over), None)
    return over.said if over is not None else f"nearest: {_fullest(uses)}"


def nearest(resources: Resources) -> str:
    """Name the resource that a load which was held would break first, and its use.

    What others use of the machine is left out: where they run behind the test, they fill it.
    """
    r = resources
    machine = Use(f"CPU of the machine, at {_percent(r.test)}", r.test, MACHINE_BUSY)
    return f"nearest: {_fullest((*_on_one_core(r), machine, _workers(r)))}"


def _fullest(uses: Sequence[Use]) -> str:
    return max(uses, key=lambda use: use.share / use.bearable).said


def _on_one_core(r: Resources) -> tuple[Use, ...]:
    return (
        Use(f"vehicles of the test, at {_percent(r.generator)} of a core", r.generator, BUSY),
        Use(f"link of the busiest vehicle, at {_percent(r.link)}", r.link, BUSY),
        Use(f"server's event loop, at {_percent(r.server_loop)} of a core", r.server_loop, BUSY),
    )


def _workers(r: Resources) -> Use:
    return Use(f"server's workers, at {_percent(r.workers)}", r.workers, BUSY)


def _lag(r: Resources) -> Use:
    """A generator that was late although there was a core for it."""
    late = r.generator_lag_ms if r.machine < MACHINE_BUSY else 0.0
    return Use(f"vehicles of the test, {late:.0f} ms late themselves", late, LAG_MS)


def _beside(r: Resources) -> str:
    return f", {r.others:.1f} cores of it by others" if r.others > OTHERS else ""


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"
