"""A layer of cumulus: a block of droplets that repeats over the land, lit through itself.

The block is [X, Y, Z] cells over ``EXTENT_M`` of land and ``THICKNESS_M`` of height. It holds a
smooth field whose positive part is cloud, so that edges stay sharp between cells. Its light is
found once for the whole block by walking layer by layer towards the sun; a view ray then costs only
look-ups. Scattering follows Wrenninge, "Oz: the great and volumetric" (SIGGRAPH 2013): later orders
see a thinner cloud and a rounder phase function.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rfedge.street.geometry.mesh import F32, F64

__all__ = ["CloudLight", "Clouds", "cumulus", "over", "sunwards_depth", "with_sun_free"]

CELLS, LAYERS = 320, 24
EXTENT_M, BASE_M, THICKNESS_M = 9_000.0, 1100.0, 900.0
CELL_M, LAYER_M = EXTENT_M / CELLS, THICKNESS_M / LAYERS
EXTINCTION_PER_M = 0.03
ORDERS = 7
THINNING, DIMMING = np.float32(0.5), np.float32(0.85)
"""What each further order of scattering keeps of the extinction, and of the light."""
AIR_M = 22_000.0
"""Where a cloud keeps 1 / e of its contrast against the sky behind it."""
LOWEST_UP = 0.03
"""Lower than that (2 degrees) the layer is hidden by the air."""
LOWEST_SUN_UP = 0.12
"""The sun's rays are not taken flatter than that through the layer, or all would be in shade."""


@dataclass(frozen=True, eq=False)
class Clouds:
    """``field`` float32 [X, Y, Z], periodic along X and Y; density is its part within 0..1."""

    field: F32

    @property
    def density(self) -> F32:
        """The share of the full extinction, [X, Y, Z]."""
        return np.clip(self.field, 0.0, 1.0)


@dataclass(frozen=True)
class CloudLight:
    """What falls on the clouds: the sun's klux [3] and from where, and the sky's mean radiance."""

    sun_klux: F64
    sun_towards: tuple[float, float, float]
    ambient: F64


def cumulus(rng: np.random.Generator, cover: float) -> Clouds:
    """Return clouds over about a share ``cover`` of the land, flat below and domed above."""
    wide, billows = _noise(rng, 4.6, 3.0), _noise(rng, 3.4, 14.0)
    shape = wide + 0.3 * np.abs(billows)
    level = np.linspace(0.0, 1.0, LAYERS, dtype=np.float32)
    hull = 1.9 * level**1.5 + 1.5 * np.exp(-level / 0.03)
    height = shape - hull
    threshold = np.quantile(height.max(axis=2), 1 - cover)
    return Clouds(((height - threshold) * 5.0).astype(np.float32))


def sunwards_depth(clouds: Clouds, sun_towards: tuple[float, float, float]) -> F32:
    """Return the optical depth [X, Y, Z] from each cell to the sun."""
    up = max(sun_towards[2], LOWEST_SUN_UP)
    step = np.array(sun_towards[:2]) / up * LAYER_M / CELL_M
    added = np.float32(EXTINCTION_PER_M * LAYER_M / up) * clouds.density
    depth = np.zeros_like(added)
    x, y = np.meshgrid(np.arange(CELLS), np.arange(CELLS), indexing="ij")
    place = np.stack([x.ravel() + step[0], y.ravel() + step[1]], axis=1)
    for layer in range(LAYERS - 2, -1, -1):
        above = depth[..., layer + 1] + added[..., layer + 1]
        depth[..., layer] = _sampled(above, place).reshape(CELLS, CELLS)
    return depth


def with_sun_free(clouds: Clouds, sun_towards: tuple[float, float, float]) -> Clouds:
    """Return the clouds moved so that who stands at the origin sees the sun between them."""
    depth = sunwards_depth(clouds, sun_towards)[..., 0]
    clearest = np.unravel_index(int(np.argmin(_blurred(depth, 12))), depth.shape)
    up = max(sun_towards[2], LOWEST_SUN_UP)
    seen_at = np.array(sun_towards[:2]) / up * BASE_M / CELL_M
    shift = np.round(seen_at - np.array(clearest)).astype(int)
    return replace(clouds, field=np.roll(clouds.field, tuple(shift.tolist()), axis=(0, 1)))


def over(sky: F32, view: F32, clouds: Clouds, light: CloudLight) -> F32:
    """Return a sky [N, 3] seen in directions [N, 3], with the clouds in front of it."""
    depth = sunwards_depth(clouds, light.sun_towards)
    seen = np.flatnonzero(view[:, 2] > LOWEST_UP)
    rays = view[seen]
    phases = _phases(rays @ np.array(light.sun_towards, np.float32))
    passed = np.ones(len(rays), np.float32)
    gathered = np.zeros((len(rays), 3), np.float32)
    through = np.float32(EXTINCTION_PER_M * LAYER_M) / rays[:, 2]
    for layer in range(LAYERS):
        place = rays[:, :2] / rays[:, 2:] * np.float32((BASE_M + LAYER_M * layer) / CELL_M)
        field = _sampled(clouds.field[..., layer], place)
        hit = np.flatnonzero((field > 0) & (passed > 0.003))
        if len(hit):
            stopped = 1 - np.exp(-through[hit] * np.minimum(field[hit], 1))
            sunwards = _sampled(depth[..., layer], place[hit])
            shone = _shone(sunwards, phases[hit], layer / LAYERS, light)
            gathered[hit] += (passed[hit] * stopped)[:, None] * shone
            passed[hit] *= 1 - stopped
    far = np.exp(np.float32(-BASE_M / AIR_M) / rays[:, 2:])
    cloudy: F32 = sky.copy()
    cloudy[seen] = sky[seen] * (1 - far * (1 - passed[:, None])) + gathered * far
    return cloudy


def _shone(sunwards: F32, phases: F32, level: float, light: CloudLight) -> F32:
    """Light scattered into the view [N, 3]: the sun's by orders, and the sky's from above."""
    thinned = THINNING ** np.arange(ORDERS, dtype=np.float32)
    orders = np.exp(-sunwards[:, None] * thinned) * DIMMING ** np.arange(ORDERS, dtype=np.float32)
    sun = (orders * phases).sum(axis=1, keepdims=True)
    return np.asarray(
        sun * light.sun_klux.astype(np.float32)
        + light.ambient.astype(np.float32) * np.float32(0.55 + 0.45 * level),
        np.float32,
    )


def _phases(cos_scattered: F32) -> F32:
    """Henyey-Greenstein with a strong forward and a weak backward lobe, [N, ORDERS]."""
    halved = THINNING ** np.arange(ORDERS, dtype=np.float32)

    def lobe(g: F32) -> F32:
        return np.asarray(
            (1 - g * g) / (4 * np.pi * (1 + g * g - 2 * g * cos_scattered[:, None]) ** 1.5)
        )

    return np.asarray(0.7 * lobe(0.8 * halved) + 0.3 * lobe(-0.2 * halved), np.float32)


def _noise(rng: np.random.Generator, slope: float, least: float) -> F32:
    """Noise [X, Y, Z] of deviation 1 whose power falls with frequency; none slower than least."""
    x, y = (np.fft.fftfreq(CELLS) * CELLS for _ in range(2))
    z = np.fft.rfftfreq(LAYERS) * LAYERS * (EXTENT_M / THICKNESS_M)
    f = np.sqrt(x[:, None, None] ** 2 + y[None, :, None] ** 2 + z[None, None, :] ** 2)
    weight = np.where(f >= least, np.maximum(f, 1.0) ** (-slope / 2), 0.0)
    white = rng.standard_normal((CELLS, CELLS, LAYERS), np.float32)
    noise = np.fft.irfftn(np.fft.rfftn(white) * weight, s=white.shape, axes=(0, 1, 2))
    return np.asarray(noise / noise.std(), np.float32)


def _blurred(values: F32, cells: int) -> F64:
    """Periodic Gaussian blur of [X, Y]."""
    f = np.fft.fftfreq(len(values))
    kernel = np.exp(-2 * (np.pi * cells) ** 2 * (f[:, None] ** 2 + f[None, :] ** 2))
    return np.asarray(np.fft.ifft2(np.fft.fft2(values) * kernel).real)


def _sampled(values: F32, place: F32 | F64) -> F32:
    """Sample a periodic [X, Y] bilinearly at [N, 2], in cells."""
    low = np.floor(place)
    x, y = (place - low).T.astype(np.float32)
    i, j = (low.astype(np.int64) % CELLS).T
    right, next_row = (i + 1) % CELLS, (j + 1) % CELLS
    near = values[i, j] * (1 - x) + values[right, j] * x
    far = values[i, next_row] * (1 - x) + values[right, next_row] * x
    return np.asarray(near * (1 - y) + far * y, np.float32)
