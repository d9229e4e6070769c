"""Things that cameras see stand at their own depth in views from elsewhere."""

import math

import numpy as np
import pytest

from rfcore.perception.composition import LivePicture, compose, live_picture, with_things
from rfcore.perception.contacts import find
from server.test_objects import CAMERA_M, FIELD, GROUND, STREET, camera_at, car, joined

AGE_S, MAX_S = 0.1, 2.0
WITH_CAR = joined(STREET, car(0.8, 8.0))
ASIDE_M = 1.5


def picture_of(x_m: float) -> LivePicture:
    camera = camera_at(x_m)
    rgb = np.rint(WITH_CAR.render(camera).colour.clip(0, 1) * 255).astype(np.uint8)
    return live_picture(camera, rgb, FIELD.render(camera))


def standing(x_m: float) -> LivePicture:
    live = picture_of(x_m)
    return with_things(live, [each.outline for each in find(live, GROUND)])


def truth(x_m: float) -> np.ndarray:
    return np.rint(WITH_CAR.render(camera_at(x_m)).colour.clip(0, 1) * 255)


def error(rgb: np.ndarray, x_m: float) -> float:
    return float(((rgb - truth(x_m)) ** 2).mean())


def test_from_aside_a_car_is_where_it_is_and_not_on_what_is_behind_it() -> None:
    view = FIELD.render(camera_at(ASIDE_M))
    painted = compose(camera_at(ASIDE_M), view, [(picture_of(0.0), AGE_S)], MAX_S)
    stands = compose(camera_at(ASIDE_M), view, [(standing(0.0), AGE_S)], MAX_S)
    assert error(stands.rgb, ASIDE_M) < 0.5 * error(painted.rgb, ASIDE_M)
    assert error(stands.rgb, ASIDE_M) < 0.5 * error(np.rint(view.colour.clip(0, 1) * 255), ASIDE_M)
    there = WITH_CAR.render(camera_at(ASIDE_M)).depth
    is_car = (there > 7.5) & (there < 8.5) & (view.depth > 10)
    assert np.median(np.abs(stands.depth[is_car] - there[is_car])) < 0.4
    assert np.isfinite(stands.age_s[is_car]).mean() > 0.7


def test_of_two_pictures_of_one_car_the_younger_one_counts() -> None:
    old, young = standing(-0.5), standing(0.5)
    camera = camera_at(0.0)
    composed = compose(camera, FIELD.render(camera), [(old, 1.5), (young, AGE_S)], MAX_S)
    alone = compose(camera, FIELD.render(camera), [(young, AGE_S)], MAX_S)
    is_thing = np.abs(alone.depth - FIELD.render(camera).depth) > 1
    assert is_thing.sum() > 500
    assert (composed.age_s[is_thing] == np.float32(AGE_S)).mean() > 0.98


def test_the_camera_does_not_vouch_for_what_its_car_hides() -> None:
    live = standing(0.0)
    (thing,) = live.things
    patch = thing.patch
    height, width = patch.samples.shape[:2]
    box = (slice(patch.top, patch.top + height), slice(patch.left, patch.left + width))
    assert (live.depth[box][patch.samples[..., 3] > 0] == 0).all()
    assert math.dist(thing.foot_m, (0.8, 8.0, -CAMERA_M)) < 0.8


@pytest.mark.parametrize("x_m", [-3.0, 3.0])
def test_behind_a_wall_nothing_of_it_is_seen(x_m: float) -> None:
    """The field's own surfaces hide it: here everything is drawn as nearer than the car."""
    view = FIELD.render(camera_at(x_m))
    near = type(view)(
        view.colour, np.minimum(view.depth, np.float32(3.0)), np.ones_like(view.depth)
    )
    composed = compose(camera_at(x_m), near, [(standing(0.0), AGE_S)], MAX_S)
    assert np.array_equal(composed.depth, near.depth)


def test_a_picture_as_old_as_may_be_leaves_nothing_standing() -> None:
    camera = camera_at(0.3)
    view = FIELD.render(camera)
    gone = compose(camera, view, [(standing(0.0), MAX_S)], MAX_S)
    assert np.array_equal(gone.rgb, compose(camera, view, [], MAX_S).rgb)
