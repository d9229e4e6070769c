"""The grid of light against its definition in numpy, bit by bit, and by what it must recover."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.native.warp import apply_light, light_shape, relight_i420, solve_light

I64 = NDArray[np.int64]
BINS = 8
MOST = 1 << 16


def halved(luma: I64) -> I64:
    q = np.pad(luma, ((0, luma.shape[0] % 2), (0, luma.shape[1] % 2)), mode="edge")
    return (q[0::2, 0::2] + q[0::2, 1::2] + q[1::2, 0::2] + q[1::2, 1::2] + 2) >> 2


def bins_at(luma: I64) -> tuple[I64, I64]:
    place = np.clip(luma // 2 - 8, 0, 16 * (BINS - 1))
    low = np.minimum(place >> 4, BINS - 2)
    return low, place - 16 * low


def smoothed(values: I64, axis: int) -> I64:
    ends = [(1, 1) if n == axis else (0, 0) for n in range(values.ndim)]
    padded, n = np.pad(values, ends, mode="edge"), values.shape[axis]
    before, own, after = (padded.take(range(i, i + n), axis) for i in range(3))
    return before + 2 * own + after


def rounded_div(a: I64, b: I64) -> I64:
    return (a + b // 2) // b


def solved(sums: I64, prior: I64) -> I64:
    """Sums [9, ...], prior [6, ...] -> [6, ...]."""
    n, sx, sxx = sums[:3]
    mean = rounded_div(sx << 11, n + 160)
    spread = np.maximum(sxx - ((sx * mean) >> 11), 0) + 16000
    found = []
    for plane in range(3):
        offset, gain = prior[2 * plane], prior[2 * plane + 1]
        r = (sums[3 + 2 * plane] << 8) - offset * n - ((gain * sx) >> 7)
        xr = (sums[4 + 2 * plane] << 8) - offset * sx - ((gain * sxx) >> 7)
        step = rounded_div((xr - ((r * mean) >> 11)) << 7, spread)
        step = np.clip(gain + step, -MOST, MOST) - gain
        level = rounded_div(r - ((step * sx) >> 7), n + 160)
        found += [np.clip(offset + level, -MOST, MOST), gain + step]
    return np.stack(found)


def accumulated(seen: I420, render: I420) -> I64:
    luma = halved(render.y.astype(np.int64))
    d = [halved(seen.y.astype(np.int64)) - luma]
    d += [a.astype(np.int64) - b for a, b in ((seen.u, render.u), (seen.v, render.v))]
    x, (low, fraction) = luma - 128, bins_at(luma)
    rows, columns = np.indices(luma.shape) // 8
    sums = np.zeros((9, rows.max() + 1, columns.max() + 1, BINS), np.int64)
    terms = [np.ones_like(x), x, x * x, d[0], x * d[0], d[1], x * d[1], d[2], x * d[2]]
    for bins, weight in ((low, 16 - fraction), (low + 1, fraction)):
        for total, term in zip(sums, terms, strict=True):
            np.add.at(total, (rows, columns, bins), weight * term)
    return sums


def coarser(sums: I64, level: int) -> I64:
    for axis in (1, 2):
        sums = np.add.reduceat(sums, range(0, sums.shape[axis], level), axis)
    for axis in (1, 2, 3):
        sums = smoothed(sums, axis)
    return sums


def vertices_of(sums: I64, last: int = 1) -> I64:
    whole = sums.sum((1, 2))
    per_bin = solved(whole, solved(whole.sum(1), np.zeros(6, np.int64))[:, None])
    found = None
    for level in (16, 4, 1)[: 3 if last == 1 else 2]:
        total = coarser(sums, level)
        if found is None:
            prior = np.broadcast_to(per_bin[:, None, None], (6, *total.shape[1:]))
        else:
            prior = finer(found, total.shape[1:3])
        found = solved(total, prior)
    assert found is not None
    return found


def finer(vertices: I64, shape: tuple[int, ...]) -> I64:
    repeated = vertices.repeat(4, 1).repeat(4, 2)[:, : shape[0], : shape[1]]
    for axis in (1, 2):
        repeated = (smoothed(repeated, axis) + 2) >> 2
    return repeated


def tables_of(offset: I64, gain: I64) -> I64:
    """[rows, columns, 8] -> [rows, columns, 256] in 1/32 level."""
    luma = np.arange(256)
    low, fraction = bins_at(luma)
    here, there = (offset[..., b] * 128 + gain[..., b] * (luma - 128) for b in (low, low + 1))
    return ((16 - fraction) * here + fraction * there + (1 << 13)) >> 14


def places(n: int, vertices: int, cell: int) -> tuple[I64, I64, I64]:
    place = np.clip((2 * np.arange(n) + 1 - cell) * (16 // cell), 0, 32 * (vertices - 1))
    return place // 32, np.minimum(place // 32 + 1, vertices - 1), place % 32


def mapped(plane: I64, luma: I64, tables: I64, cell: int) -> NDArray[np.uint8]:
    top, bottom, fy = (a[:, None] for a in places(plane.shape[0], tables.shape[0], cell))
    left, right, fx = (a[None] for a in places(plane.shape[1], tables.shape[1], cell))
    above = (32 - fx) * tables[top, left, luma] + fx * tables[top, right, luma]
    below = (32 - fx) * tables[bottom, left, luma] + fx * tables[bottom, right, luma]
    total = (32 - fy) * above + fy * below
    return np.clip(plane + ((total + (1 << 14)) >> 15), 1, 255).astype(np.uint8)


def definition(seen: I420, seen_render: I420, render: I420) -> I420:
    return under(vertices_of(accumulated(seen, seen_render)), render)


def under(vertices: I64, render: I420) -> I420:
    tables = [tables_of(vertices[2 * p], vertices[2 * p + 1]) for p in range(3)]
    y, u, v = (plane.astype(np.int64) for plane in render.planes)
    means = halved(y)
    return I420(
        mapped(y, y, tables[0], 16), mapped(u, means, tables[1], 8), mapped(v, means, tables[2], 8)
    )


def light_definition(frame: I420, render: I420) -> I64:
    """[rows, columns, 8, 3] in levels / 2**8."""
    vertices = vertices_of(accumulated(frame, render), last=4)
    x = 32 * np.arange(BINS) + 16 - 128
    changes = [(vertices[2 * p] * 128 + vertices[2 * p + 1] * x + 64) >> 7 for p in range(3)]
    return np.stack(changes, axis=-1).clip(-MOST, MOST)


def lit_definition(render: I420, changes: I64) -> I420:
    width, height = render.size_px
    none = np.zeros(changes.shape[:3], np.int64)
    vertices = np.stack([each for p in range(3) for each in (changes[..., p], none)])
    return under(finer(vertices, (-(-height // 16), -(-width // 16))), render)


def picture(size_px: tuple[int, int], seed: int, low: int = 0, high: int = 256) -> I420:
    rng, (width, height) = np.random.default_rng(seed), size_px
    half = ((height + 1) // 2, (width + 1) // 2)
    shapes = ((height, width), half, half)
    return I420(*(rng.integers(low, high, shape, dtype=np.uint8) for shape in shapes))


def require_definition(seen: I420, seen_render: I420, render: I420) -> None:
    found, expected = relight_i420(seen, seen_render, render), definition(seen, seen_render, render)
    for ours, theirs in zip(found.planes, expected.planes, strict=True):
        np.testing.assert_array_equal(ours, theirs)


LEVELS = st.tuples(st.integers(0, 254), st.integers(1, 256)).map(
    lambda pair: (pair[0], max(pair[0] + 1, pair[1]))
)


@settings(max_examples=60, deadline=None)
@given(
    size_px=st.tuples(st.integers(1, 90), st.integers(1, 70)),
    seed=st.integers(0, 2**32 - 1),
    seen=LEVELS,
    shown=LEVELS,
)
def test_the_kernel_equals_the_definition(size_px, seed, seen, shown):
    pictures = (picture(size_px, seed + n, *levels) for n, levels in enumerate((seen, shown)))
    require_definition(*pictures, picture(size_px, seed + 2))


@pytest.mark.parametrize("size_px", [(1, 1), (15, 16), (17, 33), (300, 290)])
@pytest.mark.parametrize("levels", [((255, 256), (0, 1)), ((0, 1), (255, 256))])
def test_the_kernel_equals_the_definition_at_the_ends_of_the_range(size_px, levels):
    seen, shown = (picture(size_px, 1, *ends) for ends in levels)
    require_definition(seen, shown, picture(size_px, 2))


@settings(max_examples=60, deadline=None)
@given(
    size_px=st.tuples(st.integers(1, 150), st.integers(1, 140)),
    seed=st.integers(0, 2**32 - 1),
    seen=LEVELS,
    shown=LEVELS,
)
def test_a_light_that_is_sent_equals_its_definition(size_px, seed, seen, shown):
    frame, render = (picture(size_px, seed + n, *levels) for n, levels in enumerate((seen, shown)))
    changes = solve_light(frame, render)
    assert changes.shape == light_shape(size_px)
    np.testing.assert_array_equal(changes, light_definition(frame, render))
    any_changes = np.random.default_rng(seed).integers(-MOST, MOST + 1, changes.shape, np.int32)
    for light in (changes, any_changes):
        found, expected = apply_light(render, light), lit_definition(render, light.astype(np.int64))
        for ours, theirs in zip(found.planes, expected.planes, strict=True):
            np.testing.assert_array_equal(ours, theirs)


def test_changes_that_are_no_light_are_refused():
    render = picture((65, 64), 1)
    changes = np.zeros((1, 2, 8, 3), np.int32)
    apply_light(render, changes)
    changes[0, 1, 7, 2] = MOST + 1
    for wrong in (changes, changes[:, :1], np.zeros((2, 1, 8, 3), np.int32)):
        with pytest.raises(InvalidInput, match=r"light: must be of shape \(1, 2, 8, 3\)"):
            apply_light(render, wrong)
    with pytest.raises(InvalidInput, match=r"light\.frame"):
        solve_light(picture((64, 64), 1), render)


def test_the_right_light_changes_nothing():
    shown, now = picture((64, 48), 1, 1), picture((64, 48), 2, 1)
    found = relight_i420(shown, shown, now)
    for ours, theirs in zip(found.planes, now.planes, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_another_exposure_is_recovered_within_a_level():
    shown, now = picture((160, 128), 1, 20, 220), picture((160, 128), 2, 20, 220)
    dark_shown, dark_now = (
        I420((p.y * 0.6 + 8).astype(np.uint8), p.u + np.uint8(9), p.v - np.uint8(5))
        for p in (shown, now)
    )
    # The 2x2 means by which the grid is solved span less than the samples it is applied to.
    found = relight_i420(dark_shown, shown, now)
    for ours, theirs in zip(found.planes, dark_now.planes, strict=True):
        assert np.abs(ours.astype(int) - theirs).mean() < 1.0


def test_pictures_of_another_size_are_refused():
    small, large = picture((16, 16), 1), picture((18, 16), 1)
    with pytest.raises(InvalidInput, match=r"relight\.seen:.*\(18, 16\)"):
        relight_i420(large, small, small)
    with pytest.raises(InvalidInput, match=r"relight\.seen_render:.*\(18, 16\)"):
        relight_i420(small, large, small)
