"""Which server's tile serves which picture of a drive.

A stop is one tile of one server. A picture belongs to the stop whose ground it was taken on; a
vehicle that leaves that ground stays for a share of the margin, so that driving along a border is
no coming and going. Positions are (east, north) in metres, in the drive's own global frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rfcore.errors import InvalidInput
from rfcore.wire.tiles import Tile

__all__ = ["Route", "Stop"]

LEAVE_SHARE = 0.25
"""Of a tile's margin, how far a vehicle drives into it before another tile takes over."""

Position = tuple[float, float]


@dataclass(frozen=True)
class Stop:
    """Tile ``tile`` of server number ``server``."""

    server: int
    tile: Tile


class Route:
    """A drive past ``stops``: ``home[i]`` is the stop that picture i belongs to."""

    def __init__(self, stops: Sequence[Stop], positions: Sequence[Position]) -> None:
        if not stops or not positions:
            raise InvalidInput("route", f"{len(stops)} stops, {len(positions)} positions")
        self.stops = tuple(stops)
        self._positions = tuple(positions)
        self.home = _homes(self.stops, self._positions)

    def __len__(self) -> int:
        return len(self._positions)

    def reaching(self, index: int) -> list[Stop]:
        """Return the stops that picture ``index`` may be sent to, the nearest ground first."""
        position = self._positions[index % len(self)]
        within = [stop for stop in self.stops if self.within(stop, index)]
        return sorted(within, key=lambda stop: stop.tile.distance_m(*position))

    def within(self, stop: Stop, index: int) -> bool:
        """Whether picture ``index`` may be sent to ``stop``, which may be one of an older route."""
        return stop.tile.reaches(*self._positions[index % len(self)])

    def ahead(self, index: int, pictures: int) -> list[Stop]:
        """Return the homes of the next ``pictures`` pictures, each once, in their order."""
        count = min(pictures, len(self))
        return list(dict.fromkeys(self.home[(index + i) % len(self)] for i in range(count)))


def _homes(stops: Sequence[Stop], positions: Sequence[Position]) -> tuple[Stop, ...]:
    homes: list[Stop] = []
    for position in positions:
        nearest = min(stops, key=lambda stop: stop.tile.distance_m(*position))
        if homes and _stays(homes[-1].tile, position):
            nearest = homes[-1]
        homes.append(nearest)
    return tuple(homes)


def _stays(tile: Tile, position: Position) -> bool:
    return tile.distance_m(*position) <= LEAVE_SHARE * tile.margin_m
