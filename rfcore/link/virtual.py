"""The link on a virtual clock: exact delivery times, at once.

For experiments. Sizes are packet bytes (pose + header + payload), as the paper's tau has them;
the proxy on real sockets counts wire bytes instead.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from rfcore.errors import InvalidInput
from rfcore.link.plan import DirectionPlan
from rfcore.link.profile import LinkProfile

__all__ = ["Arrival", "delivery_times"]


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
