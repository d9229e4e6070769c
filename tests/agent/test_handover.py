"""Who takes which picture when servers come, go and publish; ``ready`` is who streams."""

from cav_agent.handover import LOST_AFTER_S, Cause, Handover, Route, Stop
from rfcore.wire.tiles import Area, Tile

NEAR = 2


def stop(
    server: int, west_m: float, east_m: float, version: int = 1, margin_m: float = 4.0
) -> Stop:
    field_id = f"{server}{version}" * 32
    area = Area((west_m, -5.0), (east_m, 5.0))
    return Stop(server, Tile(f"tile-{server}", field_id, version, area, margin_m))


A, B = stop(0, -100, 0), stop(1, 0, 100)
POSITIONS = [(x, 0.0) for x in (-9.0, -6.0, -3.0, -1.0, 3.0, 6.0, 9.0)]
"""Home is A up to number 3 and B from number 4; number 3 is the last within reach of B."""


def handover(*stops: Stop) -> Handover:
    return Handover(Route(stops or (A, B), POSITIONS), NEAR)


def test_the_next_stream_is_opened_before_the_border_and_the_last_is_let_go_after_it() -> None:
    trip = handover()
    assert trip.wanted(2, {A}, 0.0) == [A]
    assert trip.wanted(3, {A}, 0.0) == [A, B]
    assert trip.choose(3, {A, B}, 0.0) == (A, None), "no picture goes over before the border"
    assert trip.choose(4, {A, B}, 0.0) == (B, Cause.TILE)
    assert trip.wanted(5, {A, B}, 0.0) == [B]


def test_a_server_that_has_not_welcomed_us_yet_is_waited_for_where_we_were() -> None:
    trip = handover()
    trip.choose(3, {A}, 0.0)
    assert trip.choose(4, {A}, 0.0) == (A, None), "3 m into a margin of 4 m"
    assert A in trip.wanted(4, {A}, 0.0)
    assert trip.choose(5, {A, B}, 0.1) == (B, Cause.TILE)


def test_beyond_the_margin_a_picture_waits_at_home() -> None:
    trip = handover()
    trip.choose(4, {A}, 0.0)
    assert trip.choose(5, {A}, 0.1)[0] == B


def test_a_lost_server_is_replaced_by_a_neighbour_within_reach_but_not_for_a_blink() -> None:
    trip = handover()
    trip.choose(2, {A}, 0.0)
    assert trip.choose(3, {B}, 0.1) == (A, None)
    later_s = 0.1 + LOST_AFTER_S
    assert trip.wanted(3, set(), later_s) == [A, B]
    assert trip.choose(3, {B}, later_s) == (B, Cause.SERVER_LOST)
    assert trip.choose(3, {A, B}, later_s + 0.1) == (A, Cause.TILE), "home again when it is back"


def test_what_has_not_begun_is_not_lost() -> None:
    """Fields take longer to fetch than a server may be silent."""
    trip = handover()
    assert trip.wanted(3, set(), 0.0) == trip.wanted(3, set(), 60.0) == [A, B]
    assert trip.wanted(0, set(), 120.0) == [A]


def test_out_of_reach_of_every_neighbour_the_newest_picture_waits_at_home() -> None:
    trip = handover()
    trip.choose(0, {A}, 0.0)
    trip.choose(0, set(), 1.0)
    assert trip.choose(1, {B}, 1.0 + LOST_AFTER_S) == (A, None)


def test_another_version_takes_over_when_it_is_ready_and_not_before() -> None:
    trip = handover(A)
    trip.choose(0, {A}, 0.0)
    newer = stop(0, -100, 0, version=2)
    trip.follow(Route([newer], POSITIONS))
    assert trip.choose(1, {A}, 0.1) == (A, None)
    assert trip.choose(1, {A}, 9.0) == (A, None), "however long it takes: the last good one"
    assert set(trip.wanted(1, {A}, 9.0)) == {A, newer}
    assert trip.choose(2, {A, newer}, 9.1) == (newer, Cause.TILE)
    assert trip.wanted(3, {A, newer}, 9.1) == [newer]
