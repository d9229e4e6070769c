"""Hard warps: no depth, all far away, behind the camera, UTM magnitudes, tiny pictures."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from hard.cases.case import Case, Finding, refusal, statement
from rfcore.camera import Camera, Intrinsics, Pose, Vec3
from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.native.warp import correct_i420, warp_i420
from rfcore.views import FieldView

GROUP = "Warp"
SIZE_PX = (40, 24)
HALF_TURN = (0.0, 0.0, 1.0, 0.0)


def _picture(seed: int, size_px: tuple[int, int] = SIZE_PX) -> I420:
    """Noise without zeros, which no reference may have."""
    width_px, height_px = size_px
    half = ((height_px + 1) // 2, (width_px + 1) // 2)
    rng = np.random.default_rng(seed)
    shapes = ((height_px, width_px), half, half)
    return I420(*(rng.integers(1, 256, shape, dtype=np.uint8) for shape in shapes))


def _seen(
    depth_m: float,
    at_m: Vec3 = (0.0, 0.0, 0.0),
    rotation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
    size_px: tuple[int, int] = SIZE_PX,
    seed: int = 2,
) -> FieldView:
    width_px, height_px = size_px
    k = Intrinsics(width_px, height_px, 32.0, 32.0, 0.5 * width_px, 0.5 * height_px)
    depth = np.full((height_px, width_px), depth_m, np.float32)
    return FieldView(Camera(k, Pose(at_m, rotation)), _picture(seed, size_px), depth)


def _same(a: I420, b: I420) -> bool:
    return a.digest() == b.digest()


def _from_the_same_place(depth_m: float, size_px: tuple[int, int]) -> Finding:
    seen = _seen(depth_m, size_px=size_px)
    warped = warp_i420(_picture(1, size_px), seen, seen)
    return statement(_same(warped, _picture(1, size_px)), "equal bytes", "bytes differ")


def _is_the_render(before: FieldView, now: FieldView) -> Finding:
    warped = warp_i420(_picture(1), before, now)
    return statement(_same(warped, _picture(2)), "equal bytes", "bytes differ")


def _moved_by_whole_pixels() -> Finding:
    """At 4 m with f = 32 px, 0.25 m to the right is 2 px: the picture moves to the left by 2."""
    before, now = _seen(4.0), _seen(4.0, (0.25, 0.0, 0.0))
    warped = warp_i420(_picture(1), before, now)
    moved = np.array_equal(warped.y[:, :-2], _picture(1).y[:, 2:])
    filled = np.array_equal(warped.y[:, -2:], _picture(2).y[:, -2:])
    return statement(moved and filled, "moved by 2 px, edge from the render", "not moved by 2 px")


def _on_the_globe() -> Finding:
    """Binary fractions at UTM magnitude subtract exactly: the bytes are those at the origin."""
    pictures = []
    for x, y in ((0.0, 0.0), (691_608.0, 5_334_760.0)):
        before, now = _seen(4.0, (x, y, 1.0)), _seen(4.0, (x + 0.125, y - 0.0625, 1.25))
        pictures.append(warp_i420(_picture(1), before, now))
    return statement(_same(*pictures), "equal bytes", "bytes differ")


def _nothing_to_correct() -> Finding:
    """A previous picture equal to its own render differs by nothing: the present render stays."""
    before = _seen(4.0, seed=1)
    corrected = correct_i420(_picture(1), before, _seen(4.1, (0.1, 0.0, 0.05)))
    return statement(_same(corrected, _picture(2)), "equal bytes", "bytes differ")


def _not_finite() -> Finding:
    return refusal(lambda: _seen(float("nan")), InvalidInput, "depth", "960 of 960")


def _case(name: str, expected: str, measure: Callable[[], Finding]) -> Case:
    return Case(GROUP, name, expected, measure)


FAR_BEHIND = _seen(4.0, (0.0, 0.0, 50.0))
LOOKED_AWAY = _seen(4.0, rotation=HALF_TURN)

SAME_PLACE = {
    "from the same place": (4.0, SIZE_PX),
    "from the same place, 1e9 m deep": (1e9, SIZE_PX),
    "from the same place, 2 x 2 px": (4.0, (2, 2)),
    "from the same place, 33 x 17 px": (4.0, (33, 17)),
    "from the same place, 1 px": (4.0, (1, 1)),
}
UNKNOWN = {
    "no depth": (_seen(4.0), _seen(0.0)),
    "no previous depth": (_seen(0.0), _seen(4.0)),
    "depth of 3e38 m": (_seen(4.0), _seen(3e38)),
    "depth of 1e-45 m": (_seen(4.0), _seen(1e-45)),
    "the previous camera looked away": (LOOKED_AWAY, _seen(4.0)),
    "the previous camera is beyond": (FAR_BEHIND, _seen(4.0)),
}

CASES = (
    *(
        _case(name, "the previous picture", partial(_from_the_same_place, *values))
        for name, values in SAME_PLACE.items()
    ),
    _case("moved by whole pixels", "the picture moved", _moved_by_whole_pixels),
    *(
        _case(name, "the render", partial(_is_the_render, *views))
        for name, views in UNKNOWN.items()
    ),
    _case("poses at UTM magnitude", "the bytes at the origin", _on_the_globe),
    _case("nothing to correct", "the render", _nothing_to_correct),
    _case("NaN depth", "refused, saying how many", _not_finite),
)
