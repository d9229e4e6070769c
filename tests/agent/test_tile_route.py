"""Pictures belong to the tile they were taken on."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cav_agent.handover import LEAVE_SHARE, ServedTile, TileRoute
from rfcore.errors import InvalidInput
from rfcore.wire.tiles import Area, Tile

MARGIN_M = 8.0


def tile(name: str, west_m: float, east_m: float) -> Tile:
    return Tile(name, "ab" * 32, 1, Area((west_m, -5.0), (east_m, 5.0)), MARGIN_M)


WEST, EAST = ServedTile(0, tile("west", -100, 0)), ServedTile(1, tile("east", 0, 100))


def along(*east_m: float) -> list[tuple[float, float]]:
    return [(x, 0.0) for x in east_m]


def test_a_drive_passes_from_tile_to_tile() -> None:
    route = TileRoute([WEST, EAST], along(-20, -10, 10, 20))
    assert route.assigned == (WEST, WEST, EAST, EAST)
    assert route.ahead(1, 2) == [WEST, EAST]
    assert route.ahead(3, 2) == [EAST, WEST], "after the last picture comes the first"


def test_driving_along_a_border_does_not_alternate_between_tiles() -> None:
    inside_m = LEAVE_SHARE * MARGIN_M * 0.9
    route = TileRoute([WEST, EAST], along(-1, inside_m, -1, inside_m, 20, -inside_m))
    assert route.assigned == (WEST, WEST, WEST, WEST, EAST, EAST)


def test_a_neighbour_is_in_range_as_far_as_its_margin() -> None:
    route = TileRoute([WEST, EAST], along(-20, -MARGIN_M, -1, 1))
    assert [route.in_range(i) for i in range(4)] == [
        [WEST],
        [WEST, EAST],
        [WEST, EAST],
        [EAST, WEST],
    ]


def test_a_tile_without_area_is_everywhere() -> None:
    everywhere = ServedTile(0, Tile("street", "cd" * 32))
    route = TileRoute([everywhere], along(-1e9, 0, 1e9))
    assert set(route.assigned) == {everywhere}


@given(st.lists(st.floats(-150, 150), min_size=1, max_size=20))
def test_the_assigned_tile_is_never_farther_than_staying_allows(east_m: list[float]) -> None:
    route = TileRoute([WEST, EAST], along(*east_m))
    for assigned, position in zip(route.assigned, along(*east_m), strict=True):
        nearest_m = min(served.tile.distance_m(*position) for served in route.tiles)
        allowed_m = max(nearest_m, LEAVE_SHARE * MARGIN_M)
        assert assigned.tile.distance_m(*position) <= allowed_m


def test_a_route_needs_tiles_and_positions() -> None:
    with pytest.raises(InvalidInput, match="0 tiles"):
        TileRoute([], along(0))
    with pytest.raises(InvalidInput, match="0 positions"):
        TileRoute([WEST], [])
