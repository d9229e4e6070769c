"""Decides which server's tile takes each picture of a drive, and which streams are held open.

``TileRoute`` assigns every picture of a drive to the tile on whose ground it was taken. A vehicle
that leaves a tile stays with it for a share of the tile's margin, so that driving along a border
does not alternate between two tiles. ``Handover`` follows that route with the servers as they are:
``choose`` gives a captured picture to one tile; ``wanted`` lists the tiles to which a stream should
be open: the assigned one, those of the next moments, so that the first picture there finds its
stream open, and a neighbour once the assigned server has been lost for a while. A picture that no
server can take stays with its assigned tile, where the newest wins.

A state machine without clock, sockets or tasks.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from enum import StrEnum

from cav_agent.cameras import Position
from rfcore.errors import InvalidInput
from rfcore.wire.tiles import Tile

LEAVE_SHARE = 0.25
"""Share of a tile's margin that a vehicle drives into before another tile takes over."""

LOST_AFTER_S = 1.0
"""A server that is silent for so long is replaced by a neighbour; a shorter pause is waited for."""


@dataclass(frozen=True)
class ServedTile:
    """Tile ``tile`` as published by server number ``server``."""

    server: int
    tile: Tile


class TileRoute:
    """A drive across ``tiles``: ``assigned[i]`` is the tile that picture i belongs to."""

    def __init__(self, tiles: Sequence[ServedTile], positions: Sequence[Position]) -> None:
        if not tiles or not positions:
            raise InvalidInput("route", f"{len(tiles)} tiles, {len(positions)} positions")
        self.tiles = tuple(tiles)
        self._positions = tuple(positions)
        self.assigned = _assign(self.tiles, self._positions)

    def __len__(self) -> int:
        return len(self._positions)

    def in_range(self, index: int) -> list[ServedTile]:
        """Return the tiles that picture ``index`` may be sent to, the nearest ground first."""
        position = self._positions[index % len(self)]
        covering = [served for served in self.tiles if self.covers(served, index)]
        return sorted(covering, key=lambda served: served.tile.distance_m(*position))

    def covers(self, served: ServedTile, index: int) -> bool:
        """Return whether picture ``index`` may be sent to a tile, also one of an older route."""
        return served.tile.reaches(*self._positions[index % len(self)])

    def ahead(self, index: int, pictures: int) -> list[ServedTile]:
        """Return the tiles of the next ``pictures`` pictures, each once, in their order."""
        count = min(pictures, len(self))
        return list(dict.fromkeys(self.assigned[(index + i) % len(self)] for i in range(count)))


def _assign(tiles: Sequence[ServedTile], positions: Sequence[Position]) -> tuple[ServedTile, ...]:
    assigned: list[ServedTile] = []
    for position in positions:
        nearest = min(tiles, key=lambda served: served.tile.distance_m(*position))
        if assigned and _stays(assigned[-1].tile, position):
            nearest = assigned[-1]
        assigned.append(nearest)
    return tuple(assigned)


def _stays(tile: Tile, position: Position) -> bool:
    return tile.distance_m(*position) <= LEAVE_SHARE * tile.margin_m


class HandoverCause(StrEnum):
    """Reason why a picture goes to another tile than the one before."""

    TILE = "tile"
    SERVER_LOST = "server_lost"


class Handover:
    """Follows ``route``; a stream is opened ``near`` pictures before its first one."""

    def __init__(self, route: TileRoute, near: int) -> None:
        self.route = route
        self.current: ServedTile | None = None
        """The tile that took the last picture."""
        self.draining: frozenset[ServedTile] = frozenset()
        """The tiles whose servers are draining; they take pictures until others do."""
        self._near = near
        self._absent_since_s: float | None = None

    def follow(self, route: TileRoute) -> None:
        """Go on along another route: other tiles are published."""
        self.route = route

    def wanted(self, index: int, streaming: Collection[ServedTile], now: float) -> list[ServedTile]:
        """Return the tiles to hold a stream to while picture ``index`` is next.

        ``streaming``: the tiles whose server takes pictures now.
        """
        wanted = self.route.ahead(index, self._near)
        assigned, current = wanted[0], self.current
        self._watch(assigned, streaming, now)
        if self._is_lost(now) or assigned in self.draining:
            wanted += [served for served in self.route.in_range(index) if served not in wanted]
        is_needed = assigned not in streaming and current in streaming
        if is_needed and current is not None and current not in wanted:
            wanted.append(current)
        return wanted

    def candidate(self, index: int, streaming: Collection[ServedTile], now: float) -> ServedTile:
        """Return the tile that would take picture ``index``."""
        assigned = self.route.assigned[index % len(self.route)]
        self._watch(assigned, streaming, now)
        if assigned in streaming and assigned not in self.draining:
            return assigned
        return self._substitute(index, streaming, now) or assigned

    def choose(
        self, index: int, streaming: Collection[ServedTile], now: float
    ) -> tuple[ServedTile, HandoverCause | None]:
        """Return the tile that takes picture ``index``, and why if it is another than before."""
        chosen = self.candidate(index, streaming, now)
        before, self.current = self.current, chosen
        if before is None or before == chosen:
            return chosen, None
        is_assigned = chosen == self.route.assigned[index % len(self.route)]
        return chosen, HandoverCause.TILE if is_assigned else HandoverCause.SERVER_LOST

    def _substitute(
        self, index: int, streaming: Collection[ServedTile], now: float
    ) -> ServedTile | None:
        current, assigned = self.current, self.route.assigned[index % len(self.route)]
        is_here = current in streaming and current is not None and self.route.covers(current, index)
        if is_here and current not in self.draining:
            return current
        if self._is_lost(now) or assigned in self.draining:
            staying = set(streaming) - self.draining
            substitute = next((t for t in self.route.in_range(index) if t in staying), None)
            if substitute is not None:
                return substitute
        return current if is_here else None

    def _watch(self, assigned: ServedTile, streaming: Collection[ServedTile], now: float) -> None:
        if assigned in streaming or self.current is None:  # what has not begun is not lost
            self._absent_since_s = None
        elif self._absent_since_s is None:
            self._absent_since_s = now

    def _is_lost(self, now: float) -> bool:
        since_s = self._absent_since_s
        return since_s is not None and now - since_s >= LOST_AFTER_S
