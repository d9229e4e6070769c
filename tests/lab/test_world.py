"""``rfedge-lab world`` compares objects and views with the generator's truth."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from lab.world import EvalWorld
from lab.world.objects import (
    AnnotatedDrive,
    AnnotatedPicture,
    FoundVehicles,
    dusk_scenes,
    empty_minute,
    followed,
    noisy,
    received,
)
from lab.world.run import TruePictures, age_on_arrival_s, gain_of, run_world
from lab.world.truth import Drive, Footprint, SceneTruth, VisibleVehicle, aside
from rfcore.camera import Camera, Intrinsics
from rfcore.errors import InvalidInput
from rfcore.field import SplatField
from rfcore.perception.composition import live_picture
from rfcore.perception.objects import FollowedObject
from rfcore.update.passes import FEWEST_FRAMES
from server.test_objects import CAMERA_M, FIELD, GROUND, STREET, camera_at, car, joined
from streetgen.classes import Label
from streetgen.shots import Split, shots_of

SQUARE = Footprint(np.float32([[0, 0], [2, 0], [2, 1], [0, 1]]))
SMALL = Intrinsics(96, 54, 48.0, 48.0, 48.0, 27.0)


@pytest.mark.parametrize(
    ("point", "outside_m"), [((1, -0.5, 9.0), 0.5), ((3, 0.5, 0), 1.0), ((1, 0.25, 0), -0.25)]
)
def test_a_footprint_knows_how_far_a_point_is_from_its_outline(point, outside_m):
    assert SQUARE.outside_m(point) == pytest.approx(outside_m)
    assert SQUARE.distance_m(point) == pytest.approx(abs(outside_m))


def test_aside_is_to_the_left_of_the_way():
    """The test's cameras look along y, with z up: their left is -x."""
    moved = aside(camera_at(), 2.0)
    assert moved.world_from_cam.translation_m == pytest.approx((-2.0, 0.0, 0.0))
    assert moved.world_from_cam.rotation == camera_at().world_from_cam.rotation


def test_noise_has_the_strength_that_is_asked_for():
    grey = np.full((100, 100, 3), 128, np.uint8)
    rng = np.random.default_rng(1)
    assert noisy(grey, 0.0, rng) is grey
    assert noisy(grey, 3.0, rng).astype(float).std() == pytest.approx(3.0, rel=0.05)


def test_a_live_picture_betters_the_pixels_that_changed():
    street = joined(STREET, car(0.8, 10.0))
    here, beside = camera_at(), camera_at(-0.5)

    def picture(camera: Camera) -> np.ndarray:
        return np.rint(street.render(camera).colour.clip(0, 1) * 255).astype(np.uint8)

    live = live_picture(here, picture(here), FIELD.render(here))
    true = TruePictures(beside, picture(beside), picture_of(FIELD, beside))
    gain = gain_of(FIELD, live, true)
    assert gain.all_db > 0.5
    assert gain.changed_db is not None
    assert gain.changed_db > 2
    unchanged = TruePictures(beside, true.empty, true.empty)
    assert gain_of(FIELD, live, unchanged).changed_db is None, "by the truth nothing changed"
    assert gain_of(FIELD, live, unchanged).all_db < -0.5, "the car is not there"


def test_what_changed_is_what_the_truth_says_and_not_what_was_composed():
    """A picture that shows nothing new betters nothing, and the car counts all the same."""
    street = joined(STREET, car(0.8, 10.0))
    here, beside = camera_at(), camera_at(-0.5)
    bare = live_picture(here, picture_of(FIELD, here), FIELD.render(here))
    true = TruePictures(beside, picture_of(street, beside), picture_of(FIELD, beside))
    gain = gain_of(FIELD, bare, true)
    assert (gain.all_db, gain.changed_db) == (0.0, 0.0)
    assert 0.002 < true.changed.mean() < 0.2


def picture_of(field: SplatField, camera: Camera) -> np.ndarray:
    return np.rint(field.render(camera).colour.clip(0, 1) * 255).astype(np.uint8)


def approach(street: SplatField, vehicles: tuple[VisibleVehicle, ...]) -> AnnotatedDrive:
    """Six pictures on the way towards y = 10 m, one every 0.1 s."""
    pictures = []
    for step in range(6):
        camera = camera_at(0.05 * step)
        view = FIELD.render(camera)
        rgb = picture_of(street, camera)
        pictures.append(AnnotatedPicture(camera, 0.1 * step, rgb, view, vehicles))
    return AnnotatedDrive(tuple(pictures), GROUND)


CAR = Footprint(np.float32([[-0.1, 10], [1.7, 10], [1.7, 11], [-0.1, 11]]))


def test_what_is_followed_is_compared_with_the_vehicles_that_are_seen():
    seen = VisibleVehicle(0, CAR, pixels=5000, nearest_m=10.0)
    hidden = replace(seen, number=1, pixels=399)
    far = replace(seen, number=2, nearest_m=30.1)
    found = followed(approach(joined(STREET, car(0.8, 10.0)), (seen, hidden, far)), 0.0)
    assert found.to_find == 6, "those of 400 pixels within 30 m"
    assert found.found >= 5, "large: confirmed by the second picture"
    assert max(found.errors_m) < 0.5
    assert found.false == set()


def test_what_is_far_from_every_vehicle_is_false():
    elsewhere = VisibleVehicle(0, SQUARE, pixels=5000, nearest_m=2.0)
    found = followed(approach(joined(STREET, car(0.8, 10.0)), (elsewhere,)), 0.0)
    assert found.found == 0
    assert len(found.false) == 1
    assert found.errors_m == pytest.approx([9.0] * len(found.errors_m), abs=0.5), "none is left out"
    assert len(found.errors_m) >= 5
    assert followed(approach(FIELD, ()), 0.0) == FoundVehicles()


def test_one_object_is_one_vehicle():
    """Two vehicles within reach of one object: it finds the nearer one."""
    near = VisibleVehicle(0, SQUARE, pixels=5000, nearest_m=9.0)
    beside = VisibleVehicle(1, Footprint(SQUARE.outline_m + np.float32([2.5, 0])), 5000, 9.0)
    street = FIELD
    picture = AnnotatedPicture(
        camera_at(), 0.0, np.zeros((1, 1, 3), np.uint8), street.render(camera_at()), (near, beside)
    )

    def thing(number: int, x_m: float) -> FollowedObject:
        zero = (0.0, 0.0, 0.0)
        return FollowedObject(number, (x_m, 0.5, 0.0), zero, 1.8, 1.5, 0.0, 0.0)

    one, two = FoundVehicles(), FoundVehicles()
    one.take(picture, [thing(1, 2.2)])
    assert (one.to_find, one.found) == (2, 1)
    two.take(picture, [thing(1, 2.2), thing(2, 2.4)])
    assert (two.to_find, two.found) == (2, 2)


def test_pictures_are_looked_at_as_they_are_decoded():
    drive = approach(joined(STREET, car(0.8, 10.0)), ())
    sent = [picture.rgb for picture in drive.pictures]
    decoded = list(received(drive.pictures, sent))
    errors = [float(np.abs(a.astype(int) - b).mean()) for a, b in zip(sent, decoded, strict=True)]
    assert all(0.05 < error < 4 for error in errors), "coded with loss"


def test_the_empty_minute_is_a_minute_with_noise_of_its_own_each_time():
    drive = approach(FIELD, ())
    assert drive.seconds == pytest.approx(0.6)
    longer = AnnotatedDrive(
        tuple(replace(each, time_s=40 * each.time_s) for each in drive.pictures[:2]), GROUND
    )
    row = empty_minute(longer)
    assert row.case.endswith("8 times the drive of 8.0 s and 2 pictures, noise 3 of seeds 1 to 8")
    assert (row.measured, row.held) == ("0 in 64 s", True)


@pytest.mark.sample
def test_dusk_is_the_same_drive_in_another_light_and_is_taught_beside_it():
    scenes = dusk_scenes("samples/street/empty.toml", "samples/street/vehicles.toml")
    assert set(scenes.empty.effects) == set(scenes.teacher.effects) == {"dusk"}
    assert set(scenes.vehicles.effects) == {"parked", "traffic", "dusk"}
    assert scenes.vehicles.drive == scenes.empty.drive
    shots = shots_of(scenes.empty, Split.DRIVE), shots_of(scenes.teacher, Split.DRIVE)
    first, beside = (shot[0].camera.world_from_cam for shot in shots)
    assert math.dist(first.translation_m, beside.translation_m) == pytest.approx(0.5)
    assert len(shots[1]) >= FEWEST_FRAMES
    assert len({scene.name for scene in (scenes.empty, scenes.teacher, scenes.vehicles)}) == 3


@pytest.mark.parametrize(
    ("arrived_s", "unseen_s", "age_s"),
    [
        (10.15, 0.13, 0.15),
        (10.45, 0.13, 0.25),
        (10.45, 0.33, 0.45),
        (10.2, 0.2, 0.2),
    ],
)
def test_the_age_of_a_notice_is_that_of_its_picture_when_it_arrives(arrived_s, unseen_s, age_s):
    """Captures every 0.2 s: what it says of its age when sent tells of which picture it is."""
    assert age_on_arrival_s(arrived_s, unseen_s, [10.0, 10.2, 10.4]) == pytest.approx(age_s)


def test_a_notice_of_a_picture_that_was_never_taken_has_no_age():
    with pytest.raises(InvalidInput, match=r"unseen_s: 0\.5 s is before the first capture"):
        age_on_arrival_s(10.2, 0.5, [10.0])


@pytest.mark.slow
@pytest.mark.sample
def test_the_generator_knows_what_a_camera_sees_of_each_vehicle():
    truth = SceneTruth("samples/street/vehicles.toml", threads=1)
    drive = Drive.given(
        "samples/street/vehicles.toml,samples/street/transforms_drive_vehicles.json"
    )
    camera = Camera(SMALL, drive.pictures[12].camera.world_from_cam)
    time_s = drive.time_s(12)
    _, labels = truth._renderer.cast(camera, time_s)
    vehicles = truth.vehicles(camera, time_s)
    seen = int((labels == Label.VEHICLE).sum())
    assert 0.9 * seen < sum(vehicle.pixels for vehicle in vehicles) <= seen + 4
    moving = [vehicle for vehicle in vehicles if vehicle.number >= len(truth._parked)]
    assert moving, "traffic of the scene"
    eye = camera.world_from_cam.translation_m
    for vehicle in vehicles:
        reach_m = vehicle.footprint.distance_m(eye)
        assert vehicle.nearest_m < reach_m + 6
        ahead = camera.cam_from_world().apply((*vehicle.footprint.outline_m[0].tolist(), CAMERA_M))
        assert ahead[2] > -6


def test_what_is_no_drive_or_case_is_refused(tmp_path):
    with pytest.raises(InvalidInput, match="'nothing' is not SCENE"):
        Drive.given("nothing")
    asked = EvalWorld(only=("weather",), work=tmp_path, out=tmp_path / "world.json")
    with pytest.raises(InvalidInput, match="'weather' is none of objects, dusk, views"):
        run_world(asked)
    assert not asked.out.exists()


@pytest.mark.sample
def test_a_case_can_be_measured_by_itself_and_others_are_kept(tmp_path):
    out = tmp_path / "world.json"
    run_world(EvalWorld(only=("cost",), work=tmp_path, out=out))
    result = json.loads(out.read_text())
    assert result["kind"] == "world"
    assert [row["part"] for row in result["rows"]] == ["cost"] * 3
    assert {"case", "bound", "measured", "held"} <= set(result["rows"][0])
    kept = {**result["rows"][0], "part": "views", "case": "kept"}
    out.write_text(json.dumps({**result, "rows": [kept]}))
    run_world(EvalWorld(only=("cost",), work=tmp_path, out=out))
    again = json.loads(out.read_text())["rows"]
    assert [row["part"] for row in again] == ["views", *["cost"] * 3]
