"""A car of one's own in the twin: how it moves, what it sees, and that a recording repeats."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import grpc
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.camera import Camera, TileOrigin
from rfcore.dataset.recorded_session import RECORDING_NAME, RecordedCamera, RecordedPicture
from rfcore.errors import InvalidInput
from rfcore.field import SplatField
from rfcore.image import write_png
from rfcore.perception.objects import StreetObject
from rfcore.views import PosedPicture
from rfcore.wire.twin_render import ObjectsSeen, objects_to_wire
from rfcore.wire.v1 import twin_pb2_grpc
from rfedge.twin import simulation
from rfedge.twin.simulation import (
    MOST_SPEED_MPS,
    WHEELBASE_M,
    Place,
    RecordedStreet,
    ServedStreet,
    TwinDrive,
    place_of,
    steering_towards,
)
from server.test_objects import FIELD, INTRINSICS, STREET, camera_at, car, joined

START = place_of(camera_at().world_from_cam)
actions = st.tuples(st.floats(-1, 1), st.floats(-1, 1))


def picture(camera: Camera, field: Any, time_s: float) -> PosedPicture:
    rgb = np.rint(field.render(camera).colour.clip(0, 1) * 255).astype(np.uint8)
    return PosedPicture(f"{time_s}", camera, lambda: rgb, round(time_s * 1e9))


def passing_car() -> list[PosedPicture]:
    """One second at 10 Hz: a camera that stands, and a car that comes nearer by 0.3 m a picture."""
    return [
        picture(camera_at(), joined(STREET, car(0.8, 14.0 - 0.3 * i)), i / 10) for i in range(10)
    ]


@pytest.fixture(scope="module")
def recording() -> list[PosedPicture]:
    return passing_car()


def test_a_place_is_where_its_camera_stands_and_looks() -> None:
    assert START.heading_rad == pytest.approx(math.pi / 2)
    again, before = START.camera(INTRINSICS).world_from_cam, camera_at().world_from_cam
    assert again.apply((1.0, 2.0, 3.0)) == pytest.approx(before.apply((1.0, 2.0, 3.0)))


@given(actions=st.lists(actions, max_size=30), heading=st.floats(-3, 3))
def test_the_car_keeps_to_what_a_car_can_do(
    actions: list[tuple[float, float]], heading: float
) -> None:
    place = Place(0.0, 0.0, 1.6, heading)
    for steer, throttle in actions:
        after = place.after(steer, throttle, 0.1)
        assert 0 <= after.speed_mps <= MOST_SPEED_MPS
        driven_m = math.dist((place.x_m, place.y_m), (after.x_m, after.y_m))
        assert driven_m <= 0.1 * max(place.speed_mps, after.speed_mps) + 1e-9
        assert after.z_m == place.z_m
        place = after


def test_a_car_that_keeps_its_wheel_drives_the_circle_of_its_wheelbase() -> None:
    radius_m = WHEELBASE_M / math.tan(0.6 * 0.5)
    place = Place(0.0, 0.0, 1.6, 0.0, speed_mps=4.0)
    for _ in range(2000):
        place = place.after(0.5, 0.0, 0.01)
        assert math.dist((place.x_m, place.y_m), (0.0, radius_m)) == pytest.approx(radius_m, 1e-4)


@pytest.mark.parametrize(
    ("way", "steer"),
    [
        ([(1.0, 0.0), (20.0, 0.0)], 0.0),
        ([(1.0, 0.0), (10.0, 1.0)], 4 / math.hypot(10, 1)),
        ([(10.0, -30.0)], -1.0),
        ([(-10.0, 3.0), (5.9, 3.0)], 0.0),
    ],
)
def test_a_driver_steers_towards_the_first_point_that_is_far_enough_ahead(
    way: list[tuple[float, float]], steer: float
) -> None:
    assert steering_towards(Place(0.0, 0.0, 1.6, 0.0), way) == pytest.approx(steer)


def test_a_recorded_car_is_seen_and_found_from_beside(recording: list[PosedPicture]) -> None:
    drive = TwinDrive(RecordedStreet(FIELD, [recording]), INTRINSICS)
    seen = drive.reset(replace(START, x_m=-0.5))
    for _ in range(8):
        seen = drive.step(0.0, 0.0)
    assert seen.live.any()
    (thing,) = seen.objects
    assert math.dist(thing.at_m[:2], (0.8, 14.0 - 0.3 * 8)) < 1.0
    assert thing.velocity_mps[1] < 0
    bare = np.rint(FIELD.render(seen.place.camera(INTRINSICS)).colour * 255).astype(np.uint8)
    changed = (seen.picture != bare).any(axis=2)
    assert 0.01 < changed.mean() < 0.5
    assert not seen.ended


def test_the_same_recording_and_actions_give_the_same_bytes(
    recording: list[PosedPicture],
) -> None:
    def driven() -> list[Any]:
        drive = TwinDrive(RecordedStreet(FIELD, [recording]), INTRINSICS)
        seen = [drive.reset(START).digest()]
        return [*seen, *(drive.step(0.3 * math.sin(i), 0.5).digest() for i in range(8))]

    first, second = driven(), driven()
    assert first == second
    assert len(set(first)) == len(first), "it moves"


def test_a_digest_tells_of_picture_depth_and_objects(recording: list[PosedPicture]) -> None:
    seen = TwinDrive(RecordedStreet(FIELD, [recording]), INTRINSICS).reset(START)
    others = [
        replace(seen, picture=seen.picture ^ 1),
        replace(seen, depth=seen.depth + 1),
        replace(seen, objects=(*seen.objects, Mock())),
    ]
    assert len({each.digest() for each in (seen, *others)}) == 4


def test_a_recording_fades_and_begins_again(recording: list[PosedPicture]) -> None:
    street = RecordedStreet(FIELD, [recording])
    drive = TwinDrive(street, INTRINSICS)
    first = drive.reset(START)
    assert street.lasts_s == pytest.approx(0.9)
    seen = [drive.step(0.0, 0.0) for _ in range(30)]
    assert seen[-1].picture.tobytes() == first.picture.tobytes(), "after 2.9 s it is as at first"
    assert [o.live.any() for o in seen[:29]] == [True] * 28 + [False]


def test_the_end_of_the_field_ends_the_drive(recording: list[PosedPicture]) -> None:
    drive = TwinDrive(RecordedStreet(FIELD, [recording]), INTRINSICS)
    seen = drive.reset(replace(START, y_m=-2.0, heading_rad=-math.pi / 2, speed_mps=10.0))
    for _ in range(10):
        seen = drive.step(0.0, 0.0)
    assert seen.ended
    assert -3.0 <= seen.place.y_m < -2.0
    assert drive.step(0.0, 1.0) is seen


@pytest.mark.parametrize(
    ("steer", "throttle", "name"),
    [(1.1, 0.0, "steer"), (0.0, -2.0, "throttle"), (float("nan"), 0.0, "steer")],
)
def test_actions_no_car_can_take_are_refused(
    recording: list[PosedPicture], steer: float, throttle: float, name: str
) -> None:
    drive = TwinDrive(RecordedStreet(FIELD, [recording]), INTRINSICS)
    with pytest.raises(InvalidInput, match="call reset"):
        drive.step(0.0, 0.0)
    seen = drive.reset(START)
    with pytest.raises(InvalidInput, match=f"{name}: .* is outside -1..1"):
        drive.step(steer, throttle)
    assert drive.step(0.0, 0.0).place == seen.place


def test_what_cannot_be_driven_through_is_refused(recording: list[PosedPicture]) -> None:
    with pytest.raises(InvalidInput, match="no pictures"):
        RecordedStreet(FIELD, [[]])
    timeless = [replace(each, time_ns=0) for each in recording]
    with pytest.raises(InvalidInput, match="have no times"):
        RecordedStreet(FIELD, [timeless])
    drive = TwinDrive(RecordedStreet(FIELD, [recording]), INTRINSICS)
    with pytest.raises(InvalidInput, match="outside of the field"):
        drive.reset(replace(START, x_m=1e4))
    with pytest.raises(InvalidInput, match="rate_hz: 0 is outside"):
        TwinDrive(RecordedStreet(FIELD, [recording]), INTRINSICS, rate_hz=0.0)


HOUR_NS = 3600 * 10**9
BEGUN_NS = 1_767_225_600 * 10**9


def record(folder: Path, key: tuple[str, str], part: Part) -> None:
    """Write pictures as a server does that was told to record them."""
    vehicle, camera = key
    where = folder / vehicle / camera / f"{part.begun_ns // 10**6:013}-{part.session}"
    where.mkdir(parents=True)
    whose = RecordedCamera(vehicle, camera, part.session, INTRINSICS)
    lines = [whose.line()]
    for number, picture in enumerate(part.pictures):
        name = f"{number:06}.png"
        write_png(where / name, picture.read())
        pose = part.origin.globalise(picture.camera.world_from_cam)
        time_ns = part.first_ns + picture.time_ns - part.pictures[0].time_ns
        shown = RecordedPicture(name, time_ns, 0, number, "ab" * 32, pose, "00")
        lines += [shown.line(), replace(shown, world_from_cam=None, sequence=99).line()]
    (where / RECORDING_NAME).write_text("".join(lines))


@dataclass(frozen=True)
class Part:
    """Pictures of a session, begun at ``begun_ns`` by the server, ``first_ns`` by the vehicle."""

    session: str
    pictures: list[PosedPicture]
    begun_ns: int
    first_ns: int
    origin: TileOrigin = TileOrigin(0.0, 0.0, 0.0)


def test_what_a_server_recorded_is_driven_through(
    recording: list[PosedPicture], tmp_path: Path
) -> None:
    """One vehicle's pictures in two parts, and one of another whose clock is an hour ahead: as if
    all had been given by themselves, under their names."""
    half_ns = BEGUN_NS + 500_000_000
    record(tmp_path, ("cav-1", "front"), Part("b", recording[5:], half_ns + 10**8, half_ns))
    record(tmp_path, ("cav-1", "front"), Part("a", recording[:5], BEGUN_NS + 10**8, BEGUN_NS))
    late = Part("c", recording[2:4], BEGUN_NS + 2 * 10**8, BEGUN_NS + 2 * 10**8 + HOUR_NS)
    record(tmp_path, ("cav-2", "rear"), late)
    street = RecordedStreet.of_recording(FIELD, tmp_path)
    assert [len(camera) for camera in street.cameras] == [10, 2]
    assert street.lasts_s == pytest.approx(0.9), "two clocks, an hour apart, are one"
    given = RecordedStreet(FIELD, [recording, recording[2:4]])
    seen, expected = (TwinDrive(each, INTRINSICS) for each in (street, given))
    places = [replace(START, x_m=-0.5)] * 2
    first, second = seen.reset(places[0]), expected.reset(places[1])
    for _ in range(8):
        assert first.picture.tobytes() == second.picture.tobytes()
        first, second = seen.step(0.0, 0.0), expected.step(0.0, 0.0)
    (thing,) = first.objects
    assert ("cav-1", "front") in thing.seen_by


def test_a_recording_is_put_into_the_fields_own_tile(
    recording: list[PosedPicture], tmp_path: Path
) -> None:
    origin = TileOrigin(1000.0, -500.0, 20.0)
    record(tmp_path, ("cav-1", "front"), Part("a", recording, BEGUN_NS, BEGUN_NS, origin))
    field = replace(FIELD.metadata, tile_origin=origin)
    street = RecordedStreet.of_recording(SplatField(STREET, metadata=field), tmp_path)
    pose = street.cameras[0][0].camera.world_from_cam
    assert pose.translation_m == pytest.approx(recording[0].camera.world_from_cam.translation_m)


def test_a_folder_without_recordings_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match=r"recording: .* has no pictures with a pose"):
        RecordedStreet.of_recording(FIELD, tmp_path)


def test_keys_are_one_for_each_camera(recording: list[PosedPicture]) -> None:
    with pytest.raises(InvalidInput, match="keys: 2 are not one for 1 cameras"):
        RecordedStreet(FIELD, [recording], [("a", "b"), ("c", "d")])


def test_a_served_street_keeps_to_its_ticks() -> None:
    """Ticks of 0.1 s; the second look takes 0.25 s: what is late stays late, and is not made up."""
    now_s, slept_s = [5.0], []

    def sleep(seconds: float) -> None:
        slept_s.append(seconds)
        now_s[0] += seconds

    with grpc.insecure_channel("127.0.0.1:1") as channel:
        street = ServedStreet(channel, "west", now=lambda: now_s[0], sleep=sleep)
        street.begin()
        for look_s in (0.03, 0.25, 0.0, 0.04):
            now_s[0] += look_s
            street.pass_time(0.1)
    assert slept_s == pytest.approx([0.07, 0.1, 0.06])


def test_a_served_street_keeps_no_objects_beyond_its_stream(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    still = (0.0, 0.0, 0.0)
    thing = StreetObject(1, (1.0, 2.0, 0.0), still, 1.0, 1.0, 1.0, 1.0, 0.1, (("v", "front"),))
    message = objects_to_wire(ObjectsSeen(1, FIELD.field_id, (thing,)))
    seen: list[Any] = []

    class Stream:
        def __iter__(self) -> Any:
            yield message
            seen.append(street.look(camera_at())[3])
            raise grpc.RpcError

        def cancel(self) -> None:
            pass

    stub = Mock(return_value=Mock(Objects=lambda *_, **__: Stream()))
    monkeypatch.setattr(twin_pb2_grpc, "TwinServiceStub", stub)
    monkeypatch.setattr(simulation, "render_view", lambda *_: Mock())
    with (street := ServedStreet(Mock(), tile="west")):
        street._reading.join(10)
        assert [each.object_id for each in seen[0]] == [1]
        assert street.look(camera_at())[3] == ()


def test_a_recorded_picture_that_lacks_a_thing_says_so() -> None:
    """A car that is there for half a second and then is not: half a second after it was seen last,
    half of its confidence would be left for that alone."""
    shown = [picture(camera_at(), joined(STREET, car(0.8, 10.0)), i / 10) for i in range(5)]
    bare = [picture(camera_at(), FIELD, i / 10) for i in range(5, 10)]
    drive = TwinDrive(RecordedStreet(FIELD, [[*shown, *bare]]), INTRINSICS)
    drive.reset(START)
    seen = [drive.step(0.0, 0.0).objects for _ in range(9)]
    assert seen[3][0].confidence == pytest.approx(1.0)
    assert seen[-1][0].unseen_s == pytest.approx(0.5)
    assert seen[-1][0].confidence < 0.4
