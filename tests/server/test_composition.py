"""Live pictures carried to another view: what changed comes along, nothing else does."""

import math
from dataclasses import replace

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.field import SplatField
from rfcore.native.yuv import i420_from_rgb
from rfcore.perception.composition import LivePicture, compose, live_picture, nearest, shrunk
from rfcore.raster.gaussians import Gaussians
from rfcore.views import View

INTRINSICS = Intrinsics(96, 64, 80.0, 80.0, 48.0, 32.0)
LIVE_S = 0.1
MAX_S = 2.0


def block(low: tuple[float, float], high: tuple[float, float], z_m: float, seed: int) -> Gaussians:
    """An opaque rectangle at one depth, of a pattern of greys in squares of 0.5 m."""
    x, y = np.meshgrid(np.arange(low[0], high[0], 0.1), np.arange(low[1], high[1], 0.1))
    means = np.stack([x.ravel(), y.ravel(), np.full(x.size, z_m)], 1).astype(np.float32)
    n = len(means)
    cells = np.floor(means[:, :2] * 2).astype(int)
    level = np.random.default_rng(seed).uniform(0.25, 0.75, (64, 64))[cells[:, 0], cells[:, 1]]
    sh = np.repeat((level[:, None, None] - 0.5) / 0.28209479, 3, axis=2).astype(np.float32)
    turns = np.tile(np.float32([1, 0, 0, 0]), (n, 1))
    scales = np.full((n, 3), np.log(0.1), np.float32)
    return Gaussians(means, turns, scales, np.full(n, 8.0, np.float32), sh)


def joined(*parts: Gaussians) -> SplatField:
    names = ("means", "quaternions", "log_scales", "opacity_logits", "sh")
    return SplatField(
        Gaussians(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in names})
    )


WALL = block((-5.0, -4.0), (5.0, 4.0), 4.0, seed=3)
PILLAR = block((-0.3, -4.0), (0.3, 4.0), 2.0, seed=4)
CAR = block((-0.6, 0.0), (0.6, 0.8), 3.6, seed=9)
STREET = joined(WALL)
WITH_CAR = joined(WALL, CAR)


def at(x_m: float, yaw_rad: float = 0.0) -> Camera:
    turn = (math.cos(yaw_rad / 2), 0.0, math.sin(yaw_rad / 2), 0.0)
    return Camera(INTRINSICS, Pose((x_m, 0.0, 0.0), turn))


def picture(field: SplatField, camera: Camera) -> np.ndarray:
    return np.rint(field.render(camera).colour.clip(0, 1) * 255).astype(np.uint8)


def live(field: SplatField, camera: Camera, rgb: np.ndarray) -> LivePicture:
    return live_picture(camera, rgb, field.render(camera))


def squared_error(a: np.ndarray, b: np.ndarray, where: np.ndarray) -> float:
    return float(((a.astype(float) - b)[where] ** 2).mean())


@pytest.mark.parametrize("sigma", [0.0, 3.0])
def test_an_unchanged_street_looks_to_the_bit_as_the_field_does(sigma: float) -> None:
    noise = np.random.default_rng(1).normal(scale=sigma, size=(64, 96, 3))
    rgb = np.clip(np.rint(picture(STREET, at(-0.4)) + noise), 0, 255).astype(np.uint8)
    seen = live(STREET, at(-0.4), rgb)
    view = STREET.render(at(0.2))
    composed = compose(at(0.2), view, [(seen, LIVE_S)], MAX_S)
    assert np.array_equal(composed.rgb, picture(STREET, at(0.2)))
    assert composed.shares[0] > 0.6, "it vouches for what it confirms"
    assert np.array_equal(composed.depth, view.depth)


def test_a_car_that_one_camera_sees_is_better_there_in_a_neighbouring_view() -> None:
    seen = live(STREET, at(-0.3), picture(WITH_CAR, at(-0.3)))
    neighbour = at(0.0)
    truth, field = picture(WITH_CAR, neighbour), picture(STREET, neighbour)
    composed = compose(neighbour, STREET.render(neighbour), [(seen, LIVE_S)], MAX_S)
    changed = np.abs(truth.astype(int) - field).max(axis=2) > 10
    assert changed.sum() > 200
    before, after = (squared_error(rgb, truth, changed) for rgb in (field, composed.rgb))
    assert 10 * math.log10(before / after) >= 2.0
    assert squared_error(composed.rgb, truth, changed | ~changed) < squared_error(
        field, truth, changed | ~changed
    )


def test_a_picture_at_its_own_pose_is_shown_as_it_is() -> None:
    rgb = picture(STREET, at(0.0))
    rgb[20:40, 30:60] = 250
    seen = live(STREET, at(0.0), rgb)
    composed = compose(at(0.0), STREET.render(at(0.0)), [(seen, LIVE_S)], MAX_S)
    inside = composed.rgb[24:36, 34:56].astype(int)
    assert np.abs(inside - 250).max() <= 1
    assert composed.age_s[30, 45] == np.float32(LIVE_S)


def test_what_another_surface_hides_from_the_camera_is_never_carried() -> None:
    field = joined(WALL, PILLAR)
    camera, aside = at(0.0), at(1.0)
    rgb = picture(field, camera)
    pillar = field.render(camera).depth < 2.5
    rgb[pillar] = 255
    seen = live(field, camera, rgb)
    composed = compose(aside, field.render(aside), [(seen, LIVE_S)], MAX_S)
    # The wall behind the pillar: its points lie in the pillar's shadow as seen from the camera.
    depth = field.render(aside).depth
    wall = depth > 3.8
    x_m = 1.0 + (np.arange(96) + 0.5 - 48.0) / 80.0 * depth
    hidden = wall & (np.abs(x_m) < 0.4)
    assert hidden.sum() > 100
    assert np.isinf(composed.age_s[hidden]).all()
    assert np.array_equal(composed.rgb[hidden], picture(field, aside)[hidden])
    assert np.isfinite(composed.age_s[depth < 2.1]).mean() > 0.8, "the pillar itself is seen"


def test_pixels_age_fade_and_are_gone() -> None:
    rgb = picture(STREET, at(0.0))
    rgb[20:40, 30:60] = 250
    seen, view = live(STREET, at(0.0), rgb), STREET.render(at(0.0))
    field = picture(STREET, at(0.0)).astype(int)
    shown = []
    for age_s in (0.0, 1.0, 1.5, 1.9, 2.0, 60.0):
        composed = compose(at(0.0), view, [(seen, age_s)], MAX_S)
        shown.append(int((composed.rgb.astype(int) - field)[30, 45].mean()))
        assert np.isfinite(composed.age_s).any() == (age_s < MAX_S)
    assert shown[0] == shown[1] > shown[2] > shown[3] > shown[4] == shown[5] == 0


def test_a_picture_from_a_wrong_pose_is_left_out() -> None:
    wrong = live(STREET, at(0.0), picture(STREET, at(0.0, 0.3))[::-1].copy())
    composed = compose(at(0.1), STREET.render(at(0.1)), [(wrong, LIVE_S)], MAX_S)
    assert wrong.trust == 0.0
    assert composed.shares == (0.0,)
    assert np.array_equal(composed.rgb, picture(STREET, at(0.1)))


def test_two_cameras_that_see_nothing_outvote_one_that_sees_something() -> None:
    rgb = picture(STREET, at(0.0))
    rgb[20:40, 30:60] = 250
    liar = live(STREET, at(0.0), rgb)
    honest = [live(STREET, at(x), picture(STREET, at(x))) for x in (-0.1, 0.1)]
    pictures = [(liar, LIVE_S), *((each, LIVE_S) for each in honest)]
    composed = compose(at(0.0), STREET.render(at(0.0)), pictures, MAX_S)
    assert np.array_equal(composed.rgb[24:36, 34:56], picture(STREET, at(0.0))[24:36, 34:56])
    assert composed.shares[0] < 0.5


def test_the_cameras_of_a_rig_have_one_word_and_an_honest_vehicle_is_heard() -> None:
    """Three cameras of a rig see something at the same pixels, and another vehicle does not."""
    rgb = picture(STREET, at(0.0))
    rgb[20:40, 30:60] = 250
    liar = live(STREET, at(0.0), rgb)
    liar = replace(liar, trust=0.8)
    honest = live(STREET, at(0.05), picture(STREET, at(0.05)))
    pictures = [*[(liar, LIVE_S)] * 3, (honest, LIVE_S)]
    view, inside = STREET.render(at(0.0)), (slice(24, 36), slice(34, 56))
    composed = compose(at(0.0), view, pictures, MAX_S, ["rig", "rig", "rig", "cav-2"])
    assert np.array_equal(composed.rgb[inside], picture(STREET, at(0.0))[inside])
    apart = compose(at(0.0), view, pictures, MAX_S)
    assert np.abs(apart.rgb[inside].astype(int) - 250).max() <= 1, "three vehicles outvote one"


def turned(x_m: float, yaw_rad: float = 0.0) -> Pose:
    return at(x_m, yaw_rad).world_from_cam


def test_the_pictures_that_see_most_of_a_view_are_taken() -> None:
    """Those that look the other way are nearer; a vehicle of many cameras leaves room."""
    poses = {
        ("other way", 0): turned(0.1, math.pi),
        ("aside", 0): turned(0.2, math.pi / 2),
        ("rig", 0): turned(0.3),
        ("rig", 1): turned(0.4),
        ("rig", 2): turned(0.5),
        ("far", 0): turned(3.0),
        ("further", 0): turned(4.0),
        ("lost", 0): None,
    }
    found = nearest(list(poses), at(0.0), poses.get, lambda it: it[0])
    assert found == [("rig", 0), ("rig", 1), ("far", 0), ("further", 0)]
    alone = [key for key in poses if key[0] == "rig"]
    assert nearest(alone, at(0.0), poses.get, lambda it: it[0]) == alone
    assert nearest([("other way", 0)], at(0.0), poses.get) == [("other way", 0)]
    away = Pose((0.0, 0.0, -81.0), (1.0, 0.0, 0.0, 0.0))
    assert nearest([("away", 0)], at(0.0), lambda _: away) == []


@pytest.mark.parametrize(("levels", "changes"), [(100.0, False), (86.0, False), (60.0, True)])
def test_where_the_field_is_darker_a_smaller_difference_is_a_change(
    levels: float, changes: bool
) -> None:
    """The difference is 20 levels, in a twentieth of the picture."""
    noise = np.random.default_rng(5).uniform(-20, 20, (64, 96, 3))
    colour = ((levels + noise) / 255).astype(np.float32)
    flat = np.ones((64, 96), np.float32)
    rgb = np.rint(colour * 255).astype(np.uint8)
    rgb[20:36, 40:60] += 20
    seen = live_picture(at(0.0), rgb, View(colour, 4 * flat, flat))
    assert seen.changed[24:32, 44:56].all() == changes
    assert seen.changed[:16].sum() == 0, "nothing is different there"


def test_another_light_is_no_change() -> None:
    camera = at(0.0)
    rgb = np.rint(picture(STREET, camera) * 0.5 + 12).astype(np.uint8)
    seen = live(STREET, camera, rgb)
    assert seen.trust > 0.95
    assert np.abs(seen.difference).max() < 8


def test_a_camera_vouches_for_nothing_far_away_or_from_the_side() -> None:
    seen = live(STREET, at(0.0), picture(STREET, at(0.0)))
    far = replace(seen, depth=seen.depth * np.float32(12), trust=1.0)
    view = STREET.render(at(0.0))
    view = type(view)(view.colour, view.depth * np.float32(12), view.opacity)
    composed = compose(at(0.0), view, [(far, LIVE_S)], MAX_S)
    assert np.isinf(composed.age_s).all()
    behind = Camera(INTRINSICS, Pose((0.0, 0.0, 8.0), (0.0, 0.0, 1.0, 0.0)))
    composed = compose(behind, STREET.render(behind), [(seen, LIVE_S)], MAX_S)
    assert np.isinf(composed.age_s).all(), "the other side of a wall is another surface"


def test_no_pictures_and_no_surface_are_the_field() -> None:
    away = at(0.0, math.pi)
    composed = compose(away, STREET.render(away), [], MAX_S)
    assert np.isinf(composed.age_s).all()
    nothing = live(STREET, away, picture(STREET, away))
    assert nothing.trust == 0.0
    composed = compose(away, STREET.render(away), [(nothing, LIVE_S)], MAX_S)
    assert np.array_equal(composed.rgb, picture(STREET, away))


def test_a_large_picture_is_shrunk_with_its_camera() -> None:
    k = Intrinsics(1921, 1081, 1000.0, 900.0, 960.0, 540.0)
    rgb = np.full((1081, 1921, 3), 90, np.uint8)
    small, camera = shrunk(i420_from_rgb(rgb), k)
    assert small.shape == (360, 640, 3)
    assert (camera.width_px, camera.height_px, camera.fx_px) == (640, 360, 1000 / 3)
    assert np.abs(small.astype(int) - 90).max() <= 1
