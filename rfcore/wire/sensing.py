"""What a frame says of its own sensing: what its time rests on, and how its pose was come by.

Both are for those who look at the twin; nothing is decoded by them. A number that this end does not
know, from a newer peer, counts as not stated.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Final

from rfcore.localise.estimate import LocalisationState
from rfcore.wire.v1 import edge_pb2 as pb

__all__ = [
    "ClockKind",
    "clock_from_wire",
    "clock_to_wire",
    "localisation_from_wire",
    "localisation_to_wire",
]


class ClockKind(StrEnum):
    """What a live camera's time of capture rests on."""

    SENDER_REPORT = "sender_report"
    ARRIVAL = "arrival"


CLOCKS: Final = {
    ClockKind.SENDER_REPORT: pb.CAPTURE_CLOCK_SENDER_REPORT,
    ClockKind.ARRIVAL: pb.CAPTURE_CLOCK_ARRIVAL,
}
STATES: Final = {
    LocalisationState.LOST: pb.LOCALISATION_LOST,
    LocalisationState.LOCALISING: pb.LOCALISATION_LOCALISING,
    LocalisationState.TRACKING: pb.LOCALISATION_TRACKING,
}
CLOCK_OF: Final[dict[int, ClockKind]] = {number: clock for clock, number in CLOCKS.items()}
STATE_OF: Final[dict[int, LocalisationState]] = {number: state for state, number in STATES.items()}


def clock_to_wire(clock: ClockKind | None) -> pb.CaptureClock.ValueType:
    """Return the number of ``clock``; 0 for none."""
    return pb.CAPTURE_CLOCK_UNSPECIFIED if clock is None else CLOCKS[clock]


def clock_from_wire(number: int) -> ClockKind | None:
    """Return which clock ``number`` stands for, if any."""
    return CLOCK_OF.get(number)


def localisation_to_wire(state: LocalisationState | None) -> pb.Localisation.ValueType:
    """Return the number of ``state``; 0 for none: the pose was given."""
    return pb.LOCALISATION_UNSPECIFIED if state is None else STATES[state]


def localisation_from_wire(number: int) -> LocalisationState | None:
    """Return which state ``number`` stands for, if any."""
    return STATE_OF.get(number)
