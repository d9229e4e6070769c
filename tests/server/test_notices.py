"""Which vehicle is told of which object, how often, and of which field."""

import math
from dataclasses import replace
from itertools import pairwise
from unittest.mock import AsyncMock, Mock

import pytest

from mec_server.twin import notices
from mec_server.twin.notices import (
    MOST_PER_S,
    REACH_M,
    REPEAT_S,
    VALID_S,
    StreamNotices,
    StreetNotices,
    field_changes,
)
from mec_server.twin.objects import FollowedObject
from rfcore.camera import Pose
from rfcore.wire.notices import FieldChange, FieldChangeKind, ObjectAhead, StreetNotice
from rfcore.wire.tiles import Tile, TileLight

FIELD, NEW, DUSK = "ab" * 32, "cd" * 32, "ef" * 32
NOW = 100.0
HERE = Pose((0.0, 0.0, 1.5), (0.5, -0.5, 0.5, -0.5))
"""A camera that looks along x, as those of the sample's street."""


def thing(
    object_id: int, x_m: float, *cameras: tuple[str, str], y_m: float = 0.0
) -> FollowedObject:
    seen = dict.fromkeys(cameras or (("other", "front"),), NOW - 0.1)
    return FollowedObject(
        object_id, (x_m, y_m, 0.0), (0.0, 0.0, 0.0), 1.8, 1.4, NOW - 3, NOW - 0.1, 9, seen
    )


def told(*objects: FollowedObject, stream: StreamNotices | None = None, now: float = NOW) -> list:
    stream = stream or StreamNotices("me")
    return stream.about_objects(FIELD, HERE, objects, now)


def distances_m(given: list[StreetNotice]) -> list[float]:
    return [n.subject.distance_m for n in given if isinstance(n.subject, ObjectAhead)]


def test_the_test_looks_along_x() -> None:
    assert HERE.apply((0.0, 0.0, 1.0)) == pytest.approx((1.0, 0.0, 1.5))


def test_a_vehicle_is_told_what_another_sees_ahead_of_it() -> None:
    (notice,) = told(thing(7, 20.0, ("other", "front"), ("other", "rear"), ("third", "front")))
    assert notice.valid_for_s == VALID_S
    ahead = notice.subject
    assert isinstance(ahead, ObjectAhead)
    assert (ahead.field_id, ahead.at_m, ahead.vehicles) == (FIELD, (20.0, 0.0, 0.0), 2)
    assert ahead.distance_m == pytest.approx(math.hypot(20.0, 1.5))
    assert (ahead.age_s, ahead.unseen_s) == pytest.approx((3.0, 0.1))
    assert 0.8 < ahead.confidence <= 1


async def test_an_object_is_told_of_with_a_picture_that_shows_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    picture = Mock(key=("other", "front"), captured_s=NOW - 0.1, field_id=FIELD)
    shown = thing(1, 20.0)
    seen_before = replace(thing(2, 10.0), last_s=NOW - 0.3)
    tracker = Mock(confirmed=lambda _: [shown, seen_before])
    monkeypatch.setattr(notices, "ObjectTracker", lambda: tracker)
    monkeypatch.setattr(notices.time, "monotonic", lambda: NOW)
    own = Mock(frame=Mock(pose=HERE), field_id=FIELD, age_s=lambda _: 0.1)
    twin = Mock(newest_of=lambda _: own)
    views = Mock(detections=AsyncMock(return_value=[]))
    taker = Mock(session_id="s", vehicle_id="me", uses=lambda _: True)
    street = StreetNotices(twin, views, lambda: [taker], lambda: (), Mock())
    await street._look_at(picture)
    (notice,) = (call.args[0] for call in taker.tell.call_args_list)
    assert notice.subject.at_m == (20.0, 0.0, 0.0)
    assert notice.subject.unseen_s == pytest.approx(0.1)


@pytest.mark.parametrize(
    "object_",
    [
        thing(1, -5.0),
        thing(1, REACH_M + 1),
        thing(1, 20.0, ("me", "front")),
        thing(1, 20.0, ("other", "front"), ("me", "rear")),
        replace(thing(1, 20.0), cameras={("other", "front"): NOW - 1.5}),
    ],
    ids=["behind", "far", "own", "own too", "seen by nobody"],
)
def test_nothing_is_told_of_what_does_not_concern_it(object_: FollowedObject) -> None:
    assert told(object_) == []


def test_a_thing_that_its_own_camera_loses_is_told_of() -> None:
    lost = replace(
        thing(1, 20.0), cameras={("other", "front"): NOW - 0.1, ("me", "front"): NOW - 1.1}
    )
    assert len(told(lost)) == 1


def test_a_thing_is_repeated_under_its_number_while_it_is_seen() -> None:
    stream, times = StreamNotices("me"), []
    numbers = set()
    for tick in range(21):
        now = NOW + tick / 10
        seen = replace(thing(4, 30.0), cameras={("other", "front"): now - 0.1}, last_s=now - 0.1)
        for notice in told(seen, stream=stream, now=now):
            times.append(now)
            numbers.add(notice.notice_id)
    assert numbers == {1}
    assert all(b - a >= REPEAT_S - 1e-9 for a, b in pairwise(times))
    assert len(times) == 5


def test_what_nobody_has_seen_since_is_not_repeated() -> None:
    stream, lost = StreamNotices("me"), thing(4, 30.0)
    assert len(told(lost, stream=stream)) == 1
    assert told(lost, stream=stream, now=NOW + REPEAT_S + 0.1) == []


def test_what_expired_before_it_came_again_gets_a_new_number() -> None:
    stream = StreamNotices("me")
    (first,) = told(thing(4, 30.0), stream=stream)
    later = NOW + VALID_S + 0.5
    again = replace(thing(4, 30.0), cameras={("other", "front"): later}, last_s=later)
    (second,) = told(again, stream=stream, now=later)
    assert first.notice_id != second.notice_id


def test_the_nearest_are_told_first_and_not_too_many_a_second() -> None:
    stream = StreamNotices("me")
    things = [thing(i, 90.0 - 3 * i) for i in range(20)]
    notices = told(*things, stream=stream)
    assert len(notices) == MOST_PER_S
    assert distances_m(notices) == sorted(distances_m(notices))
    assert min(distances_m(notices)) == pytest.approx(math.hypot(33.0, 1.5))
    assert told(*things, stream=stream, now=NOW + 0.9) == []
    assert len({notice.notice_id for notice in notices}) == MOST_PER_S


def tile(field_id: str, *lights: TileLight, version: int = 1) -> Tile:
    return Tile("west", field_id, version=version, lights=lights)


def test_a_tile_with_another_map_or_light_is_told_of_once() -> None:
    dusk = TileLight("dusk", DUSK, 2, base_field_id=FIELD)
    before, after = (tile(FIELD),), (tile(NEW, dusk, version=3),)
    changes = field_changes(before, after)
    assert [change for _, change in changes] == [
        FieldChange(FieldChangeKind.MAP, "west", NEW, 3),
        FieldChange(FieldChangeKind.LIGHT, "west", DUSK, 2, "dusk"),
    ]
    assert all(old is before[0] for old, _ in changes), "those who use the old field are told"
    assert field_changes(after, after) == []
    assert field_changes((), after) == [], "nobody uses a tile that was not there"
