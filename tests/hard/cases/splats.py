"""Hard Gaussians and cameras: the picture against float64, a closed form or an invariance.

Two kinds of case share a scene of blobs. A poison float64 can draw must be drawn as float64 draws
it; one that shows nothing must leave the picture of the others, to the last bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from hard.cases.case import Case, Finding, refusal, statement, within
from hard.cases.scenes import (
    AHEAD,
    INTRINSICS,
    PICTURE_LIMIT,
    TURNED,
    Values,
    arrays_of,
    blobs,
    joined,
    one_splat,
    picture_error,
    poisoned,
    same_view,
    without,
)
from rfcore.camera import Camera, Intrinsics, Pose, TileOrigin
from rfcore.errors import InvalidInput
from rfcore.raster.gaussians import Gaussians
from rfcore.raster.native import Rasterizer

GROUP = "Gaussians"
SH0 = 0.28209479177387814
BALL_COLOUR = 0.5 + SH0
DILATION_PX2 = 0.3
LONG_M, THIN_M = math.log(1e4), math.log(1e-8)
NEAR_M = float(np.float32(0.01))

DRAWN: dict[str, tuple[Values, Camera]] = {
    "needle of 7 m by 15 nm": ({"log_scales": (2.0, -18.0, -18.0)}, AHEAD),
    "needle, turned camera": ({"log_scales": (2.0, -18.0, -18.0)}, TURNED),
    "needle of 10 km": ({"log_scales": (LONG_M, THIN_M, THIN_M)}, AHEAD),
    "disc of 10 km": ({"log_scales": (LONG_M, LONG_M, THIN_M)}, AHEAD),
    "disc of 3 m by 15 nm, turned camera": ({"log_scales": (1.0, 1.0, -18.0)}, TURNED),
    "ball of 10 km around the camera": ({"log_scales": LONG_M}, TURNED),
    "ball of 10 nm": ({"log_scales": THIN_M}, TURNED),
    "zero scale (e^-40 m)": ({"log_scales": -40.0}, AHEAD),
    "quaternion of norm 1e-5": ({"quaternions": (6e-6, 0.0, 8e-6, 0.0)}, AHEAD),
    "quaternion of norm 4e15": ({"quaternions": (1e15, -2e15, 3e15, 0.0)}, AHEAD),
    "quaternion whose square overflows": ({"quaternions": (3e38, 1e38, -2e38, 3e38)}, TURNED),
    "quaternion of norm 1e-30": ({"quaternions": (1e-31, 0.0, 1e-30, 0.0)}, AHEAD),
    "subnormal quaternion": ({"quaternions": 1e-41}, AHEAD),
    "opacity logit 30": ({"opacity_logits": 30.0}, TURNED),
    "opacity logit 3e38": ({"opacity_logits": 3e38}, AHEAD),
    "just beyond the near plane": ({"means": (0.001, -0.002, 0.010001)}, AHEAD),
    "straddling the near plane": ({"means": (0.05, 0.02, 0.02), "log_scales": -1.0}, AHEAD),
    "far off axis, reaching in": ({"means": (50.0, 0.0, 1.0), "log_scales": 3.5}, AHEAD),
    "1000 km away, 300 km wide": ({"means": (1e4, 1e4, 1e6), "log_scales": 12.6}, TURNED),
    "a quarter of all at one point": ({"means": (0.1, 0.1, 3.0)}, TURNED),
}
"""Poisons that show, and must show as in float64."""

UNSEEN: dict[str, tuple[Values, Camera]] = {
    "opacity logit -30": ({"opacity_logits": -30.0}, AHEAD),
    "exactly on the near plane": ({"means": (0.0, 0.0, NEAR_M)}, AHEAD),
    "just behind the near plane": ({"means": (0.001, 0.0, 0.009999)}, AHEAD),
    "at the camera centre": ({"means": (0.0, 0.0, 0.0)}, AHEAD),
    "behind the camera": ({"means": (0.0, 0.0, -3.0), "log_scales": 1.0}, AHEAD),
    "1000 km off axis, 2 cm ahead": ({"means": (1e6, -1e6, 0.02)}, AHEAD),
    "at the largest float sideways": ({"means": (3e38, 3e38, 1.0)}, TURNED),
    "beyond 1e9 m": ({"means": (1.0, 1.0, 3e38)}, AHEAD),
    "wider than 1e9 px (scale e^40 m)": ({"log_scales": 40.0}, AHEAD),
    "scale beyond float32 (e^3e38 m)": ({"log_scales": 3e38}, AHEAD),
}
"""Poisons that show nothing: what float32 cannot express is not drawn."""


def _drawn(values: Values, camera: Camera) -> Finding:
    error = picture_error(poisoned(blobs(), values), camera)
    return within(error, PICTURE_LIMIT, "drawn as in float64")


def _unseen(values: Values, camera: Camera) -> Finding:
    with_them = Rasterizer(poisoned(blobs(), values)).render(camera)
    alone = Rasterizer(without(blobs())).render(camera)
    return statement(same_view(with_them, alone), "equal bytes", "the picture changed")


def _antialiased_needle() -> Finding:
    values = {"log_scales": (1.0, -5.0, -5.0)}
    error = picture_error(poisoned(blobs(), values), TURNED, antialiased=True)
    return within(error, PICTURE_LIMIT, "compensated as in float64")


def _dust_is_the_pixel_filter() -> Finding:
    """A point spreads as the low-pass filter alone: alpha = o exp(-r^2 / (2 * 0.3))."""
    opacity = Rasterizer(one_splat(log_scales=[THIN_M] * 3)).render(AHEAD).opacity
    offsets = [(0, 0), (1, 0), (0, -1), (1, 1)]
    errors = []
    for dx, dy in offsets:
        r2 = (dx + 0.5) ** 2 + (dy + 0.5) ** 2
        alpha = 0.5 * math.exp(-0.5 * r2 / DILATION_PX2)
        errors.append(abs(float(opacity[12 + dy, 20 + dx]) - (alpha if alpha >= 1 / 255 else 0.0)))
    return within(max(errors), PICTURE_LIMIT, f"alpha {opacity[12, 20]:.6f} next to the centre")


def _same_bytes(a: Gaussians, b: Gaussians) -> Finding:
    views = [Rasterizer(gaussians).render(TURNED) for gaussians in (a, b)]
    return statement(same_view(*views), "equal bytes", "bytes differ")


def _quaternions_times(factor: float) -> Finding:
    return _same_bytes(
        blobs(), replace(blobs(), quaternions=blobs().quaternions * np.float32(factor))
    )


def _zero_quaternion() -> Finding:
    return _same_bytes(
        poisoned(blobs(), {"quaternions": 0.0}), poisoned(blobs(), {"quaternions": (1, 0, 0, 0)})
    )


def _coincident() -> Finding:
    """n layers of alpha leave (1 - alpha)^n of the light until it falls to 1e-4."""
    n, logit, colour = 5000, -4.0, BALL_COLOUR
    ball = one_splat(opacity_logits=logit, log_scales=[0.0] * 3)
    many = Gaussians(*(np.repeat(array, n, axis=0) for array in arrays_of(ball)))
    view = Rasterizer(many).render(AHEAD)
    r2 = 2 * 0.5**2
    alpha = math.exp(-0.5 * r2 / ((30.0 / 4.0) ** 2 + DILATION_PX2)) / (1 + math.exp(-logit))
    drawn = math.floor(math.log(1e-4) / math.log1p(-alpha))
    want = 1.0 - (1.0 - alpha) ** drawn
    error = max(
        abs(float(view.opacity[12, 20]) - want),
        float(np.abs(view.colour[12, 20] - want * colour).max()),
        abs(float(view.depth[12, 20]) - 4.0) / 4.0,
    )
    return within(error, 2e-5, f"opacity {view.opacity[12, 20]:.6f} after {drawn} of {n}")


def _opaque_wall() -> Finding:
    """0.99 a layer: after two layers 1e-4 is left, and the second would leave exactly that."""
    wall = one_splat(opacity_logits=30.0, log_scales=[4.0] * 3)
    many = Gaussians(*(np.repeat(array, 3000, axis=0) for array in arrays_of(wall)))
    view = Rasterizer(many).render(AHEAD)
    spread = float(np.abs(view.opacity - 0.99).max())
    return within(
        spread, PICTURE_LIMIT, f"opacity {view.opacity.min():.6f}..{view.opacity.max():.6f}"
    )


def _blinding() -> Finding:
    view = Rasterizer(poisoned(blobs(), {"sh": 3e38})).render(AHEAD)
    clear = Rasterizer(blobs()).render(AHEAD)
    finite = bool(np.isfinite(view.colour).all() and view.colour.max() <= 1e18)
    same = view.opacity.tobytes() == clear.opacity.tobytes()
    return statement(finite and same, f"largest colour {view.colour.max():.3g}", "overflowed")


def _faint_depth() -> Finding:
    """Depth is a ratio of two sums: one splat at 1/255 has it to rounding all the same."""
    view = Rasterizer(one_splat(opacity_logits=-4.69, means=[0.0, 0.0, 777.0])).render(AHEAD)
    hit = view.opacity > 0
    error = float(np.abs(view.depth[hit] / 777.0 - 1.0).max())
    return within(error, 3e-7, f"{int(hit.sum())} px of opacity {view.opacity.max():.4f}")


def _ties() -> Finding:
    """At equal depth the first in the file lies in front: alpha over alpha, in that order."""
    red, blue = one_splat(sh=[[1.5, -1.5, -1.5]]), one_splat(sh=[[-1.5, -1.5, 1.5]])
    first = Rasterizer(joined(red, blue)).render(AHEAD).colour
    second = Rasterizer(joined(blue, red)).render(AHEAD).colour
    mirrored = first[..., ::-1].tobytes() == second.tobytes()
    return statement(mirrored and first[12, 20, 0] > first[12, 20, 2], "file order", "other order")


def _permuted() -> Finding:
    order = np.random.default_rng(7).permutation(len(blobs()))
    shuffled = Gaussians(*(np.ascontiguousarray(array[order]) for array in arrays_of(blobs())))
    return _same_bytes(blobs(), shuffled)


def _far_from_the_origin(metres: float) -> Finding:
    """Means lie on a grid float32 has at that distance, so moving them is exact."""
    home = blobs()
    home.means[:] = np.round(home.means * 16) / 16
    away = replace(home, means=home.means + np.float32(metres))
    x, y, z = (metres + value for value in TURNED.world_from_cam.translation_m)
    there = Camera(TURNED.intrinsics, Pose((x, y, z), TURNED.world_from_cam.rotation))
    got, want = Rasterizer(away).render(there).colour, Rasterizer(home).render(TURNED).colour
    return within(float(np.abs(got - want).max()), PICTURE_LIMIT, "drawn as at the origin")


def _tile_origin() -> Finding:
    """UTM magnitudes: the camera less the tile's origin is the camera at home, bit for bit."""
    origin = TileOrigin(691_608.0, 5_334_760.0, 520.0)
    home = Camera(INTRINSICS, Pose((0.125, -0.25, 0.5), (0.96, 0.0, 0.28, 0.0)))
    far = Pose((691_608.125, 5_334_759.75, 520.5), home.world_from_cam.rotation)
    views = [
        Rasterizer(blobs()).render(camera)
        for camera in (home, Camera(INTRINSICS, origin.localise(far)))
    ]
    return statement(same_view(*views), "equal bytes", "bytes differ")


def _camera_beyond_float32() -> Finding:
    distant = Camera(INTRINSICS, Pose((1e39, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)))
    return refusal(lambda: Rasterizer(blobs()).render(distant), InvalidInput, "tile origin")


def _not_finite(name: str, value: float) -> Finding:
    def build() -> Gaussians:
        return poisoned(blobs(), {name: value})

    return refusal(build, InvalidInput, f"gaussians.{name}", "6 of 24", "number 0")


def _one_pixel() -> Finding:
    camera = Camera(Intrinsics(1, 1, 30.0, 30.0, 0.5, 0.5), Pose.identity())
    colour = Rasterizer(one_splat()).render(camera).colour[0, 0]
    return within(
        float(np.abs(colour - 0.5 * BALL_COLOUR).max()), PICTURE_LIMIT, f"{colour[0]:.6f}"
    )


def _thin_picture() -> Finding:
    camera = Camera(Intrinsics(8192, 1, 4000.0, 4000.0, 4096.0, 0.5), Pose.identity())
    return within(picture_error(blobs(), camera), PICTURE_LIMIT, "drawn as in float64")


def _empty() -> Finding:
    nothing = Gaussians(*(array[:0] for array in arrays_of(one_splat())))
    view = Rasterizer(nothing).render(AHEAD)
    dark = not (view.colour.any() or view.depth.any() or view.opacity.any())
    return statement(dark, "black, clear, depth 0", "something was drawn")


def _case(name: str, expected: str, measure: Callable[[], Finding]) -> Case:
    return Case(GROUP, name, expected, measure)


CASES = (
    *(
        _case(name, "the float64 definition", partial(_drawn, values, camera))
        for name, (values, camera) in DRAWN.items()
    ),
    *(
        _case(name, "the bytes without it", partial(_unseen, values, camera))
        for name, (values, camera) in UNSEEN.items()
    ),
    _case("thin needle, antialiased", "the float64 definition", _antialiased_needle),
    _case("dust on the axis", "o exp(-r^2 / 0.6)", _dust_is_the_pixel_filter),
    _case("quaternions times -1", "the same bytes", partial(_quaternions_times, -1.0)),
    _case("quaternions times 1024", "the same bytes", partial(_quaternions_times, 1024.0)),
    _case("zero quaternion", "the bytes of no rotation", _zero_quaternion),
    _case("5000 coincident", "1 - (1 - alpha)^n up to 1 - 1e-4", _coincident),
    _case("3000 opaque walls", "0.99: a second layer would leave 1e-4", _opaque_wall),
    _case("harmonics of 3e38", "colours at most 1e18, opacity unchanged", _blinding),
    _case("depth of the faintest splat", "its distance", _faint_depth),
    _case("equal depths", "the order of the file", _ties),
    _case("another order of the file", "the same bytes", _permuted),
    _case("scene at 1 km", "the picture at the origin", partial(_far_from_the_origin, 1e3)),
    _case("scene at 1000 km", "the picture at the origin", partial(_far_from_the_origin, 1e6)),
    _case("UTM pose less the tile's origin", "the bytes at the origin", _tile_origin),
    _case("camera beyond float32", "refused, with what to do", _camera_beyond_float32),
    _case(
        "NaN mean",
        "refused, naming how many and the first",
        partial(_not_finite, "means", math.nan),
    ),
    _case(
        "infinite scale",
        "refused, naming how many and the first",
        partial(_not_finite, "log_scales", math.inf),
    ),
    _case("picture of one pixel", "opacity times colour", _one_pixel),
    _case("picture of 8192 x 1", "the float64 definition", _thin_picture),
    _case("no Gaussians", "black, transparent, depth 0", _empty),
)
