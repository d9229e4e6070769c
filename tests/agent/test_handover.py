"""Which tile each picture belongs to, and which takes it when servers come, go and publish anew."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cav_agent.handover import (
    LEAVE_SHARE,
    LOST_AFTER_S,
    Handover,
    HandoverCause,
    ServedTile,
    TileRoute,
)
from rfcore.errors import InvalidInput
from rfcore.wire.tiles import Area, Tile

NEAR = 2
MARGIN_M = 4.0


def served(
    server: int, west_m: float, east_m: float, version: int = 1, margin_m: float = MARGIN_M
) -> ServedTile:
    field_id = f"{server}{version}" * 32
    area = Area((west_m, -5.0), (east_m, 5.0))
    return ServedTile(server, Tile(f"tile-{server}", field_id, version, area, margin_m))


A, B = served(0, -100, 0), served(1, 0, 100)
POSITIONS = [(x, 0.0) for x in (-9.0, -6.0, -3.0, -1.0, 3.0, 6.0, 9.0)]
"""A is assigned up to number 3 and B from number 4; B's margin also covers numbers 2 and 3."""


# --- the tiles of a drive


def along(*east_m: float) -> list[tuple[float, float]]:
    return [(x, 0.0) for x in east_m]


def test_a_drive_passes_from_tile_to_tile() -> None:
    route = TileRoute([A, B], along(-20, -10, 10, 20))
    assert route.assigned == (A, A, B, B)
    assert route.ahead(1, 2) == [A, B]
    assert route.ahead(3, 2) == [B, A], "after the last picture comes the first"


def test_driving_along_a_border_does_not_alternate_between_tiles() -> None:
    inside_m = LEAVE_SHARE * MARGIN_M * 0.9
    route = TileRoute([A, B], along(-1, inside_m, -1, inside_m, 20, -inside_m))
    assert route.assigned == (A, A, A, A, B, B)


def test_a_neighbour_is_in_range_as_far_as_its_margin() -> None:
    route = TileRoute([A, B], along(-20, -MARGIN_M, -1, 1))
    assert [route.in_range(i) for i in range(4)] == [
        [A],
        [A, B],
        [A, B],
        [B, A],
    ]


def test_a_tile_without_area_is_everywhere() -> None:
    everywhere = ServedTile(0, Tile("street", "cd" * 32))
    route = TileRoute([everywhere], along(-1e9, 0, 1e9))
    assert set(route.assigned) == {everywhere}


@given(st.lists(st.floats(-150, 150), min_size=1, max_size=20))
def test_the_assigned_tile_is_never_farther_than_staying_allows(east_m: list[float]) -> None:
    route = TileRoute([A, B], along(*east_m))
    for assigned, position in zip(route.assigned, along(*east_m), strict=True):
        nearest_m = min(served.tile.distance_m(*position) for served in route.tiles)
        allowed_m = max(nearest_m, LEAVE_SHARE * MARGIN_M)
        assert assigned.tile.distance_m(*position) <= allowed_m


def test_a_route_needs_tiles_and_positions() -> None:
    with pytest.raises(InvalidInput, match="0 tiles"):
        TileRoute([], along(0))
    with pytest.raises(InvalidInput, match="0 positions"):
        TileRoute([A], [])


# --- servers that come and go


def handover(*tiles: ServedTile) -> Handover:
    return Handover(TileRoute(tiles or (A, B), POSITIONS), NEAR)


def test_the_next_stream_is_opened_before_the_border_and_the_last_is_let_go_after_it() -> None:
    vehicle = handover()
    assert vehicle.wanted(2, {A}, 0.0) == [A]
    assert vehicle.wanted(3, {A}, 0.0) == [A, B]
    assert vehicle.choose(3, {A, B}, 0.0) == (A, None), "no picture goes over before the border"
    assert vehicle.choose(4, {A, B}, 0.0) == (B, HandoverCause.TILE)
    assert vehicle.wanted(5, {A, B}, 0.0) == [B]


def test_a_server_that_has_not_welcomed_us_yet_is_waited_for_where_we_were() -> None:
    vehicle = handover()
    vehicle.choose(3, {A}, 0.0)
    assert vehicle.choose(4, {A}, 0.0) == (A, None), "3 m into a margin of 4 m"
    assert A in vehicle.wanted(4, {A}, 0.0)
    assert vehicle.choose(5, {A, B}, 0.1) == (B, HandoverCause.TILE)


def test_beyond_the_margin_a_picture_waits_for_its_assigned_tile() -> None:
    vehicle = handover()
    vehicle.choose(4, {A}, 0.0)
    assert vehicle.choose(5, {A}, 0.1)[0] == B


def test_a_lost_server_is_replaced_by_a_neighbour_in_range_but_not_for_a_short_pause() -> None:
    vehicle = handover()
    vehicle.choose(2, {A}, 0.0)
    assert vehicle.choose(3, {B}, 0.1) == (A, None)
    later_s = 0.1 + LOST_AFTER_S
    assert vehicle.wanted(3, set(), later_s) == [A, B]
    assert vehicle.choose(3, {B}, later_s) == (B, HandoverCause.SERVER_LOST)
    back = vehicle.choose(3, {A, B}, later_s + 0.1)
    assert back == (A, HandoverCause.TILE), "to the assigned server when it is back"


def test_what_has_not_begun_is_not_lost() -> None:
    """Fields take longer to fetch than a server may be silent."""
    vehicle = handover()
    assert vehicle.wanted(3, set(), 0.0) == vehicle.wanted(3, set(), 60.0) == [A, B]
    assert vehicle.wanted(0, set(), 120.0) == [A]


def test_out_of_range_of_every_neighbour_the_newest_picture_waits_for_its_tile() -> None:
    vehicle = handover()
    vehicle.choose(0, {A}, 0.0)
    vehicle.choose(0, set(), 1.0)
    assert vehicle.choose(1, {B}, 1.0 + LOST_AFTER_S) == (A, None)


def test_another_version_takes_over_when_it_is_ready_and_not_before() -> None:
    vehicle = handover(A)
    vehicle.choose(0, {A}, 0.0)
    newer = served(0, -100, 0, version=2)
    vehicle.follow(TileRoute([newer], POSITIONS))
    assert vehicle.choose(1, {A}, 0.1) == (A, None)
    assert vehicle.choose(1, {A}, 9.0) == (A, None), "however long it takes: the last good one"
    assert set(vehicle.wanted(1, {A}, 9.0)) == {A, newer}
    assert vehicle.choose(2, {A, newer}, 9.1) == (newer, HandoverCause.TILE)
    assert vehicle.wanted(3, {A, newer}, 9.1) == [newer]


def test_a_server_that_drains_takes_pictures_until_a_neighbour_in_range_streams() -> None:
    vehicle = handover()
    vehicle.choose(2, {A}, 0.0)
    vehicle.draining = frozenset({A})
    assert vehicle.wanted(3, {A}, 0.1) == [A, B], "at once, not after a pause"
    assert vehicle.choose(3, {A}, 0.1) == (A, None)
    assert vehicle.choose(3, {A, B}, 0.2) == (B, HandoverCause.SERVER_LOST)
    vehicle.draining = frozenset({A, B})
    assert vehicle.choose(3, {A, B}, 0.3) == (B, None), "where all drain, nothing is gained"


def test_a_server_that_drains_is_not_left_for_one_out_of_range() -> None:
    vehicle = handover()
    vehicle.choose(0, {A}, 0.0)
    vehicle.draining = frozenset({A})
    assert vehicle.choose(1, {A, B}, 0.1) == (A, None)
