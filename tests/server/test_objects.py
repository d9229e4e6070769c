"""Things that are not in the field are found where they stand, and followed."""

import math
from dataclasses import replace

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.field import SplatField
from rfcore.perception.composition import LivePicture, live_picture
from rfcore.perception.contacts import Detection, detect
from rfcore.perception.ground import FieldGround
from rfcore.perception.objects import FORGOTTEN_S, REPEAT_S, ObjectReports, ObjectTracker
from rfcore.raster.gaussians import Gaussians

INTRINSICS = Intrinsics(320, 180, 260.0, 260.0, 160.0, 80.0)
CAMERA_M = 1.5
FRONT = ("cav-1", "front")


def surface(points: np.ndarray, level: float, thin: int, seed: int = 0) -> Gaussians:
    """Opaque flat Gaussians at ``points`` [N, 3], thin along axis ``thin``; grey, a bit uneven."""
    n = len(points)
    points = points[:, [0, 2, 1]] * [1, 1, -1]  # z is up in a tile
    thin = (0, 2, 1)[thin]
    levels = level + np.random.default_rng(seed).uniform(-0.05, 0.05, n)
    sh = np.repeat((levels[:, None, None] - 0.5) / 0.28209479, 3, axis=2).astype(np.float32)
    turns = np.tile(np.float32([1, 0, 0, 0]), (n, 1))
    scales = np.full((n, 3), np.log(0.12), np.float32)
    scales[:, thin] = np.log(0.005)
    return Gaussians(
        np.ascontiguousarray(points, np.float32), turns, scales, np.full(n, 8.0, np.float32), sh
    )


def grid(a: tuple[float, float], b: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    first, second = np.meshgrid(np.arange(*a, 0.15), np.arange(*b, 0.15))
    return first.ravel(), second.ravel()


def street() -> Gaussians:
    """Ground (y down, CAMERA_M below the camera) up to a wall at 22 m."""
    x, z = grid((-5, 5), (2, 22))
    ground = np.stack([x, np.full_like(x, CAMERA_M), z], 1)
    x, y = grid((-9, 9), (-4, CAMERA_M))
    wall = np.stack([x, y, np.full_like(x, 22.0)], 1)
    return joined(surface(ground, 0.45, 1), surface(wall, 0.5, 2)).gaussians


def joined(a: Gaussians, b: Gaussians) -> SplatField:
    names = ("means", "quaternions", "log_scales", "opacity_logits", "sh")
    return SplatField(
        Gaussians(**{n: np.concatenate([getattr(a, n), getattr(b, n)]) for n in names})
    )


def car(x_m: float, z_m: float) -> Gaussians:
    """A box 1.8 m wide and 1.4 m high whose near side is at ``z_m``."""
    x, y = grid((x_m - 0.9, x_m + 0.9), (CAMERA_M - 1.4, CAMERA_M))
    near = [np.stack([x, y, np.full_like(x, z)], 1) for z in (z_m, z_m + 1)]
    return surface(np.concatenate(near), 0.9, 2, 1)


STREET = street()
FIELD = SplatField(STREET)
GROUND = FieldGround(FIELD.render)


def camera_at(x_m: float = 0.0, yaw_rad: float = 0.0) -> Camera:
    yaw = Pose((0.0, 0.0, 0.0), (math.cos(yaw_rad / 2), 0.0, math.sin(yaw_rad / 2), 0.0))
    level = Pose((x_m, 0.0, 0.0), (math.sqrt(0.5), -math.sqrt(0.5), 0.0, 0.0))
    return Camera(INTRINSICS, level.compose(yaw))


def seen(
    field: SplatField, camera: Camera, sigma: float = 0.0, gain: float = 1.0
) -> list[Detection]:
    colour = field.render(camera).colour.clip(0, 1) * 255 * gain
    noise = np.random.default_rng(5).normal(scale=sigma, size=colour.shape)
    rgb = np.clip(np.rint(colour + noise), 0, 255).astype(np.uint8)
    return detect(live_picture(camera, rgb, FIELD.render(camera)), GROUND)


@pytest.mark.parametrize("z_m", [6.0, 10.0, 15.0])
@pytest.mark.parametrize(("sigma", "gain"), [(0.0, 1.0), (3.0, 1.0), (3.0, 0.4)])
def test_a_car_is_found_where_it_stands(z_m: float, sigma: float, gain: float) -> None:
    """Also with a noisy camera, and at dusk beside a field of noon."""
    (found,) = seen(joined(STREET, car(0.8, z_m)), camera_at(), sigma, gain)
    assert math.dist(found.at_m, (0.8, z_m, -CAMERA_M)) < 0.5 + 0.03 * z_m
    assert found.width_m == pytest.approx(1.8, rel=0.4)
    assert found.height_m == pytest.approx(1.4, rel=0.35)


def box(x_m: float, z_m: float, width_m: float, level: float) -> Gaussians:
    """A side 1.6 m high that faces the camera."""
    x, y = grid((x_m - width_m / 2, x_m + width_m / 2), (CAMERA_M - 1.6, CAMERA_M))
    return surface(np.stack([x, y, np.full_like(x, z_m)], 1), level, 2, 1)


def shadow(x_m: float, nearest_m: float, furthest_m: float) -> Gaussians:
    """Ground 1.8 m wide with little more than half of its light."""
    x, z = grid((x_m - 0.9, x_m + 0.9), (nearest_m, furthest_m))
    return surface(np.stack([x, np.full_like(x, CAMERA_M - 0.02), z], 1), 0.25, 1, 2)


@pytest.mark.parametrize("z_m", [8.0, 11.0])
def test_a_shadow_before_a_car_is_not_its_foot(z_m: float) -> None:
    shaded = joined(STREET, shadow(0.8, z_m - 1.4, z_m)).gaussians
    (found,) = seen(joined(shaded, car(0.8, z_m)), camera_at())
    assert math.dist(found.at_m, (0.8, z_m, -CAMERA_M)) < 0.5


def test_what_is_dark_as_a_shadow_all_over_stands_where_it_does() -> None:
    (found,) = seen(joined(STREET, box(0.8, 9.0, 1.8, 0.25)), camera_at())
    assert math.dist(found.at_m, (0.8, 9.0, -CAMERA_M)) < 0.8


def test_a_shadow_that_is_long_moves_nothing() -> None:
    """A difference further than ``SHADOW_M`` before a thing may be another thing."""
    shaded = joined(STREET, shadow(0.8, 7.0, 12.0)).gaussians
    (found,) = seen(joined(shaded, car(0.8, 12.0)), camera_at())
    assert math.dist(found.at_m, (0.8, 7.0, -CAMERA_M)) < 0.8


@pytest.mark.parametrize(("width_px", "things"), [(6, 0), (20, 1)])
def test_a_person_is_an_object_and_a_sliver_is_none(width_px: int, things: int) -> None:
    """0.18 and 0.6 m wide, 1.6 m high, at 8 m."""
    camera = camera_at()
    view = FIELD.render(camera)
    rgb = np.rint(view.colour.clip(0, 1) * 255).astype(np.uint8)
    rgb[77:129, 180 : 180 + width_px] = 230
    assert len(detect(live_picture(camera, rgb, view), GROUND)) == things


def test_two_cameras_find_the_same_place() -> None:
    field = joined(STREET, car(0.8, 10.0))
    (a,), (b,) = seen(field, camera_at(-1.0)), seen(field, camera_at(1.5, 0.05))
    assert math.dist(a.at_m, b.at_m) < 0.5


@pytest.mark.parametrize(("sigma", "gain"), [(0.0, 1.0), (3.0, 1.0), (3.0, 0.4)])
def test_an_empty_street_has_no_objects(sigma: float, gain: float) -> None:
    assert seen(FIELD, camera_at(), sigma, gain) == []


def test_what_hangs_on_a_wall_is_no_object() -> None:
    x, y = grid((-1.0, 1.0), (-2.0, 0.0))
    poster = surface(np.stack([x, y, np.full_like(x, 21.9)], 1), 0.95, 2, 1)
    assert seen(joined(STREET, poster), camera_at()) == []


def test_a_hole_in_a_thing_that_stands_on_no_level_ground_is_no_foot_of_another() -> None:
    """Where a vehicle looks like the street behind it, below what is seen above that; its own foot
    is before a kerb, 5.5 m away, and the hole 18 to 20 m."""
    camera = camera_at()
    view = FIELD.render(camera)
    rgb = np.rint(view.colour.clip(0, 1) * 255).astype(np.uint8)
    street = rgb.copy()
    rgb[70:151, 150:190] = 230
    rgb[100:104, 150:190] = street[100:104, 150:190]
    live = live_picture(camera, rgb, view)
    assert len(detect(live, GROUND)) == 1
    depth = live.depth.copy()
    depth[145:, 150:190] = 5.5
    assert detect(replace(live, depth=depth), GROUND) == []


def test_two_cars_are_two_and_one_without_a_foot_in_the_picture_is_none() -> None:
    both = joined(car(-2.0, 9.0), car(2.0, 12.0))
    left, right = seen(joined(STREET, both.gaussians), camera_at())
    assert left.at_m[0] < 0 < right.at_m[0]
    assert seen(joined(STREET, car(0.0, 3.0)), camera_at()) == []


def at(
    x_m: float, y_m: float = 10.0, eye_m: tuple[float, float] = (0.0, 0.0), marked_px: int = 150
) -> Detection:
    """A thing as a camera at ``eye_m`` sees it; small, unless ``marked_px`` says otherwise."""
    range_m = math.dist((x_m, y_m), eye_m)
    sigmas_m = 0.3 + 0.002 * range_m**2, 0.3 + 0.006 * range_m
    return Detection((x_m, y_m, -CAMERA_M), (*eye_m, 0.0), 1.8, 1.4, marked_px, *sigmas_m)


def test_a_thing_that_moves_is_followed_with_its_velocity() -> None:
    tracker = ObjectTracker()
    for step in range(20):
        tracker.take([at(-5.0 + 0.5 * step)], FRONT, 0.1 * step)
    (thing,) = tracker.confirmed(1.9)
    assert thing.object_id == 1
    assert thing.at(1.9)[0] == pytest.approx(4.5, abs=0.15)
    assert thing.velocity_mps[0] == pytest.approx(5.0, abs=0.5)
    assert thing.confidence(1.9) == 1.0
    assert thing.seen_by(1.9) == [FRONT]


def test_a_thing_is_doubtful_while_nobody_sees_it_whose_picture_fits_the_field() -> None:
    tracker = ObjectTracker()
    for step in range(4):
        tracker.take([replace(at(1.0), trust=0.6)], FRONT, 0.1 * step)
    (thing,) = tracker.confirmed(0.3)
    assert thing.report(0.3).is_doubtful
    tracker.take([replace(at(1.0), trust=0.9)], ("cav-2", "front"), 0.4)
    (thing,) = tracker.confirmed(0.4)
    assert not thing.report(0.4).is_doubtful


def test_two_vehicles_that_see_one_thing_see_one_thing() -> None:
    tracker = ObjectTracker()
    for step in range(6):
        camera = FRONT if step % 2 else ("cav-2", "front")
        tracker.take([at(1.0 + 0.2 * (step % 2))], camera, 0.1 * step)
    (thing,) = tracker.confirmed(0.5)
    assert thing.seen_by(0.5) == [FRONT, ("cav-2", "front")]
    assert math.hypot(*thing.velocity_mps) < 1.0


def test_what_is_large_is_confirmed_at_once_and_what_two_vehicles_see_by_the_second() -> None:
    tracker = ObjectTracker()
    tracker.take([at(-4.0), at(0.0, marked_px=900), at(4.0)], FRONT, 0.0)
    assert [thing.at_m[0] for thing in tracker.confirmed(0.0)] == [pytest.approx(0.0)]
    assert tracker.confirmed(0.0)[0].confidence(0.0) <= 0.25, "nobody else has seen it yet"
    tracker.take([at(4.0)], ("cav-1", "left"), 0.05)
    assert len(tracker.confirmed(0.05)) == 1, "a vehicle's own cameras are one witness"
    tracker.take([at(-4.0)], ("cav-2", "front"), 0.05)
    assert [round(thing.at_m[0]) for thing in tracker.confirmed(0.05)] == [-4, 0]


RIG = tuple(("cav-1", name) for name in ("front", "left", "right"))


def test_the_cameras_of_a_rig_are_one_witness_of_an_instant() -> None:
    """Three pictures of one instant, of 250 marked pixels each, which come in any order."""
    tracker = ObjectTracker()
    for instant, time_s in enumerate((0.0, 0.1, 0.2)):
        for number, camera in enumerate(RIG):
            tracker.take([at(1.0, marked_px=250)], camera, time_s + 0.001 * number)
            assert len(tracker.confirmed(time_s)) == (instant == 2)
    (thing,) = tracker.confirmed(0.2)
    assert thing.seen == 3
    assert thing.marked_px == 750, "of each instant the picture that shows most of it"
    assert thing.confidence(0.202) == pytest.approx(0.75)


def test_a_rig_with_a_wrong_pose_moves_a_thing_no_more_than_one_camera_does() -> None:
    placed_m = []
    for cameras in (RIG[:1], RIG):
        tracker = ObjectTracker()
        for step in range(4):
            time_s = 0.1 * step
            for vehicle in ("cav-2", "cav-3"):
                tracker.take([at(1.0)], (vehicle, "front"), time_s)
            for camera in cameras:
                tracker.take([at(2.2)], camera, time_s)
        (thing,) = tracker.confirmed(0.3)
        placed_m.append(thing.at_m)
    assert placed_m[1] == pytest.approx(placed_m[0])


def test_a_thing_of_which_pictures_show_the_field_instead_is_less_sure() -> None:
    """A ghost that one vehicle sees wherever it drives, and another never."""
    tracker, sure = ObjectTracker(), []
    for step in range(30):
        time_s = 0.1 * step
        tracker.take([at(1.0)], FRONT, time_s)
        (begun,) = [each.confidence(time_s) for each in tracker._objects]
        sure.append(begun)
        tracker.take([], ("cav-2", "front"), time_s + 0.05, lambda *_: True)
    assert max(sure[4:]) < 0.6
    tracker.take([], ("cav-3", "front"), 2.96, lambda *_: False)
    (ghost,) = tracker.confirmed(2.97)
    assert ghost.confidence(2.9) == pytest.approx(0.5), "who cannot see it says nothing"


def test_what_one_camera_of_a_rig_sees_no_other_of_it_misses() -> None:
    for order in (RIG, RIG[::-1]):
        tracker = ObjectTracker()
        for step in range(6):
            for camera in order:
                found = [at(1.0)] if camera == FRONT else []
                tracker.take(found, camera, 0.1 * step, lambda *_: True)
        (thing,) = tracker.confirmed(0.5)
        assert thing.confidence(0.5) == 1.0


def picture_of(field: SplatField, camera: Camera) -> LivePicture:
    rgb = np.rint(field.render(camera).colour.clip(0, 1) * 255).astype(np.uint8)
    return live_picture(camera, rgb, FIELD.render(camera))


def test_a_picture_lacks_what_it_should_show_and_does_not() -> None:
    empty, with_car = picture_of(FIELD, camera_at()), picture_of(joined(STREET, car(0.8, 10.0)),
                                                                 camera_at())  # fmt: skip
    foot_m, size_m = (0.8, 10.0, -CAMERA_M), (1.8, 1.4)
    assert empty.rules_out(foot_m, *size_m)
    assert not with_car.rules_out(foot_m, *size_m), "something is there"
    assert with_car.rules_out((-3.0, 12.0, -CAMERA_M), *size_m), "and nothing beside it"
    assert not with_car.rules_out((0.8, 14.0, -CAMERA_M), *size_m), "behind it nobody knows"
    for elsewhere in ((0.8, -10.0), (20.0, 10.0), (0.8, 2.0), (0.8, 30.0)):
        assert not empty.rules_out((*elsewhere, -CAMERA_M), *size_m), (
            "outside of the picture, or far"
        )
    assert not replace(empty, trust=0.0).rules_out(foot_m, *size_m)
    wall_m = np.full_like(empty.depth, 4.0)
    assert not replace(empty, depth=wall_m).rules_out(foot_m, *size_m), (
        "behind a surface of the field"
    )


def test_what_stands_has_no_velocity_though_its_range_is_uncertain() -> None:
    """Driving towards it at 9 m/s; far away it seems a metre nearer than it is."""
    tracker = ObjectTracker()
    for step in range(10):
        eye_m = (0.0, 0.9 * step)
        short_m = 0.003 * (25.0 - eye_m[1]) ** 2
        tracker.take([at(3.0, 25.0 - short_m, eye_m)], FRONT, 0.1 * step)
    (thing,) = tracker.confirmed(0.9)
    assert thing.velocity_mps == (0.0, 0.0, 0.0)
    assert math.dist(thing.at_m[:2], (3.0, 25.0)) < 1.4


def test_an_oncoming_vehicle_is_where_it_is_not_where_it_was() -> None:
    """At 9 m/s, seen by one that comes at 9 m/s, from its third picture on."""
    tracker = ObjectTracker()
    for step in range(8):
        y_m, eye_m = 30.0 - 0.9 * step, (0.0, 0.9 * step)
        tracker.take([at(-2.0, y_m, eye_m)], FRONT, 0.1 * step)
    (thing,) = tracker.confirmed(0.7)
    assert thing.at(0.7)[1] == pytest.approx(30.0 - 6.3, abs=0.7)
    assert thing.velocity_mps[1] == pytest.approx(-9.0, abs=2.5)


def test_two_pictures_confirm_nothing_small_and_what_nobody_sees_is_forgotten() -> None:
    tracker = ObjectTracker()
    for time_s in (0.0, 0.05):
        tracker.take([at(0.0)], FRONT, time_s)
        assert tracker.confirmed(time_s) == []
    tracker.take([at(0.0)], FRONT, 0.1)
    assert len(tracker.confirmed(0.1)) == 1
    assert tracker.confirmed(0.6)[0].confidence(0.6) < tracker.confirmed(0.1)[0].confidence(0.1)
    assert tracker.confirmed(1.2) == []
    for time_s in (2.0, 2.05, 2.1):
        tracker.take([at(0.0)], FRONT, time_s)
    assert [thing.object_id for thing in tracker.confirmed(2.1)] == [2], "an id is never used again"


def test_things_side_by_side_keep_their_identity_in_any_order() -> None:
    tracker = ObjectTracker()
    for step in range(8):
        things = [at(-2.0 + 0.2 * step), at(2.0)]
        tracker.take(things[:: 1 if step % 2 else -1], FRONT, 0.1 * step)
    by_id = {thing.object_id: thing.at(0.7)[0] for thing in tracker.confirmed(0.7)}
    assert sorted(by_id.values()) == pytest.approx([-0.6, 2.0], abs=0.15)
    assert sorted(by_id) == [1, 2]


def test_a_picture_that_comes_late_moves_nothing_wildly() -> None:
    tracker = ObjectTracker()
    for time_s in (0.0, 0.1, 0.2, 0.15, 0.2, 0.3):
        tracker.take([at(10.0 * time_s)], FRONT, time_s)
    (thing,) = tracker.confirmed(0.3)
    assert thing.last_s == 0.3
    assert abs(thing.velocity_mps[0]) < 20


def test_objects_are_told_of_as_of_now_and_again_until_none_is_left() -> None:
    """A mover at 10 m/s whose pictures are 0.2 s old when they are looked at, and then stop."""
    told = ObjectReports()
    assert told.now(0.0) == ()
    assert told.again_s == math.inf, "where nothing is, nothing is told again"
    for step in range(8):
        told.tracker.take([at(-4.0 + step)], FRONT, 0.1 * step)
    (thing,) = told.now(0.9)
    assert thing.at_m[0] == pytest.approx(5.0, abs=0.3)
    assert thing.unseen_s == pytest.approx(0.2)
    counts, now = [], told.again_s
    assert now == 0.9 + REPEAT_S
    while math.isfinite(now):
        counts.append(len(told.now(now)))
        now = told.again_s
    assert counts == [1, 0], f"forgotten {FORGOTTEN_S} s after its last picture"


def test_a_thing_is_called_what_a_detector_calls_it_most_often() -> None:
    tracker = ObjectTracker()
    names = ["", "van", "car", "car", ""]
    for step, name in enumerate(names):
        tracker.take([at(-4.0), at(4.0)], FRONT, 0.1 * step, labels=["", name])
    unknown, car_ = tracker.confirmed(0.4)
    assert (unknown.report(0.4).label, car_.report(0.4).label) == ("", "car")
