"""A car of one's own in the twin: how it moves, what it sees, and that a recording repeats."""

import math
from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import grpc
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.camera import Camera, Intrinsics
from rfcore.dataset import read_dataset
from rfcore.errors import InvalidInput
from rfcore.field import load_field
from rfcore.views import PosedPicture
from rfcore.wire.twin_render import ObjectsSeen, StreetObject, objects_to_wire
from rfcore.wire.v1 import twin_pb2_grpc
from rfedge.samples import sample_path
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


@pytest.mark.slow
@pytest.mark.sample
def test_a_minute_in_the_sample_street_repeats_to_the_byte() -> None:
    field = load_field(sample_path("fields/street.rff"))
    pictures = read_dataset(sample_path("street/transforms_drive_vehicles.json")).pictures[::3]
    intrinsics = Intrinsics(160, 90, 80.0, 80.0, 80.0, 45.0)
    place = place_of(pictures[0].camera.world_from_cam)

    def driven() -> list[bytes]:
        drive = TwinDrive(RecordedStreet(field, [pictures]), intrinsics)
        seen, pictures_seen = drive.reset(place), []
        for _ in range(600):
            seen = drive.reset(place) if seen.ended else drive.step(0.0, 0.2)
            pictures_seen.append(seen.picture.tobytes())
        return pictures_seen

    first = driven()
    assert first == driven()
    assert len(set(first)) > 100, "it begins anew where the field ends"


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
