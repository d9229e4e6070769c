"""Splats as a file of another program holds them, and what of them a field takes.

A field holds finite float32 of SH degree 0 to 3, relative to a tile's origin. ``settled`` brings
there what a reader found, and says in a line each what was chosen, changed or left out:

* an opacity logit of +-inf, which is fully opaque or transparent, becomes ``+-OPAQUE_LOGIT``;
* a log scale of -inf, a flat splat, becomes ``FLAT_LOG_SCALE``;
* splats with any other value that is not finite are left out, unless they are more than half;
* higher bands than the third are left out;
* where the median splat is farther than 10 km from zero it becomes the tile's origin, as a
  dataset's median camera does; float32 would round such positions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import TileOrigin, Vec3
from rfcore.errors import FieldFormatError
from rfcore.raster.gaussians import F32, Gaussians

OPAQUE_LOGIT = 13.8
"""Logit of 1 - 1e-6."""
FLAT_LOG_SCALE = -20.0
"""Logarithm of 2 nm."""
MOST_DEGREE = 3
COARSE_M = 0.01
"""Positions in coarser steps are remarked upon."""

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class StoredSplats:
    """Splats of a file, of any SH degree and not yet checked, with the axes of a .ply.

    ``means_m`` [N, 3] is in the file's own world; the other arrays are as in ``Gaussians``.
    ``antialiased`` is None where the file does not say how splats are drawn. ``step_m`` is the step
    in which positions are stored near their median, ``notes`` say what the reader did. ``up`` is
    None where the file does not say it.
    """

    means_m: F64
    quaternions: F32
    log_scales: F32
    opacity_logits: F32
    sh: F32
    antialiased: bool | None = None
    step_m: float = 0.0
    notes: tuple[str, ...] = ()
    up: Vec3 | None = None


@dataclass(frozen=True)
class ImportedSplats:
    """Splats relative to ``tile_origin``, and a line for each thing that was done to them."""

    splats: Gaussians
    antialiased: bool | None
    tile_origin: TileOrigin
    notes: tuple[str, ...] = ()
    up: Vec3 | None = None


def settled(path: Path, stored: StoredSplats, tile_origin: TileOrigin | None) -> ImportedSplats:
    """Return what a field takes of a file's splats, relative to ``tile_origin`` (None: chosen).

    Raises ``FieldFormatError`` naming ``path`` where more than half of the splats are not finite.
    """
    notes = list(stored.notes)
    origin = tile_origin if tile_origin is not None else chosen_origin(stored.means_m, notes)
    if stored.step_m >= COARSE_M:
        notes.append(
            f"positions come in steps of {stored.step_m:.2g} m, so far are they from zero: export "
            "them relative to a place nearby, or as float64"
        )
    offset_m = np.array([origin.east_m, origin.north_m, origin.up_m])
    with np.errstate(over="ignore"):
        means = (stored.means_m - offset_m).astype(np.float32)
    arrays = {
        "means": means,
        "quaternions": stored.quaternions,
        "log_scales": _without_flat(stored.log_scales, notes),
        "opacity_logits": _without_opaque(stored.opacity_logits, notes),
        "sh": _without_high_bands(stored.sh, notes),
    }
    kept = _finite(path, arrays, notes)
    if not kept.all():
        arrays = {name: array[kept] for name, array in arrays.items()}
    splats = Gaussians(**{name: np.ascontiguousarray(array) for name, array in arrays.items()})
    return ImportedSplats(splats, stored.antialiased, origin, tuple(notes), stored.up)


def sh_degree_of(coefficients: int) -> int | None:
    """Return the SH degree with so many coefficients a channel, None where there is none."""
    degree = math.isqrt(coefficients) - 1
    return degree if degree >= 0 and (degree + 1) ** 2 == coefficients else None


def finite_logits(shares: F64) -> F64:
    """Return the logits of opacities in steps of 1/255; 0 and 1 are taken half a step inwards."""
    inner = np.clip(shares, 0.5 / 255.0, 254.5 / 255.0)
    return np.asarray(np.log(inner / (1.0 - inner)))


def linear_parts(gaussians: Gaussians) -> tuple[F64, F64, F64]:
    """Return rotations [N, 4] as unit x, y, z, w, scales [N, 3] and opacities [N], as formats store
    them that take no logarithms."""
    xyzw = np.roll(gaussians.quaternions.astype(np.float64), -1, axis=1)
    xyzw /= np.linalg.norm(xyzw, axis=1, keepdims=True)
    scales = np.exp(gaussians.log_scales.astype(np.float64))
    return xyzw, scales, 1 / (1 + np.exp(-gaussians.opacity_logits.astype(np.float64)))


def middle_of(means_m: F64) -> F64:
    """Return the median [3] of the means that are finite, zero where none is."""
    finite = means_m[np.isfinite(means_m).all(axis=1)]
    if not len(finite):
        return np.zeros(3)
    # np.median imports numpy.ma, which a sandbox does not permit.
    return np.asarray(np.partition(finite, len(finite) // 2, axis=0)[len(finite) // 2])


def chosen_origin(means_m: F64, notes: list[str]) -> TileOrigin:
    """Return zero, or the median splat where that is far away, which ``notes`` then say."""
    origin = TileOrigin.beside(middle_of(means_m).tolist())
    if origin != TileOrigin():
        place = f"{origin.east_m:.0f} {origin.north_m:.0f} {origin.up_m:.0f}"
        notes.append(f"tile origin {place} m, the median splat (--tile-origin takes another)")
    return origin


def _without_opaque(logits: F32, notes: list[str]) -> F32:
    infinite = np.isinf(logits)
    if not infinite.any():
        return logits
    notes.append(
        f"{infinite.sum()} of {len(logits)} splats are fully opaque or transparent: their opacity "
        f"logits of +-inf become +-{OPAQUE_LOGIT}"
    )
    return np.where(infinite, np.copysign(np.float32(OPAQUE_LOGIT), logits), logits)


def _without_flat(log_scales: F32, notes: list[str]) -> F32:
    flat = np.isneginf(log_scales)
    if not flat.any():
        return log_scales
    notes.append(
        f"{flat.any(axis=1).sum()} of {len(log_scales)} splats have a scale of 0, which becomes "
        f"exp({FLAT_LOG_SCALE:g}) m"
    )
    return np.where(flat, np.float32(FLAT_LOG_SCALE), log_scales)


def _without_high_bands(sh: F32, notes: list[str]) -> F32:
    degree = sh_degree_of(sh.shape[1])
    assert degree is not None, sh.shape
    if degree <= MOST_DEGREE:
        return sh
    notes.append(f"colours of SH degree {degree} are reduced to degree {MOST_DEGREE}")
    return sh[:, : (MOST_DEGREE + 1) ** 2]


def _finite(path: Path, arrays: dict[str, F32], notes: list[str]) -> NDArray[np.bool_]:
    """Return which splats are finite; say how many are not, and in what."""
    finite = {
        name: np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
        for name, array in arrays.items()
    }
    kept: NDArray[np.bool_] = np.logical_and.reduce(list(finite.values()))
    lost = np.flatnonzero(~kept)
    if len(lost):
        counts = ", ".join(
            f"{name} of {(~ok).sum()}" for name, ok in finite.items() if not ok.all()
        )
        problem = (
            f"{len(lost)} of {len(kept)} splats are not finite ({counts}; the first: {lost[0]})"
        )
        if 2 * len(lost) > len(kept):
            raise FieldFormatError(f"{path}: {problem}: the file is damaged, or training diverged")
        notes.append(f"{problem} and left out")
    return kept
