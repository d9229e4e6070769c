"""Warp, correction, relit render and block costs on another architecture: the same bytes."""

import struct

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.image import I420
from rfcore.native.warp import (
    CORRECTION_DOUBT,
    block_costs,
    correct_i420,
    relight_i420,
    warp_i420,
    warp_numbers,
)
from rfcore.views import FieldView

pytestmark = [pytest.mark.nightly, pytest.mark.slow, pytest.mark.timeout(900)]


INTRINSICS = Intrinsics(83, 45, 60.0, 61.0, 41.0, 23.0)
BEFORE = Camera(INTRINSICS, Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)))
NOW = Camera(INTRINSICS, Pose((0.1, -0.05, 0.4), (0.9998, 0.0, 0.02, 0.0)))


def picture(seed: int) -> I420:
    rng = np.random.default_rng(seed)
    shapes = ((45, 83), (23, 42), (23, 42))
    return I420(*(rng.integers(0, 256, shape, dtype=np.uint8) for shape in shapes))


def depth(seed: int) -> np.ndarray:
    """Mostly a wavy wall; some pixels at nothing, at the camera, and far away."""
    rng = np.random.default_rng(seed)
    metres = (4.0 + rng.random((45, 83))).astype(np.float32)
    metres.ravel()[::17], metres.ravel()[::29], metres.ravel()[::31] = 0.0, 1e-6, 3e38
    return metres


def as_bytes(*pictures: I420) -> bytes:
    return b"".join(plane.tobytes() for made in pictures for plane in made.planes)


def test_aarch64_carries_a_picture_to_the_same_bytes(emulated, first_difference):
    previous, render, previous_render = (picture(seed) for seed in (1, 2, 3))
    before = FieldView(BEFORE, previous_render, depth(4))
    now = FieldView(NOW, render, depth(5))
    here = as_bytes(
        warp_i420(previous, before, now),
        correct_i420(previous, before, now),
        relight_i420(previous, previous_render, render),
    )
    costs = block_costs(previous.y, render.y)
    here += costs.satd.tobytes() + costs.ssd.tobytes()
    numbers = struct.pack("<16f", *warp_numbers(BEFORE, NOW))
    scene = struct.pack("<3i", 83, 45, CORRECTION_DOUBT) + numbers
    scene += as_bytes(previous, render, previous_render)
    scene += before.depth.tobytes() + now.depth.tobytes()
    assert first_difference(emulated("exactness_warp", "neon", 1, scene), here) is None
