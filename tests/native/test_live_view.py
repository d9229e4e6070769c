"""The kernels of live views compute, to the bit, what their module defines."""

import math
from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfcore.native.live_view import (
    ABSOLUTE_DEPTH_M,
    CHANGE_LEVELS,
    COVERED,
    LEAST_COSINE,
    LEAST_RESOLUTION,
    MOST_DISTANCE_M,
    MOST_SOURCES,
    NEAREST_M,
    NOBODY,
    NOISE_LEVELS,
    OWN_LIGHT,
    RELATIVE_DEPTH,
    Light,
    LiveSource,
    carry_to_view,
    live_difference,
)
from rfcore.views import View

F = np.float32
F32 = NDArray[np.float32]
WINDOW = 7


def random_view(rng: np.random.Generator, width: int, height: int) -> View:
    """Depths of two surfaces with holes; colours a little beyond 0..1."""
    depth = np.where(rng.random((height, width)) < 0.5, 6.0, 9.0) + rng.normal(
        scale=0.2, size=(height, width)
    )
    opacity = rng.choice([0.0, 0.5, 0.6, 1.0], p=[0.1, 0.1, 0.2, 0.6], size=depth.shape)
    depth[opacity == 0] = 0
    colour = rng.uniform(-0.1, 1.1, (height, width, 3))
    return View(colour.astype(F), opacity.astype(F), depth.astype(F))


def camera(width: int, height: int, x_m: float = 0.0, yaw_rad: float = 0.0) -> Camera:
    k = Intrinsics(width, height, 0.8 * width, 0.8 * width, width / 2, height / 2)
    turn = (math.cos(yaw_rad / 2), 0.0, math.sin(yaw_rad / 2), 0.0)
    return Camera(k, Pose((x_m, 0.1, -0.3), turn))


def level(values: F32) -> F32:
    return np.rint(values.clip(0, 255))


def defined_difference(
    rgb: NDArray[np.uint8], view: View, light: Light, brightness: float
) -> tuple[F32, F32]:
    gain, offset = F(light.gain), F(light.offset)
    difference = (rgb.astype(F) - offset) / gain - level(view.colour * F(255))
    half = WINDOW // 2
    padded = np.pad(difference, ((half, half), (half, half), (0, 0)), mode="edge")
    height, width = rgb.shape[:2]
    down = sum((padded[i : i + height] for i in range(WINDOW)), np.zeros(1, F))
    sums = down[:, :width].copy()
    for j in range(1, WINDOW):
        sums += down[:, j : j + width]
    change = np.abs(sums).max(axis=2) / F(WINDOW**2)
    noise, least = F(brightness * NOISE_LEVELS), F(brightness * CHANGE_LEVELS)
    share = ((change - noise) / (least - noise)).clip(0, 1)
    share[view.opacity <= COVERED] = 0
    return difference * share[:, :, None], share


@pytest.mark.parametrize(("width", "height"), [(1, 1), (2, 9), (33, 17), (64, 48)])
@pytest.mark.parametrize("light", [OWN_LIGHT, Light((0.5, 1.3, 2.0), (3.0, -8.5, 0.1))])
@pytest.mark.parametrize("brightness", [1.0, 0.62])
def test_a_change_is_what_is_defined(width, height, light, brightness):
    rng = np.random.default_rng(width)
    view = random_view(rng, width, height)
    near = level(view.colour * F(255)) + rng.normal(scale=25, size=view.colour.shape)
    rgb = near.clip(0, 255).astype(np.uint8)
    difference, share = live_difference(rgb, view, light, brightness)
    expected, expected_share = defined_difference(rgb, view, light, brightness)
    assert difference.tobytes() == expected.tobytes()
    assert share.tobytes() == expected_share.tobytes()


def bilinear(values: F32, u: F32, v: F32) -> F32:
    height, width = values.shape[:2]
    left = np.minimum(u.astype(int), max(width - 2, 0))
    top = np.minimum(v.astype(int), max(height - 2, 0))
    right, below = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    across, down = (u - left.astype(F))[..., None], (v - top.astype(F))[..., None]
    upper = values[top, left] * (F(1) - across) + values[top, right] * across
    lower = values[below, left] * (F(1) - across) + values[below, right] * across
    return upper * (F(1) - down) + lower * down


def defined_source(source: LiveSource, at: Camera, view: View) -> tuple[F32, F32]:
    """Return weight [H, W] and change [H, W, 3] of one source."""
    k, live = at.intrinsics, source.camera.intrinsics
    motion = source.camera.cam_from_world().compose(at.world_from_cam)
    r, t = F(motion.rotation_matrix()), F(motion.translation_m)
    ray_x = (np.arange(k.width_px, dtype=F) + F(0.5) - F(k.cx_px)) / F(k.fx_px)
    ray_y = (np.arange(k.height_px, dtype=F) + F(0.5) - F(k.cy_px)) / F(k.fy_px)
    to = [(r[i, 0] * ray_x)[None] + (r[i, 1] * ray_y + r[i, 2])[:, None] for i in range(3)]
    z = view.depth
    p = [z * to[i] + t[i] for i in range(3)]
    with np.errstate(all="ignore"):
        u = p[0] / p[2] * F(live.fx_px) + (F(live.cx_px) - F(0.5))
        v = p[1] / p[2] * F(live.fy_px) + (F(live.cy_px) - F(0.5))
        along = p[0] * to[0] + p[1] * to[1] + p[2] * to[2]
        lengths = (p[0] * p[0] + p[1] * p[1] + p[2] * p[2]) * (
            to[0] * to[0] + to[1] * to[1] + to[2] * to[2]
        )
        squared = along * along / lengths
        resolution = F(live.fx_px) / F(k.fx_px) * z / p[2]
        weight = squared * squared * np.minimum(resolution, F(1))
        weight = weight * (F(1) - p[2] / F(MOST_DISTANCE_M)) * F(source.weight)
        vouches = (view.opacity > COVERED) & (z > 0) & (p[2] > F(NEAREST_M))
        vouches &= (p[2] < F(MOST_DISTANCE_M)) & (along > 0) & (squared > F(LEAST_COSINE**2))
        vouches &= (u >= 0) & (u <= live.width_px - 1) & (v >= 0) & (v <= live.height_px - 1)
        vouches &= resolution > F(LEAST_RESOLUTION)
    u, v = np.where(vouches, u, F(0)), np.where(vouches, v, F(0))
    seen = source.depth[(v + F(0.5)).astype(int), (u + F(0.5)).astype(int)]
    tolerance = F(RELATIVE_DEPTH) * p[2] + F(ABSOLUTE_DEPTH_M)
    vouches &= (seen > 0) & (np.abs(seen - p[2]) < tolerance)
    return np.where(vouches, weight, F(0)), bilinear(source.difference, u, v) * F(source.fade)


def defined_view(
    at: Camera, view: View, sources: list[LiveSource]
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    chosen = np.full(view.depth.shape, NOBODY, np.uint8)
    change = np.zeros(view.colour.shape, F)
    each = [defined_source(source, at, view) for source in sources]
    for y, x in np.ndindex(*view.depth.shape):
        means, weights = {}, {}
        for i, (weight, changes) in enumerate(each):
            if weight[y, x] > 0:
                red, green, blue = changes[y, x]
                means[i], weights[i] = red + green + blue, weight[y, x]
        owners = Counter(sources[i].owner for i in means)
        shares = {i: weights[i] / F(owners[sources[i].owner]) for i in means}
        order = sorted(means, key=lambda i: (means[i], i))
        total = sum(shares.values(), F(0))
        reached = F(0)
        for i in order:
            reached += shares[i]
            if reached >= total / F(2) or i == order[-1]:
                chosen[y, x], change[y, x] = i, each[i][1][y, x]
                break
    return level(level(view.colour * F(255)) + change).astype(np.uint8), chosen


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(0, 5),
    width=st.integers(1, 24),
    height=st.integers(1, 18),
)
def test_a_view_is_what_is_defined(seed, count, width, height):
    rng = np.random.default_rng(seed)
    view, at = random_view(rng, width, height), camera(width, height)
    sources = []
    for _ in range(count):
        live_width, live_height = int(rng.integers(1, 40)), int(rng.integers(1, 30))
        source_view = random_view(rng, live_width, live_height)
        sources.append(
            LiveSource(
                camera(live_width, live_height, rng.uniform(-1, 1), rng.uniform(-0.3, 0.3)),
                rng.normal(scale=40, size=(live_height, live_width, 3)).astype(F),
                source_view.depth,
                rng.choice([0.0, 0.4, 1.0]),
                rng.choice([0.5, 1.0]),
                int(rng.integers(0, 3)),
            )
        )
    rgb, chosen = carry_to_view(at, view, sources)
    expected, expected_chosen = defined_view(at, view, sources)
    assert chosen.tobytes() == expected_chosen.tobytes()
    assert rgb.tobytes() == expected.tobytes()


def test_a_source_at_the_view_itself_is_taken_where_the_field_has_a_surface():
    rng = np.random.default_rng(4)
    view, at = random_view(rng, 40, 30), camera(40, 30)
    difference = np.full(view.colour.shape, 9.0, F)
    rgb, chosen = carry_to_view(at, view, [LiveSource(at, difference, view.depth, 1.0, 1.0, 0)])
    inside = np.zeros(chosen.shape, bool)
    inside[1:-1, 1:-1] = True
    covered = (view.opacity > COVERED) & inside
    assert (chosen[covered] == 0).all()
    assert (chosen[view.opacity <= COVERED] == NOBODY).all()
    own = level(view.colour * F(255))
    assert np.array_equal(rgb[covered], np.minimum(own[covered] + 9, 255).astype(np.uint8))


def test_pictures_that_do_not_fit_are_refused():
    view = random_view(np.random.default_rng(1), 8, 6)
    with pytest.raises(InvalidInput, match="beside a view"):
        live_difference(np.zeros((6, 9, 3), np.uint8), view, OWN_LIGHT)
    source = LiveSource(camera(8, 6), np.zeros((6, 8, 3), F), view.depth, 1.0, 1.0, 0)
    with pytest.raises(InvalidInput, match="more than 16"):
        carry_to_view(camera(8, 6), view, [source] * (MOST_SOURCES + 1))
    short = LiveSource(camera(8, 6), np.zeros((6, 8, 3), F), view.depth[:5], 1.0, 1.0, 0)
    with pytest.raises(ValueError, match="do not fit"):
        carry_to_view(camera(8, 6), view, [short])
