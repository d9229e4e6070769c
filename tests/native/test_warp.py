"""The warp against its definition in numpy, bit by bit; its geometry against plane homographies."""

import hashlib
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.native.warp import (
    block_costs,
    correct_i420,
    warp_i420,
    warp_numbers,
)
from rfcore.views import FieldView

F32 = NDArray[np.float32]
SIZES = [(1, 1), (2, 2), (3, 5), (17, 9), (64, 48), (101, 67)]


def filter_table() -> NDArray[np.int64]:
    """Lanczos-3 at n / 64 in 1/64, the largest tap taking what rounding left over."""
    distance = np.arange(64)[:, None] / 64 - np.arange(-2, 4)[None]
    taps = np.sinc(distance) * np.sinc(distance / 3)
    taps /= taps.sum(axis=1, keepdims=True)
    table = np.rint(taps * 64).astype(np.int64)
    table[np.arange(64), taps.argmax(axis=1)] += 64 - table.sum(axis=1)
    return table


def locate(now: FieldView, before: FieldView) -> tuple[F32, F32, NDArray[np.bool_]]:
    """Positions in 1/64 sample and what is known, each step in float32 as the docstring has it."""
    one = np.float32
    numbers = [one(n) for n in warp_numbers(before.camera, now.camera)]
    r, t, (fx, fy, cx, cy) = numbers[:9], numbers[9:12], numbers[12:]
    height, width = now.depth.shape
    ray_x = ((np.arange(width, dtype=one) + one(0.5) - cx) / fx)[None]
    ray_y = ((np.arange(height, dtype=one) + one(0.5) - cy) / fy)[:, None]
    z = now.depth
    px, py, pz = (
        z * (r[3 * i] * ray_x + (r[3 * i + 1] * ray_y + r[3 * i + 2])) + t[i] for i in range(3)
    )
    with np.errstate(all="ignore"):
        u = fx * (px / pz) + cx - one(0.5)
        v = fy * (py / pz) + cy - one(0.5)
        known = (z > 0) & (pz > one(0.1))
        known &= (u >= 0) & (u <= one(width - 1)) & (v >= 0) & (v <= one(height - 1))
        u64, v64 = ((np.where(known, p, 0) * one(64) + one(0.5)).astype(np.int64) for p in (u, v))
        seen_there = before.depth[(v64 + 32) // 64, (u64 + 32) // 64]
        known &= np.abs(seen_there - pz) < one(0.08) * pz + one(0.1)
    return u64, v64, known


def carried(
    plane: NDArray[np.integer[Any]], u: NDArray[np.int64], v: NDArray[np.int64]
) -> NDArray[np.int64]:
    """The plane at (u, v), in 1/4096 level."""
    table = filter_table()
    padded = np.pad(plane.astype(np.int64), 3, mode="edge")
    total = np.zeros(u.shape, np.int64)
    for j in range(6):
        for i in range(6):
            sample = padded[(v >> 6) + j + 1, (u >> 6) + i + 1]
            total += table[v & 63, j] * table[u & 63, i] * sample
    return total


def definition(
    previous: I420, before: FieldView, now: FieldView, minus: I420 | None = None
) -> I420:
    u, v, known = locate(now, before)
    height, width = known.shape
    pad = ((0, height % 2), (0, width % 2))
    quads = [
        np.pad(a, pad, mode="edge").reshape(-(-height // 2), 2, -(-width // 2), 2)
        for a in (u, v, known)
    ]
    half_u, half_v = np.full(-(-width // 2), 128), np.full((-(-height // 2), 1), 128)
    half_u[width // 2 :], half_v[height // 2 :] = 0, 0
    u_c, v_c = (
        (q.sum(axis=(1, 3)) - half + 4) >> 3
        for q, half in zip(quads[:2], (half_u, half_v), strict=True)
    )
    known_c = quads[2].all(axis=(1, 3))
    places = [(u, v, known), *[(np.where(known_c, u_c, 0), np.where(known_c, v_c, 0), known_c)] * 2]
    planes = []
    for n, (u_n, v_n, known_n) in enumerate(places):
        base = now.render.planes[n].astype(np.int64)
        if minus is None:
            value = (carried(previous.planes[n], u_n, v_n) + (1 << 11)) >> 12
        else:
            error = previous.planes[n].astype(np.int64) - minus.planes[n]
            found = carried(error, u_n, v_n)
            value = base + ((found - np.clip(found >> 2, -4 << 12, 4 << 12) + (1 << 11)) >> 12)
        planes.append(np.clip(np.where(known_n, value, base), 1, 255).astype(np.uint8))
    return I420(*planes)


def noise(size_px: tuple[int, int], seed: int) -> I420:
    rng = np.random.default_rng(seed)
    width, height = size_px
    half = ((height + 1) // 2, (width + 1) // 2)
    return I420(*(rng.integers(0, 256, s, dtype=np.uint8) for s in ((height, width), half, half)))


def posed(
    size_px: tuple[int, int], depth: F32, pose: Pose, render: I420 | None = None
) -> FieldView:
    width, height = size_px
    k = Intrinsics(width, height, 0.8 * width, 0.9 * width, width / 2, height / 2)
    return FieldView(Camera(k, pose), render or noise(size_px, 2), depth)


def scene(size_px: tuple[int, int], seed: int) -> tuple[I420, FieldView, FieldView]:
    """A rough surface, holes of zero depth, a turn and a step."""
    rng = np.random.default_rng(seed)
    width, height = size_px
    depths = []
    for _ in range(2):
        depth = rng.uniform(4, 6, (height, width)).astype(np.float32)
        depth[rng.random((height, width)) < 0.05] = 0
        depths.append(depth)
    axis = rng.normal(size=3) * 0.03
    turn = np.array([1.0, *axis])
    turn /= np.linalg.norm(turn)
    w, x, y, z = turn.tolist()
    step = Pose((0.2, -0.1, 0.5), (w, x, y, z))
    before = posed(size_px, depths[0], Pose.identity())
    return noise(size_px, seed), before, posed(size_px, depths[1], step, noise(size_px, seed + 1))


def equal(a: I420, b: I420) -> bool:
    return all(np.array_equal(p, q) for p, q in zip(a.planes, b.planes, strict=True))


@pytest.mark.parametrize("size_px", SIZES)
@pytest.mark.parametrize("seed", [1, 2])
def test_the_kernel_is_its_definition_bit_by_bit(size_px, seed):
    given = scene(size_px, seed)
    assert equal(warp_i420(*given), definition(*given))


@pytest.mark.parametrize("size_px", SIZES)
def test_the_correction_is_its_definition_bit_by_bit(size_px):
    previous, before, now = scene(size_px, 5)
    was = noise(size_px, 9)
    corrected = correct_i420(previous, replace(before, render=was), now)
    assert equal(corrected, definition(previous, before, now, minus=was))


def fingerprint(picture):
    message = f"{picture.size_px}".encode() + picture.packed()
    return hashlib.blake2b(message, digest_size=16).hexdigest()


def test_golden_digests_pin_the_bytes():
    previous, before, now = scene((64, 48), 7)
    corrected = correct_i420(previous, replace(before, render=now.render), now)
    assert fingerprint(corrected) == "c805d5b0e1a577d46842018c3f0ec45d"
    assert fingerprint(warp_i420(*scene((64, 48), 7))) == "2ee3f6ae0a6fb2fd569311b8eea77a8b"


def test_what_another_surface_hid_comes_from_the_render():
    size = (40, 30)
    far, near = np.full((30, 40), 9, np.float32), np.full((30, 40), 5, np.float32)
    render = noise(size, 2)
    for before, now in ((near, far), (far, near), (np.zeros_like(far), far)):
        pose = Pose.identity()
        warped = warp_i420(
            noise(size, 1), posed(size, before, pose), posed(size, now, pose, render)
        )
        assert np.array_equal(warped.y, np.maximum(render.y, 1))


def test_extreme_depths_are_computed_as_defined():
    previous, before, now = scene((64, 48), 3)
    rng = np.random.default_rng(4)
    depth = (10.0 ** rng.uniform(-30, 30, (48, 64))).astype(np.float32)
    depth[0] = -1
    given = (previous, before, replace(now, depth=depth))
    with np.errstate(over="ignore"):
        assert equal(warp_i420(*given), definition(*given))


def test_values_that_cannot_be_are_refused_by_name():
    previous, before, now = scene((16, 16), 1)
    luma = now.render.y
    bad: list[tuple[str, Callable[[], object]]] = [
        ("256 of 256 .* NaN or infinite", lambda: replace(now, depth=np.nan * now.depth)),
        ("depth: float32 .* must be float32", lambda: replace(now, depth=now.depth[:, 1:])),
        ("depth: float64 .* must be float32", lambda: replace(now, depth=now.depth.astype(float))),
        ("opacity: float32 .* must be", lambda: replace(now, opacity=now.depth[1:])),
        ("render: .* px of a camera of", lambda: replace(now, render=noise((8, 8), 1))),
        ("warp.previous", lambda: warp_i420(noise((8, 8), 1), before, now)),
        ("different intrinsics", lambda: warp_i420(previous, scene((8, 8), 1)[1], now)),
        ("reference", lambda: block_costs(luma, luma[:8])),
        ("threads", lambda: warp_i420(previous, before, now, 0)),
    ]  # fmt: skip
    for words, call in bad:
        with pytest.raises(InvalidInput, match=words):
            call()


@pytest.mark.parametrize("threads", [2, 3, 40])
def test_any_number_of_threads_gives_the_same_bytes(threads):
    for size_px in ((64, 48), (35, 19)):
        previous, before, now = scene(size_px, 7)
        once = warp_i420(previous, before, now)
        assert equal(warp_i420(previous, before, now, threads), once)
        again = correct_i420(previous, before, now, threads)
        assert equal(again, correct_i420(previous, before, now))


def test_block_costs_are_hadamard_sums_and_squares():
    a, b = noise((43, 29), 1).y, noise((43, 29), 2).y
    costs = block_costs(a, b)
    h = np.array([[1]])
    for _ in range(3):
        h = np.block([[h, h], [h, -h]])
    assert costs.satd.shape == (3, 5)
    for j in range(3):
        for i in range(5):
            block = np.s_[8 * j : 8 * j + 8, 8 * i : 8 * i + 8]
            d = a[block].astype(int) - b[block]
            assert costs.satd[j, i] == (np.abs(h @ d @ h).sum() + 4) // 8
            assert costs.ssd[j, i] == (d * d).sum()
