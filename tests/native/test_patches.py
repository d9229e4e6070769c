"""A patch is drawn, to the bit, as its module defines."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfcore.native.live_view import LEAST_MASK, NEAREST_M, NOBODY, Canvas, Patch, draw_patch

F = np.float32


def camera(width: int, height: int, x_m: float = 0.0, yaw_rad: float = 0.0) -> Camera:
    k = Intrinsics(width, height, 0.8 * width, 0.8 * width, width / 2, height / 2)
    turn = (math.cos(yaw_rad / 2), 0.0, math.sin(yaw_rad / 2), 0.0)
    return Camera(k, Pose((x_m, 0.1, -0.3), turn))


def canvas(rng: np.random.Generator, at: Camera) -> Canvas:
    shape = (at.intrinsics.height_px, at.intrinsics.width_px)
    depth = rng.uniform(2, 12, shape).astype(F)
    rgb = rng.integers(0, 256, (*shape, 3), dtype=np.uint8)
    return Canvas(at, rgb, depth, np.full(shape, NOBODY, np.uint8), depth * F(1.08) + F(0.1))


def patch(rng: np.random.Generator, at: Camera, size: tuple[int, int]) -> Patch:
    mask = (rng.random((*size, 1)) < 0.8).astype(F)
    samples = np.concatenate((rng.uniform(0, 255, (*size, 3)).astype(F) * mask, mask), axis=2)
    left, top = (int(n) for n in rng.integers(0, 20, 2))
    return Patch(at, samples, left, top, float(rng.uniform(2, 9)))


def motion(patch: Patch, canvas: Canvas) -> Pose:
    return patch.camera.cam_from_world().compose(canvas.camera.world_from_cam)


def defined(canvas: Canvas, patch: Patch, box: tuple[slice, slice], fade: float) -> Canvas:
    """Return what the canvas becomes when picture 3 is drawn."""
    k, own = canvas.camera.intrinsics, patch.camera.intrinsics
    moved = motion(patch, canvas)
    r, t = F(moved.rotation_matrix()), F(moved.translation_m)
    made = Canvas(
        canvas.camera, *(a.copy() for a in (canvas.rgb, canvas.depth, canvas.chosen)),
        canvas.nearest_m.copy(),
    )  # fmt: skip
    height, width = patch.samples.shape[:2]
    z_m = F(patch.z_m)
    for y in range(*box[0].indices(k.height_px)):
        for x in range(*box[1].indices(k.width_px)):
            ray_x = (F(x) + F(0.5) - F(k.cx_px)) / F(k.fx_px)
            ray_y = (F(y) + F(0.5) - F(k.cy_px)) / F(k.fy_px)
            to = [r[i, 0] * ray_x + (r[i, 1] * ray_y + r[i, 2]) for i in range(3)]
            if not to[2] > F(1e-6):
                continue
            z = (z_m - t[2]) / to[2]
            if not F(NEAREST_M) < z < made.nearest_m[y, x]:
                continue
            at_x, at_y = z * to[0] + t[0], z * to[1] + t[1]
            u = at_x / z_m * F(own.fx_px) + (F(own.cx_px) - F(0.5)) - F(patch.left)
            v = at_y / z_m * F(own.fy_px) + (F(own.cy_px) - F(0.5)) - F(patch.top)
            if not (-1 < u < width and -1 < v < height):
                continue
            left, top = np.floor(u), np.floor(v)
            across, down = u - left, v - top
            found = np.zeros(4, F)
            for row, part in ((int(top), F(1) - down), (int(top) + 1, down)):
                for column, share in ((int(left), F(1) - across), (int(left) + 1, across)):
                    if 0 <= column < width and 0 <= row < height:
                        found += part * share * patch.samples[row, column]
            if not found[3] > F(LEAST_MASK):
                continue
            behind = made.rgb[y, x].astype(F)
            shown = behind + F(fade) * (found[:3] / found[3] - behind)
            made.rgb[y, x] = np.rint(shown.clip(0, 255))
            made.depth[y, x] = made.nearest_m[y, x] = z
            made.chosen[y, x] = 3
    return made


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    x_m=st.floats(-2, 2),
    yaw_rad=st.floats(-0.6, 0.6),
    fade=st.sampled_from([0.25, 0.7, 1.0]),
)
def test_a_patch_is_drawn_as_is_defined(seed, x_m, yaw_rad, fade):
    rng = np.random.default_rng(seed)
    on = canvas(rng, camera(33, 21, x_m, yaw_rad))
    what = patch(rng, camera(40, 30), (int(rng.integers(1, 14)), int(rng.integers(1, 14))))
    rows, columns = sorted(rng.integers(0, 22, 2)), sorted(rng.integers(0, 34, 2))
    box = (slice(int(rows[0]), int(rows[1])), slice(int(columns[0]), int(columns[1])))
    expected = defined(on, what, box, fade)
    draw_patch(on, what, motion(what, on), box, 3, fade)
    for ours, theirs in zip(
        (on.rgb, on.depth, on.chosen, on.nearest_m),
        (expected.rgb, expected.depth, expected.chosen, expected.nearest_m),
        strict=True,
    ):
        assert ours.tobytes() == theirs.tobytes()


def test_a_patch_at_its_own_pose_is_shown_as_it_was_cut_out():
    rng = np.random.default_rng(0)
    at = camera(40, 30)
    on, what = canvas(rng, at), patch(rng, at, (6, 8))
    on.nearest_m[:] = np.inf
    whole = (slice(0, 30), slice(0, 40))
    draw_patch(on, what, motion(what, on), whole, 0, 1.0)
    box = (slice(what.top, what.top + 6), slice(what.left, what.left + 8))
    mask = what.samples[..., 3] > 0
    assert np.array_equal(on.chosen[box] == 0, mask)
    assert np.abs(on.rgb[box].astype(float) - what.samples[..., :3])[mask].max() < 1
    assert np.abs(on.depth[box][mask] - what.z_m).max() < 1e-4


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"box": (slice(0, 31), slice(0, 4))}, "patch.box"),
        ({"source": NOBODY}, "patch.source"),
        ({"z_m": 0.0}, "patch.z_m"),
    ],
)
def test_what_cannot_be_drawn_is_refused(change, said):
    rng = np.random.default_rng(0)
    at = camera(40, 30)
    what = patch(rng, at, (6, 8))
    if "z_m" in change:
        what = Patch(at, what.samples, what.left, what.top, 0.0)
    box = change.get("box", (slice(0, 4), slice(0, 4)))
    with pytest.raises(InvalidInput, match=said):
        draw_patch(canvas(rng, at), what, Pose.identity(), box, change.get("source", 0), 1.0)
