"""Add a building site at the edge of the road: a board fence, containers and a heap of gravel.

Nothing parks in the bays that the site covers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from rfcore.errors import InvalidInput
from rfcore.tables import Range
from streetgen.classes import Label
from streetgen.geometry.layout import KERB_M, ROAD_HALF_M, Closure, GroundSpot
from streetgen.geometry.mesh import Material, Mesh
from streetgen.geometry.solids import Surface, boxes, tube
from streetgen.geometry.world import StreetPart, World

NEAR_M, FAR_M = 4.1, ROAD_HALF_M - KERB_M
"""The site lies between these distances from the middle of the road, where the parking bays are. In
a wider street it is farther out."""
BOARD_M, BOARD_UP_M, BOARD_THICK_M = 2.0, 1.1, 0.04
HEAP_M = 5.2
CONTAINER_M = (6.06, 2.0, 2.59)
BOARDS = (Surface("board-red", Label.OBJECT), Surface("board-white", Label.OBJECT))
CONTAINER = Surface("container", Label.OBJECT)
GRAVEL = Surface("gravel", Label.OBJECT)
MATERIALS = (
    Material("board-red", (0.55, 0.05, 0.04)),
    Material("board-white", (0.75, 0.75, 0.73)),
    Material("container", (0.06, 0.16, 0.3), roughness=0.5),
    Material("gravel", (0.36, 0.33, 0.29)),
)


@dataclass(frozen=True)
class Works:
    """The site's begin along x, its length, and its number of ``containers`` in a row.

    It is on the left of the road for ``side`` 1, on the right for -1.
    """

    start_m: Annotated[float, Range(-1000, 1000)] = 4.0
    length_m: Annotated[float, Range(4, 200)] = 22.0
    side: Annotated[int, Range(-1, 1)] = 1
    containers: Annotated[int, Range(0, 20)] = 2

    def __post_init__(self) -> None:
        if self.side == 0:
            raise InvalidInput("side", "is 0, neither 1 (left) nor -1 (right)")

    def change(self, world: World, rng: np.random.Generator) -> World:
        """Return the world with the site in it."""
        closed = Closure(self.side, self.start_m, self.start_m + self.length_m)
        layout = replace(world.layout, closures=(*world.layout.closures, closed))
        wider_m = world.layout.geometry.wider_m
        meshes = [*_fence(closed, wider_m), *self._inside(closed, wider_m, rng)]
        return replace(world, layout=layout).plus(StreetPart(tuple(meshes), MATERIALS))

    def _inside(self, closed: Closure, wider_m: float, rng: np.random.Generator) -> list[Mesh]:
        length, width, height = CONTAINER_M
        meshes, x = [], closed.start_m + 0.5
        for _ in range(self.containers):
            if x + length > closed.end_m - 0.5:
                break
            y = closed.side * (FAR_M + wider_m - 0.5 * width)
            low, high = (x, y - 0.5 * width, 0.0), (x + length, y + 0.5 * width, height)
            meshes.append(boxes(CONTAINER, low, high))
            x += length + 0.3
        if x + 2.4 < closed.end_m:
            y = closed.side * (HEAP_M + wider_m)
            meshes.append(_heap(GroundSpot(x + 1.4, y, 0.0, closed.side, 0.0), rng))
        return meshes


def _fence(closed: Closure, wider_m: float) -> list[Mesh]:
    """Return boards in two alternating colours, along the lane and across both ends."""
    xs = np.arange(closed.start_m, closed.end_m - 1e-6, BOARD_M)
    near, far = sorted(closed.side * (y + wider_m) for y in (NEAR_M, FAR_M))
    lane_y = closed.side * (NEAR_M + wider_m)
    meshes = []
    for turn, board in enumerate(BOARDS):
        x = xs[turn::2]
        low = np.stack([x, 0 * x + lane_y, 0 * x + 0.05], axis=1)
        ends = np.minimum(x + BOARD_M, closed.end_m)
        high = np.stack([ends, 0 * x + lane_y + BOARD_THICK_M, 0 * x + BOARD_UP_M], axis=1)
        end = (closed.start_m, closed.end_m)[turn]
        across = boxes(board, (end, near, 0.05), (end + BOARD_THICK_M, far, BOARD_UP_M))
        meshes += [boxes(board, low, high), across] if len(x) else [across]
    return meshes


def _heap(place: GroundSpot, rng: np.random.Generator) -> Mesh:
    """Return a cone of gravel with uneven slopes."""
    up = np.linspace(0.0, rng.uniform(1.0, 1.5), 6)
    path = np.stack([0 * up + place.x_m, 0 * up + place.y_m, up], axis=1)
    radii = np.linspace(1.1, 0.02, 6) * rng.uniform(0.9, 1.0, 6)
    return tube(GRAVEL, path, radii, 14)
