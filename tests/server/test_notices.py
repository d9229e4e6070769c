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
    OwnCamera,
    StreamNotices,
    StreetNotices,
    VehiclePosition,
    field_changes,
)
from mec_server.twin.rendering import PictureObjects
from rfcore.camera import Pose
from rfcore.perception.objects import FollowedObject
from rfcore.wire.notices import FieldChange, FieldChangeKind, ObjectAhead, StreetNotice
from rfcore.wire.tiles import Tile, TileLight

FIELD, NEW, DUSK = "ab" * 32, "cd" * 32, "ef" * 32
NOW = 100.0
HERE = Pose((0.0, 0.0, 1.5), (0.5, -0.5, 0.5, -0.5))
"""A camera that looks along x, as those of the sample's street."""
STANDING = OwnCamera(NOW, HERE.translation_m, (0.0, 0.0, 0.0))
OWN = VehiclePosition((STANDING,), (1.0, 0.0, 0.0))


def thing(
    object_id: int, x_m: float, *cameras: tuple[str, str], y_m: float = 0.0
) -> FollowedObject:
    seen = dict.fromkeys(cameras or (("other", "front"),), NOW - 0.1)
    return FollowedObject(
        object_id, (x_m, y_m, 0.0), (0.0, 0.0, 0.0), 1.8, 1.4, NOW - 3, NOW - 0.1, 9, seen
    )


def told(
    *objects: FollowedObject,
    stream: StreamNotices | None = None,
    now: float = NOW,
    own: VehiclePosition = OWN,
) -> list:
    stream = stream or StreamNotices("me")
    return stream.about_objects(FIELD, own, objects, now)


def view(pose: Pose | None, captured_s: float = NOW - 0.1, camera_id: str = "front") -> Mock:
    frame = Mock(pose=pose, camera_id=camera_id)
    return Mock(
        frame=frame, captured_s=captured_s, field_id=FIELD, age_s=lambda now: now - captured_s
    )


def moved(x_m: float, y_m: float = 0.0) -> Pose:
    return replace(HERE, translation_m=(x_m, y_m, 1.5))


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
    doubtful = thing(3, 15.0)
    pictures = [Mock(detection=Mock(trust=0.3), instant=Mock(vehicle_id="other"))]
    doubtful._sightings = pictures  # type: ignore[assignment]
    assert doubtful.is_doubtful
    tracker = Mock(confirmed=lambda _: [shown, seen_before, doubtful])
    monkeypatch.setattr(notices, "ObjectTracker", lambda: tracker)
    monkeypatch.setattr(notices.time, "monotonic", lambda: NOW)
    twin = Mock(cameras_of=lambda _: [[view(None), view(HERE)], [view(None, camera_id="rear")]])
    views = Mock(objects_in=AsyncMock(return_value=PictureObjects([])))
    hello = Mock(vehicle_id="me", cameras=[Mock(camera_id="front")], field_ids=(FIELD,))
    taker = Mock(session_id="s", hello=hello)
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


BACK = Pose((-1.0, 0.0, 1.5), (0.5, -0.5, -0.5, 0.5))
"""A camera that looks the other way."""


def test_the_other_camera_looks_along_minus_x() -> None:
    assert BACK.apply((0.0, 0.0, 1.0)) == pytest.approx((-2.0, 0.0, 1.5))


def test_a_vehicle_is_not_told_of_itself() -> None:
    """An oncoming vehicle sees this one's front, 2 m ahead of its camera."""
    assert told(thing(1, 2.0)) == []
    assert told(thing(1, 1.0, y_m=-2.5)) == []
    assert len(told(thing(1, 4.0))) == 1
    side = replace(STANDING, at_m=(3.5, 0.0, 1.5))
    assert told(thing(1, 4.0), own=VehiclePosition((STANDING, side), OWN.ahead)) == []


def test_a_vehicle_that_drives_is_not_told_of_where_it_just_was_or_is_by_now() -> None:
    """At 20 m/s its newest picture is 0.4 s old; others saw it 0.1 s ago, as standing."""
    driving = OwnCamera(NOW - 0.4, (0.0, 0.0, 1.5), (20.0, 0.0, 0.0))
    own = VehiclePosition((driving,), (1.0, 0.0, 0.0))
    assert told(thing(1, 8.0), own=own) == [], "it is at 8 m by now"
    assert told(thing(1, 6.5), own=own) == []
    assert told(thing(1, 10.5), own=own) == []
    (notice,) = told(thing(1, 20.0), own=own)
    assert distances_m([notice]) == pytest.approx([math.hypot(12.0, 1.5)])


def test_ahead_is_the_way_driven_whichever_camera_came_last() -> None:
    """A rig whose rear camera sent the newest picture, on its way along x, then standing."""
    front = [view(moved(0.2 * n), NOW - 0.6 + 0.1 * n) for n in range(6)]
    rear_poses = [replace(BACK, translation_m=(0.2 * n - 2, 0.0, 1.5)) for n in range(6)]
    rear = [view(p, NOW - 0.59 + 0.1 * n, "rear") for n, p in enumerate(rear_poses)]
    own = VehiclePosition.of([front, rear], ("rear", "front"))
    assert own.ahead == pytest.approx((2.0, 0.0, 0.0))
    assert own.cameras[0].at_m == (-1.0, 0.0, 1.5)
    assert own.distance_ahead_m(thing(1, 20.0), NOW) is not None
    assert own.distance_ahead_m(thing(1, -20.0), NOW) is None
    reversing = [view(moved(-0.5 * n), NOW - 0.6 + 0.1 * n) for n in range(6)]
    assert VehiclePosition.of([reversing], ("front",)).distance_ahead_m(thing(1, -20.0), NOW)


@pytest.mark.parametrize(
    ("names", "camera_ids", "ahead"),
    [
        (("front", "rear"), ("rear", "front"), 1.0),
        (("left", "right"), ("left", "right"), 1.0),
        (("left", "right"), ("right", "left"), -1.0),
    ],
    ids=["the one that is called front", "else the first of its Hello", "whichever that is"],
)
def test_ahead_of_a_rig_that_stands_is_where_its_first_camera_looks(
    names: tuple[str, str], camera_ids: tuple[str, str], ahead: float
) -> None:
    """The camera of the second name looks back, and its picture came last."""
    one, other = [view(HERE, NOW - 0.2, names[0])], [view(BACK, NOW - 0.1, names[1])]
    assert VehiclePosition.of([one, other], camera_ids).ahead[0] == pytest.approx(ahead)


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
