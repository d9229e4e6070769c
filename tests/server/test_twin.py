"""The twin holds the newest picture of every camera; a mailbox the newest nobody has taken."""

from collections.abc import Callable
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mec_server.twin.rendering import viewed_tile
from mec_server.twin.state import (
    KEPT_EVERY_S,
    KEPT_S,
    PAST_S,
    KeptRenders,
    Mailbox,
    PastPictures,
    ReceivedPicture,
    Twin,
)
from rfcore.camera import Intrinsics, TileOrigin
from rfcore.errors import InvalidInput
from rfcore.field.quality import Quality
from rfcore.image import I420
from rfcore.views import View
from rfcore.wire.messages import Frame
from rfcore.wire.tiles import Area, Tile
from rfcore.wire.twin import Subscription
from rfcore.wire.twin_render import ObjectsRequest

PICTURE = I420(*(np.zeros(size, np.uint8) for size in ((2, 2), (1, 1), (1, 1))))
INTRINSICS = Intrinsics(2, 2, 1.0, 1.0, 1.0, 1.0)
MakeView = Callable[..., ReceivedPicture]


@pytest.fixture
def view(make_frame: Callable[..., Frame]) -> MakeView:
    def make(
        vehicle: str = "cav-1", session: str = "s-1", sequence: int = 0, captured_ns: int = 1
    ) -> ReceivedPicture:
        frame = replace(make_frame(sequence), capture_time_ns=captured_ns)
        return ReceivedPicture(
            vehicle, session, frame, INTRINSICS, "ab" * 32, PICTURE, b"d" * 16, 10.0, 0.25
        )

    return make


def taken(mailbox: Mailbox) -> list[tuple[str, int | None]]:
    """Empty a mailbox; return (vehicle, sequence), None for a departure."""
    entries = []
    while (entry := mailbox.take()) is not None:
        is_view = isinstance(entry, ReceivedPicture)
        entries.append((entry.vehicle_id, entry.frame.packet.sequence if is_view else None))
    return entries


def test_a_mailbox_keeps_the_newest_of_each_camera_and_counts_what_was_missed(
    view: MakeView,
) -> None:
    twin, calls = Twin(), []
    mailbox = twin.watch(Subscription(), lambda: calls.append(1))
    for sequence in range(5):
        twin.show(view("cav-1", sequence=sequence))
    twin.show(view("cav-2", sequence=0))
    assert len(mailbox) == 2
    assert taken(mailbox) == [("cav-1", 4), ("cav-2", 0)]
    assert mailbox.skipped[("cav-1", "front")] == twin.missed == 4
    assert len(calls) == 6


def test_a_camera_that_is_shown_often_does_not_push_the_others_back(view: MakeView) -> None:
    twin = Twin()
    mailbox = twin.watch(Subscription(), lambda: None)
    for sequence in range(3):
        for vehicle in ("fast", "slow"):
            if vehicle == "fast" or sequence == 0:
                twin.show(view(vehicle, sequence=sequence))
    assert taken(mailbox) == [("fast", 2), ("slow", 0)]


def test_a_new_consumer_sees_at_once_what_is_there(view: MakeView) -> None:
    twin = Twin()
    twin.show(view("cav-1", sequence=7))
    assert taken(twin.watch(Subscription(), lambda: None)) == [("cav-1", 7)]


def test_a_consumer_gets_only_the_vehicles_it_named(view: MakeView) -> None:
    twin = Twin()
    mailbox = twin.watch(Subscription(frozenset({"cav-2"})), lambda: None)
    for vehicle in ("cav-1", "cav-2"):
        twin.show(view(vehicle))
    twin.leave("s-1")
    assert taken(mailbox) == [("cav-2", 0), ("cav-2", None)]


def test_a_capture_time_in_the_far_future_freezes_nobodys_twin(view: MakeView) -> None:
    """The server's own estimate of the time of capture counts, not what a stream claims."""
    twin = Twin()
    twin.show(view(session="impostor", captured_ns=2**63 - 1))
    later = replace(view(session="own", sequence=7, captured_ns=600), reconstructed_s=10.1)
    twin.show(later)
    assert taken(twin.watch(Subscription(), lambda: None)) == [("cav-1", 7)]


def test_a_consumer_gets_what_it_may_see_and_departures_of_what_it_has_seen(
    view: MakeView,
) -> None:
    twin = Twin()
    mailbox = twin.watch(Subscription(), lambda: None, lambda vehicle_id, _: vehicle_id == "cav-1")
    for name in ("cav-1", "cav-2"):
        twin.show(view(name, session=name))
    for name in ("cav-1", "cav-2"):
        twin.leave(name)
    assert taken(mailbox) == [("cav-1", 0), ("cav-1", None)]


def test_a_vehicle_with_two_streams_is_one_vehicle_and_the_newest_capture_wins(
    view: MakeView,
) -> None:
    """As in a handover: the old stream's late picture does not replace the new stream's."""
    twin = Twin()
    for session, sequence, captured_s in (("old", 5, 9.5), ("new", 0, 9.6), ("old", 6, 9.55)):
        shown = view(session=session, sequence=sequence)
        twin.show(replace(shown, latency_s=shown.reconstructed_s - captured_s))
    mailbox = twin.watch(Subscription(), lambda: None)
    twin.leave("old")
    assert taken(mailbox) == [("cav-1", 0)], "the old stream takes nobody with it"
    twin.leave("new")
    assert taken(mailbox) == [("cav-1", None)]
    assert twin.ages_s(11.0) == {}


def test_within_a_stream_a_clock_that_is_set_back_does_not_freeze_the_twin(view: MakeView) -> None:
    twin = Twin()
    mailbox = twin.watch(Subscription(), lambda: None)
    twin.show(view(sequence=0, captured_ns=10**18))
    twin.show(view(sequence=1, captured_ns=5))
    assert taken(mailbox) == [("cav-1", 1)]


def test_the_age_is_that_of_the_oldest_newest_picture_and_grows(view: MakeView) -> None:
    twin = Twin()
    twin.show(view("cav-1"))
    twin.show(replace(view("cav-2"), reconstructed_s=12.0, latency_s=0.1))
    assert twin.ages_s(12.0) == {"cav-1": 2.25, "cav-2": 0.1}
    assert twin.ages_s(9.0) == {"cav-1": 0.25, "cav-2": 0.1}, "never younger than at its birth"


def test_a_consumer_that_left_costs_nothing(view: MakeView) -> None:
    twin = Twin()
    mailbox = twin.watch(Subscription(), lambda: None)
    twin.unwatch(mailbox)
    twin.show(view())
    assert len(mailbox) == 0


@given(st.lists(st.tuples(st.sampled_from("ab"), st.booleans()), max_size=40))
def test_what_was_shown_is_taken_or_missed_and_never_both(steps: list[tuple[str, bool]]) -> None:
    mailbox, shown, got = Mailbox(Subscription(), lambda: None), 0, 0
    for name, is_take in steps:
        if is_take:
            got += mailbox.take() is not None
        else:
            frame = Mock(Frame, camera_id="front")
            mailbox.put(ReceivedPicture(name, "s", frame, INTRINSICS, "", PICTURE, b"", 0.0, 0.0))
            shown += 1
        assert len(mailbox) <= 2
    assert shown == got + sum(mailbox.skipped.values()) + len(mailbox)


def test_the_last_picture_is_seen_before_the_departure(view: MakeView) -> None:
    twin = Twin()
    mailbox = twin.watch(Subscription(), lambda: None)
    for sequence in (0, 1):
        twin.show(view(sequence=sequence))
    twin.leave("s-1")
    assert mailbox.skipped[("cav-1", "front")] == twin.missed == 1
    assert taken(mailbox) == [("cav-1", 1), ("cav-1", None)]


def test_who_is_back_has_not_departed(view: MakeView) -> None:
    twin = Twin()
    mailbox = twin.watch(Subscription(), lambda: None)
    twin.show(view(sequence=0))
    twin.leave("s-1")
    twin.show(view(session="s-2", sequence=7))
    assert taken(mailbox) == [("cav-1", 7)]


def test_a_vehicle_that_left_is_recent_until_it_has_aged(view: MakeView) -> None:
    twin = Twin()
    for name in ("cav-1", "cav-2"):
        twin.show(view(name, session=name))
    twin.leave("cav-1")
    assert {seen.vehicle_id for seen in twin.recent(10.5, 2.0)} == {"cav-1", "cav-2"}
    assert twin.recent(12.0, 2.0) == []
    assert {seen.vehicle_id for seen in twin.recent(19.8, 11.0)} == {"cav-2"}, "10 s are the most"
    twin.show(view("cav-1", session="again", sequence=4))
    assert [s.frame.packet.sequence for s in twin.recent(10.5, 2.0) if s.vehicle_id == "cav-1"] == [
        4
    ]


def test_cameras_that_come_and_go_cost_no_memory(view: MakeView) -> None:
    twin = Twin()
    for number in range(200):
        twin.show(view(f"cav-{number}", session=f"s-{number}"))
        twin.leave(f"s-{number}")
    assert len(twin.recent(10.0, 2.0)) == 32


def test_pictures_before_the_newest_are_kept_one_in_a_while_and_not_for_ever(
    view: MakeView,
) -> None:
    twin = Twin()
    for number in range(200):
        twin.show(replace(view(sequence=number), reconstructed_s=0.05 * number))
    (pictures,) = twin.cameras_of("s-1")
    times_s = [picture.captured_s for picture in pictures]
    assert times_s[-1] == pytest.approx(0.05 * 199 - 0.25)
    assert times_s[-1] - times_s[0] == pytest.approx(KEPT_S, abs=0.3)
    gaps_s = np.diff(times_s[:-1])
    assert (gaps_s >= KEPT_EVERY_S - 1e-9).all()
    assert gaps_s.max() < KEPT_EVERY_S + 0.1
    assert twin.cameras_of("s-2") == []


def test_a_moment_has_the_picture_that_each_camera_had_captured_last(view: MakeView) -> None:
    twin = Twin()
    for number in range(20):
        twin.show(replace(view("cav-1", "s-1", number), reconstructed_s=10.25 + 0.5 * number))
    twin.show(replace(view("cav-2", "s-2"), reconstructed_s=18.25))
    twin.leave("s-2")
    numbers = lambda moment_s, age_s=2.0: sorted(  # noqa: E731
        (it.vehicle_id, it.frame.packet.sequence) for it in twin.at(moment_s, age_s)
    )
    assert numbers(19.5) == [("cav-1", 19), ("cav-2", 0)]
    assert numbers(18.2) == [("cav-1", 16), ("cav-2", 0)]
    assert numbers(17.9) == [("cav-1", 15)], "what was captured later was not there"
    assert numbers(20.5, 0.6) == [], "nothing new was captured for 1 s"
    assert twin.reach_s(20.0) == PAST_S


def test_places_are_in_the_tile_of_their_area_or_else_the_nearest_that_reaches_them() -> None:
    west = Tile("west", "ab" * 32, area=Area((0.0, 0.0), (100.0, 50.0)), margin_m=30.0)
    east = Tile("east", "cd" * 32, area=Area((100.0, 0.0), (200.0, 50.0)), margin_m=30.0)
    everywhere = Tile("all", "ef" * 32)

    def tile_at(east_m: float, north_m: float, *tiles: Tile) -> str:
        place = viewed_tile(ObjectsRequest(place=TileOrigin(east_m, north_m)), tiles)
        return next(tile.name for tile in tiles if tile.field_id == place.field_id)

    assert tile_at(99.0, 25.0, east, west) == "west"
    assert tile_at(101.0, 25.0, east, west) == "east"
    assert tile_at(120.0, -20.0, west, east) == "east"
    assert tile_at(50.0, 25.0, everywhere, west) == "west", "an area says more than none"
    assert tile_at(1e6, 25.0, everywhere, west) == "all"
    with pytest.raises(InvalidInput, match=r"east 1000 m, north 25 m is on no .*: west .*east"):
        tile_at(1000.0, 25.0, west, east)
    with pytest.raises(InvalidInput, match="published here: none; name a field_id"):
        tile_at(0.0, 0.0)


def test_the_past_of_all_cameras_has_a_limit_and_says_from_when_on_it_is_whole(
    view: MakeView,
) -> None:
    past = PastPictures(most_bytes=10 * view().picture_bytes)
    assert view().picture_bytes == 6
    for number in range(30):
        for vehicle in ("cav-1", "cav-2"):
            kept = replace(view(vehicle, sequence=number), reconstructed_s=0.25 + 0.25 * number)
            past.keep(kept, kept.captured_s)
    counts = {key: len(list(past.of(key))) for key in past.cameras()}
    assert counts == {("cav-1", "front"): 5, ("cav-2", "front"): 5}
    assert past.whole_from_s == 0.25 * 25


def render(size_px: int = 2) -> View:
    """A view of 20 bytes a pixel."""
    one = np.zeros((size_px, size_px), np.float32)
    return View(np.zeros((size_px, size_px, 3), np.float32), one, one)


def test_the_render_of_a_picture_is_kept_until_its_camera_shows_another(view: MakeView) -> None:
    twin, first, second, third = Twin(), view(sequence=1), view(sequence=2), view(sequence=3)
    shown = render()
    twin.show(first, shown)
    assert twin.renders.of(first) is shown
    twin.show(second, render())
    assert twin.renders.of(first) is None, "of another picture than is asked for"
    assert twin.renders.of(second) is not None
    twin.show(third)
    assert twin.renders.of(second) is twin.renders.of(third) is None
    twin.show(second, render())
    twin.leave("s-1")
    assert twin.renders.of(second) is None


def test_a_render_of_lower_quality_is_not_kept(view: MakeView) -> None:
    """Whoever looks at a picture compares it with all that the field has."""
    twin, full = Twin(), view()
    coarse = replace(full, frame=replace(full.frame, quality=Quality(detail=0.25)))
    twin.show(full, render())
    twin.show(coarse, render())
    assert twin.renders.of(coarse) is twin.renders.of(full) is None


def test_renders_are_kept_as_far_as_their_bytes_go_the_newest_longest(view: MakeView) -> None:
    renders, shown = KeptRenders(most_bytes=200), [view(f"cav-{i}") for i in range(4)]
    for each in shown[:3]:
        renders.keep(each, render())
    assert [renders.of(each) is None for each in shown[:3]] == [True, False, False]
    renders.keep(shown[1], render())
    renders.keep(shown[3], render())
    assert [renders.of(each) is None for each in shown] == [True, False, True, False]
    renders.keep(shown[0], render(size_px=4))
    assert all(renders.of(each) is None for each in shown), "larger than all that may be kept"
