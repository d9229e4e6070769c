"""Who codes the next picture: a machine without clock, sockets or tasks.

``choose`` gives each captured picture to one stop; ``wanted`` says to which stops a stream should
be open: where the vehicle is, where it will be within moments, so that the first picture there
finds its stream open, and a neighbour when home has not answered for a while. A picture that nobody
can take stays at home, where the newest wins.

Which server's tile serves which picture of a drive.

A stop is one tile of one server. A picture belongs to the stop whose ground it was taken on; a
vehicle that leaves that ground stays for a share of the margin, so that driving along a border is
no coming and going. Positions are (east, north) in metres, in the drive's own global frame.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from enum import StrEnum

from rfcore.errors import InvalidInput
from rfcore.wire.tiles import Tile

__all__ = ["LOST_AFTER_S", "Cause", "Handover", "Route", "Stop"]


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


LOST_AFTER_S = 1.0
"""A server that is silent for so long is given up for a neighbour; a blink is waited for."""


class Cause(StrEnum):
    """Why a vehicle went to another stop."""

    TILE = "tile"
    SERVER_LOST = "server_lost"


class Handover:
    """Follows ``route``; ``near`` pictures ahead a stream is opened."""

    def __init__(self, route: Route, near: int) -> None:
        self.route = route
        self.in_charge: Stop | None = None
        self._near = near
        self._absent_since_s: float | None = None

    def follow(self, route: Route) -> None:
        """Go on along another route: other tiles are published."""
        self.route = route

    def wanted(self, index: int, ready: Collection[Stop], now: float) -> list[Stop]:
        """Return the stops to hold a stream to while picture ``index`` is next."""
        ahead = self.route.ahead(index, self._near)
        home = ahead[0]
        self._watch(home, ready, now)
        if self._is_lost(now):
            ahead += [stop for stop in self.route.reaching(index) if stop not in ahead]
        leaving = self.in_charge
        if home not in ready and leaving in ready and leaving is not None and leaving not in ahead:
            ahead.append(leaving)
        return ahead

    def taker(self, index: int, ready: Collection[Stop], now: float) -> Stop:
        """Return who would take picture ``index``."""
        home = self.route.home[index % len(self.route)]
        self._watch(home, ready, now)
        return home if home in ready else self._substitute(index, ready, now) or home

    def choose(self, index: int, ready: Collection[Stop], now: float) -> tuple[Stop, Cause | None]:
        """Return who takes picture ``index``, and why it is another than before."""
        chosen = self.taker(index, ready, now)
        before, self.in_charge = self.in_charge, chosen
        if before is None or before == chosen:
            return chosen, None
        at_home = chosen == self.route.home[index % len(self.route)]
        return chosen, Cause.TILE if at_home else Cause.SERVER_LOST

    def _substitute(self, index: int, ready: Collection[Stop], now: float) -> Stop | None:
        staying = self.in_charge
        if staying is not None and staying in ready and self.route.within(staying, index):
            return staying
        if not self._is_lost(now):
            return None
        return next((stop for stop in self.route.reaching(index) if stop in ready), None)

    def _watch(self, home: Stop, ready: Collection[Stop], now: float) -> None:
        if home in ready or self.in_charge is None:  # what has not begun is not lost
            self._absent_since_s = None
        elif self._absent_since_s is None:
            self._absent_since_s = now

    def _is_lost(self, now: float) -> bool:
        since_s = self._absent_since_s
        return since_s is not None and now - since_s >= LOST_AFTER_S
