"""Render a layer of cumulus clouds: a periodic block of droplets and the light scattered in it.

The block is [X, Y, Z] cells over ``EXTENT_M`` of land and ``THICKNESS_M`` of height and repeats
over the land. It stores a smooth field whose positive part is cloud, so that edges stay sharp
between cells. The sun's light is computed once for the whole block, layer by layer towards the sun;
a view ray then costs only look-ups. Scattering follows Wrenninge, "Oz: the great and volumetric"
(SIGGRAPH 2013): later orders see a thinner cloud and a rounder phase function.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from streetgen.geometry.mesh import F32, F64

BAYER = np.array([[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]], np.float32)


def margined(values: F32) -> F32:
    """Return a periodic [X, Y] with its first row and column once more at the end.

    Wrapping by OpenCV's own border takes four times as long.
    """
    return np.pad(values, (0, 1), mode="wrap")


def periodic_at(values: F32, place: F32) -> F32:
    """Sample a margined [X + 1, Y + 1] bilinearly at places [2, H, W] in periods."""
    turns = place - np.floor(place)
    turns *= np.float32(len(values) - 1)
    return np.asarray(cv2.remap(values, turns[1], turns[0], cv2.INTER_LINEAR), np.float32)


def shifted(values: F32, cells: tuple[float, float]) -> F32:
    """Return a periodic [X, Y] sampled bilinearly so many cells further on."""
    by = np.array(cells, np.float64)
    whole = np.floor(by).astype(int)
    x, y = (by - whole).astype(np.float32)
    near, far = (np.roll(values, (-whole[0], -whole[1] - step), (0, 1)) for step in (0, 1))
    low = near * (1 - y) + far * y
    return np.asarray(low * (1 - x) + np.roll(low, -1, 0) * x, np.float32)


def dithered(shape: tuple[int, int]) -> F32:
    """Return ordered shares -0.5..0.5 [H, W] whose mean over any 4 by 4 neighbours is 0."""
    tiled = np.tile(BAYER, (-(-shape[0] // 4), -(-shape[1] // 4)))
    return np.asarray((tiled[: shape[0], : shape[1]] + 0.5) / 16 - 0.5, np.float32)


CELLS, LAYERS = 320, 24
EXTENT_M, BASE_M, THICKNESS_M = 9_000.0, 1100.0, 900.0
CELL_M, LAYER_M = EXTENT_M / CELLS, THICKNESS_M / LAYERS
EXTINCTION_PER_M = 0.03
ORDERS = 7
THINNING, DIMMING = np.float32(0.5), np.float32(0.85)
"""The shares of the extinction and of the light that each further order of scattering keeps."""
AIR_M = 22_000.0
"""Distance at which a cloud keeps 1 / e of its contrast against the sky behind it."""
LOWEST_UP = 0.03
"""Sine of the elevation (2 degrees) below which the air hides the layer."""
STEPS = 40
"""Number of heights at which a view ray samples; with fewer, clouds have visible steps."""
BILLOW_CELLS, BILLOWS = 512, 4
"""Cells of the billows' noise, 4.4 m each, and how often it repeats within the block."""
BILLOW, BILLOW_TURN_M = 1.0, 300.0
"""Displacement of a cloud's edge by billows, in units of the field; height of one change, m."""
CRISP_TO_M = 4_000.0
"""Distance beyond which billows fade, since they are finer than the sky picture's pixels."""
ROWS_AT_ONCE = 32
LOWEST_SUN_UP = 0.12
"""Least sine of the sun's elevation within the layer; flatter rays would leave all in shade."""


@dataclass(frozen=True, eq=False)
class Clouds:
    """The clouds as a field and noise for their edges.

    ``field`` is float32 [X, Y, Z], periodic along X and Y; density is the field clipped to 0..1.
    ``fine`` float32 [2, X', Y'] is noise of smaller cells. It moves the visible edges, but not the
    shadows.
    """

    field: F32
    fine: F32

    @property
    def density(self) -> F32:
        """The density as a share of the full extinction, [X, Y, Z]."""
        return np.clip(self.field, 0.0, 1.0)

    def billows(self, height_m: float) -> F32:
        """Return what to add to the field at a height above the base: lobes between creases."""
        turn = 2 * np.pi * height_m / BILLOW_TURN_M
        wave = np.float32(np.cos(turn)) * self.fine[0] + np.float32(np.sin(turn)) * self.fine[1]
        return np.asarray(np.float32(BILLOW) * (np.abs(wave) - np.float32(0.8)), np.float32)


@dataclass(frozen=True)
class CloudLight:
    """The light on the clouds: the sun's klux [3] and direction, and the sky's mean radiance."""

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
    fine = np.stack([_fine_noise(rng) for _ in range(2)])
    return Clouds(((height - threshold) * 5.0).astype(np.float32), fine)


def sunwards_depth(clouds: Clouds, sun_towards: tuple[float, float, float]) -> F32:
    """Return the optical depth [X, Y, Z] from each cell to the sun."""
    up = max(sun_towards[2], LOWEST_SUN_UP)
    step = np.array(sun_towards[:2]) / up * LAYER_M / CELL_M
    added = np.float32(EXTINCTION_PER_M * LAYER_M / up) * clouds.density
    depth = np.zeros_like(added)
    for layer in range(LAYERS - 2, -1, -1):
        above = depth[..., layer + 1] + added[..., layer + 1]
        depth[..., layer] = shifted(above, (step[0], step[1]))
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
    """Return a sky [H, W, 3] seen in directions [H, W, 3], with the clouds in front of it."""
    slices = _sliced(clouds, sunwards_depth(clouds, light.sun_towards))
    cloudy = sky.copy()
    for top in range(0, len(sky), ROWS_AT_ONCE):
        rows = slice(top, top + ROWS_AT_ONCE)
        if view[rows, :, 2].max() > LOWEST_UP:
            cloudy[rows] = _rows_over(sky[rows], view[rows], slices, light)
    around = np.pad(cloudy, ((0, 0), (1, 1), (0, 0)), mode="wrap")
    smooth = cv2.blur(around, (3, 3), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(smooth[:, 1:-1], np.float32)


def _sliced(clouds: Clouds, depth: F32) -> list[tuple[F32, F32, F32]]:
    """Return field, sunwards depth and billows at each of ``STEPS`` heights, interpolated."""
    slices = []
    for level in _levels():
        low = int(min(level * LAYERS, LAYERS - 2))
        share = np.float32(min(level * LAYERS - low, 1.0))
        field, sunwards = (
            values[..., low] * (1 - share) + values[..., low + 1] * share
            for values in (clouds.field, depth)
        )
        billows = clouds.billows(level * THICKNESS_M)
        slices.append((margined(field), margined(sunwards), margined(billows)))
    return slices


def _levels() -> list[float]:
    return ((np.arange(STEPS) + 0.5) / STEPS).tolist()  # type: ignore[no-any-return]


def _rows_over(sky: F32, view: F32, slices: list[tuple[F32, F32, F32]], light: CloudLight) -> F32:
    up = np.maximum(view[..., 2], np.float32(LOWEST_UP))
    per_m = np.ascontiguousarray(np.moveaxis(view[..., :2], -1, 0) / up)
    phases = _phases(view @ np.array(light.sun_towards, np.float32))
    crisp = np.minimum(up * np.float32(CRISP_TO_M / BASE_M), 1)
    passed, gathered = np.ones_like(up), np.zeros_like(sky)
    within = dithered(up.shape) * np.float32(THICKNESS_M / STEPS)
    for level, (field, sunwards, billows) in zip(_levels(), slices, strict=True):
        place = per_m * ((np.float32(BASE_M + THICKNESS_M * level) + within) / np.float32(EXTENT_M))
        seen = periodic_at(field, place)
        if seen.max() > -BILLOW:
            seen += crisp * periodic_at(billows, place * np.float32(BILLOWS))
            hit = np.nonzero((seen > 0) & (passed > 0.003))
            through = np.float32(EXTINCTION_PER_M * THICKNESS_M / STEPS) / up[hit]
            soft = np.minimum(seen[hit], 1)
            stopped = 1 - np.exp(-through * soft * soft)
            to_sun = periodic_at(sunwards, place)[hit]
            shone = _shone(to_sun, phases[hit], level, light)
            gathered[hit] += (passed[hit] * stopped)[:, None] * shone
            passed[hit] *= 1 - stopped
    far = np.exp(np.float32(-BASE_M / AIR_M) / up)[..., None]
    far[view[..., 2] <= LOWEST_UP] = 0
    return np.asarray(sky * (1 - far * (1 - passed[..., None])) + gathered * far, np.float32)


def _shone(sunwards: F32, phases: F32, level: float, light: CloudLight) -> F32:
    """Return the light scattered into the view [N, 3]: the sun's by orders, and the sky's."""
    passed = np.exp(-sunwards)
    sun = np.zeros_like(sunwards)
    for order in range(ORDERS):
        sun += DIMMING**order * passed * phases[:, order]
        passed **= THINNING
    return np.asarray(
        sun[:, None] * light.sun_klux.astype(np.float32)
        + light.ambient.astype(np.float32) * np.float32(0.55 + 0.45 * level),
        np.float32,
    )


def _phases(cos_scattered: F32) -> F32:
    """Return a strong forward and a weak backward Henyey-Greenstein lobe, [..., ORDERS]."""
    halved = THINNING ** np.arange(ORDERS, dtype=np.float32)

    def lobe(g: F32) -> F32:
        squared = 1 + g * g - 2 * g * cos_scattered[..., None]
        return np.asarray((1 - g * g) / np.float32(4 * np.pi) / (squared * np.sqrt(squared)))

    return np.asarray(
        np.float32(0.7) * lobe(np.float32(0.8) * halved)
        + np.float32(0.3) * lobe(np.float32(-0.2) * halved)
    )


def _noise(rng: np.random.Generator, slope: float, least: float) -> F32:
    """Return noise [X, Y, Z] of deviation 1 whose power falls with frequency from ``least`` on."""
    x, y = (np.fft.fftfreq(CELLS) * CELLS for _ in range(2))
    z = np.fft.rfftfreq(LAYERS) * LAYERS * (EXTENT_M / THICKNESS_M)
    f = np.sqrt(x[:, None, None] ** 2 + y[None, :, None] ** 2 + z[None, None, :] ** 2)
    weight = np.where(f >= least, np.maximum(f, 1.0) ** (-slope / 2), 0.0)
    white = rng.standard_normal((CELLS, CELLS, LAYERS), np.float32)
    noise = np.fft.irfftn(np.fft.rfftn(white) * weight, s=white.shape, axes=(0, 1, 2))
    return np.asarray(noise / noise.std(), np.float32)


def _fine_noise(rng: np.random.Generator) -> F32:
    """Return noise [X', Y'] of deviation 1, of waves shorter than an eighth of its extent."""
    f = np.hypot(np.fft.fftfreq(BILLOW_CELLS)[:, None], np.fft.rfftfreq(BILLOW_CELLS)[None])
    f *= BILLOW_CELLS
    weight = np.where(f >= 8, np.maximum(f, 1.0) ** -1.9, 0.0)
    white = rng.standard_normal((BILLOW_CELLS, BILLOW_CELLS))
    noise = np.fft.irfft2(np.fft.rfft2(white) * weight, s=white.shape)
    return np.asarray(noise / noise.std(), np.float32)


def _blurred(values: F32, cells: int) -> F64:
    """Return [X, Y] blurred by a periodic Gaussian."""
    f = np.fft.fftfreq(len(values))
    kernel = np.exp(-2 * (np.pi * cells) ** 2 * (f[:, None] ** 2 + f[None, :] ** 2))
    return np.asarray(np.fft.ifft2(np.fft.fft2(values) * kernel).real)
