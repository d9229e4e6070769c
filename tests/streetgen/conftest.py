"""A street small enough to be rendered in a test."""

import numpy as np
import pytest

from streetgen.classes import Label
from streetgen.geometry.layout import Geometry, Layout
from streetgen.geometry.mesh import Material
from streetgen.geometry.solids import Surface, boxes, quads
from streetgen.geometry.world import Sky, StreetPart, World


@pytest.fixture(scope="session")
def yard() -> World:
    """A chequered floor, a glossy box from (4, 1, 0) to (6, 2, 1.5), a wall at x = 10, and sun."""
    board = np.indices((8, 8)).sum(axis=0) % 2
    tiles = np.repeat((60 + 120 * board).astype(np.uint8)[..., None], 3, axis=2)
    sky = np.full((32, 64, 3), 0.4, np.float32)
    floor = [(-40, -40, 0), (40, -40, 0), (40, 40, 0), (-40, 40, 0)]
    uv = [(x / 4, -y / 4) for x, y, _ in floor]
    part = StreetPart(
        (
            quads(Surface("tiles", Label.ROAD), [floor], [uv]),
            boxes(Surface("lacquer", Label.VEHICLE), (4, 1, 0), (6, 2, 1.5)),
            quads(
                Surface("wall", Label.BUILDING),
                [[(10, 9, 0), (10, -9, 0), (10, -9, 3), (10, 9, 3)]],
            ),
        ),
        (
            Material("tiles", tiles),
            Material("lacquer", (0.1, 0.2, 0.5), gloss=True),
            Material("wall", (0.6, 0.5, 0.4)),
        ),
    )
    sun = Sky(sky, (0.0, -0.6, 0.8), (6e4, 6e4, 6e4))
    return World(Layout(Geometry(length_m=20.0)), sun).plus(part)
