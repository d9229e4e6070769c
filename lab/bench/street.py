"""A synthetic street of Gaussians to measure the rasterizer on: road, facades, sky, trees, cars.

The same seed gives the same Gaussians. At 200,000 of them and a field of view of 70 degrees a pixel
takes about 47 useful blends, as trained street fields do. Camera at the origin, looking along +z,
y down.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.harmonics import SH_DC
from rfcore.raster.gaussians import Gaussians

STREET_GAUSSIANS = 200_000
STREET_SEED = 1
FIELD_OF_VIEW_DEG = 70.0
SHARES = {"facades": 0.38, "road": 0.2, "sky": 0.08, "trees": 0.2}
"""Shares of all Gaussians; cars get the rest."""

F64 = NDArray[np.float64]
Rng = np.random.Generator


@dataclass(frozen=True)
class _Surface:
    """Flat Gaussians: means, normals and colours [n, 3], size [n], thickness by size."""

    means: F64
    normals: F64
    size_m: F64
    thickness: float
    colours: F64


def street_gaussians(count: int = STREET_GAUSSIANS, seed: int = STREET_SEED) -> Gaussians:
    """Return ``count`` Gaussians of a street, SH degree 3, in Morton order of their means."""
    rng = np.random.default_rng(seed)
    makers: dict[str, Callable[[Rng, int, int], _Surface]] = {
        "facades": _facades,
        "road": _road,
        "sky": _sky,
        "trees": _trees,
        "cars": _cars,
    }
    counts = {name: int(count * share) for name, share in SHARES.items()}
    counts["cars"] = count - sum(counts.values())
    parts = []
    for name, make in makers.items():
        surface = make(rng, counts[name], count)
        parts.append(_scatter(rng, surface))
    means, quaternions, log_scales, opacities, colours = map(
        np.concatenate, zip(*parts, strict=True)
    )
    opacities = np.clip(opacities, 3e-3, 0.999)
    arrays = (
        means,
        quaternions,
        log_scales,
        np.log(opacities / (1 - opacities)),
        _harmonics(rng, colours),
    )
    order = _morton_order(means)
    return Gaussians(*(np.ascontiguousarray(a[order], dtype=np.float32) for a in arrays))


def street_camera(width_px: int, height_px: int) -> Camera:
    """Return the camera the street is measured from."""
    focal = 0.5 * width_px / np.tan(np.radians(FIELD_OF_VIEW_DEG) / 2)
    intrinsics = Intrinsics(width_px, height_px, focal, focal, width_px / 2, height_px / 2)
    return Camera(intrinsics, Pose.identity())


def _facades(rng: Rng, n: int, _total: int) -> _Surface:
    side = rng.choice([-1, 1], n)
    z = rng.random(n) ** 1.3 * 65 - 5
    y = -(rng.random(n) ** 1.2) * 14
    x = side * (9 + rng.normal(size=n) * 0.15 + 2 * (np.sin(z * 0.4) > 0.6))
    size = np.sqrt(2 * 70 * 14 / n) * (0.5 + z.clip(0) / 30)
    bands = 0.2 * np.sin(z[:, None] * np.array([0.7, 0.9, 1.1]))
    means = np.stack([x, y + 1.6, z], 1)
    normals = np.stack([-side, 0 * x, 0 * x], 1).astype(float)
    return _Surface(means, normals, size, 0.15, np.clip(0.5 + bands + _noise(rng, n, 0.08), 0, 1))


def _road(rng: Rng, n: int, _total: int) -> _Surface:
    z = rng.random(n) ** 1.5 * 65 - 5
    x = rng.uniform(-9, 9, n)
    means = np.stack([x, 1.6 + rng.normal(size=n) * 0.02, z], 1)
    size = np.sqrt(18 * 70 / n) * (0.4 + z.clip(0) / 25)
    marking = 0.4 * (np.abs(x[:, None] % 3) < 0.12)
    grey = np.clip(0.35 + rng.normal(size=(n, 1)) * 0.06 + marking, 0, 1)
    return _Surface(means, np.tile([0, -1.0, 0], (n, 1)), size, 0.1, grey * np.ones((1, 3)))


def _sky(rng: Rng, n: int, _total: int) -> _Surface:
    d = rng.normal(size=(n, 3))
    d[:, 1] = -np.abs(d[:, 1])
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    size = np.full(n, np.sqrt(2 * np.pi * 3600 / n))
    blue = np.clip(np.array([0.6, 0.75, 0.95]) + _noise(rng, n, 0.03), 0, 1)
    return _Surface(d * 60, d, size, 0.2, blue)


def _trees(rng: Rng, n: int, total: int) -> _Surface:
    trees = 24
    columns = [rng.choice([-6.5, 6.5], trees), np.full(trees, -3.0), np.linspace(2, 58, trees)]
    crowns = np.stack(columns, 1)
    which = rng.integers(0, trees, n)
    means = crowns[which] + rng.normal(size=(n, 3)) * np.array([1.1, 1.2, 1.1])
    normals = rng.normal(size=(n, 3))
    size = np.full(n, 0.085) * (200_000 / total) ** 0.33
    green = np.clip(np.array([0.25, 0.4, 0.15]) + _noise(rng, n, 0.1), 0, 1)
    return _Surface(means, normals, size, 0.35, green)


def _cars(rng: Rng, n: int, total: int) -> _Surface:
    cars = 14
    columns = [rng.choice([-4.5, 4.5], cars), np.full(cars, 0.9), np.linspace(5, 50, cars)]
    centres = np.stack(columns, 1)
    which = rng.integers(0, cars, n)
    u = rng.normal(size=(n, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    size = np.full(n, 0.06) * (200_000 / total) ** 0.5
    paint = np.clip(rng.random((cars, 3))[which] + _noise(rng, n, 0.06), 0, 1)
    return _Surface(centres[which] + u * np.array([0.9, 0.7, 2.1]), u, size, 0.2, paint)


def _noise(rng: Rng, n: int, sigma: float) -> F64:
    return rng.normal(size=(n, 3)) * sigma


def _scatter(rng: Rng, surface: _Surface) -> tuple[F64, F64, F64, F64, F64]:
    """Give every point of a surface a tilt, three scales and an opacity."""
    n = len(surface.means)
    opacity = _opacities(rng, n)
    log_scales = np.log(surface.size_m)[:, None] + rng.normal(size=(n, 3)) * 0.45
    log_scales[:, 2] += np.log(surface.thickness)
    tilted = surface.normals + rng.normal(size=(n, 3)) * 0.15
    return surface.means, _facing(tilted, rng), log_scales, opacity, surface.colours


def _opacities(rng: Rng, n: int) -> F64:
    """Many faint and many nearly opaque, as training leaves them."""
    return np.where(rng.random(n) < 0.55, rng.beta(0.7, 2.5, n), rng.beta(2.5, 0.8, n))


def _facing(normals: F64, rng: Rng) -> F64:
    """Return quaternions [n, 4] whose local z axis is the normal, spun at random."""
    n = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    a = rng.normal(size=n.shape)
    t = a - n * (a * n).sum(1, keepdims=True)
    t /= np.linalg.norm(t, axis=1, keepdims=True)
    m = np.stack([t, np.cross(n, t), n], -1)
    xx, yy, zz = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    w = np.sqrt(np.maximum(0, 1 + xx + yy + zz)) / 2
    x = np.sqrt(np.maximum(0, 1 + xx - yy - zz)) / 2
    y = np.sqrt(np.maximum(0, 1 - xx + yy - zz)) / 2
    z = np.sqrt(np.maximum(0, 1 - xx - yy + zz)) / 2
    x = np.copysign(x, m[:, 2, 1] - m[:, 1, 2])
    y = np.copysign(y, m[:, 0, 2] - m[:, 2, 0])
    z = np.copysign(z, m[:, 1, 0] - m[:, 0, 1])
    return np.stack([w, x, y, z], 1)


def _harmonics(rng: Rng, colours: F64) -> F64:
    """Return SH [n, 16, 3]: the colour, and a little of every other coefficient."""
    n = len(colours)
    falloff = np.array([1.0] * 3 + [0.6] * 5 + [0.4] * 7)[None, :, None]
    sh = np.zeros((n, 16, 3))
    sh[:, 0] = (colours - 0.5) / SH_DC
    sh[:, 1:] = rng.normal(size=(n, 15, 3)) * 0.1 * falloff
    return sh


def _morton_order(means: F64) -> NDArray[np.int64]:
    """Return the order along a Z curve of 10 bits an axis over the bulk of the points."""
    low, high = np.percentile(means, 1, 0), np.percentile(means, 99, 0)
    cell = np.clip((means - low) / (high - low).max() * 1023, 0, 1023).astype(np.uint64)
    x, y, z = (_spread_bits(cell[:, axis]) for axis in range(3))
    return np.argsort(x | (y << np.uint64(1)) | (z << np.uint64(2)), kind="stable")


def _spread_bits(v: NDArray[np.uint64]) -> NDArray[np.uint64]:
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        v = (v | (v << np.uint64(shift))) & np.uint64(mask)
    return v
