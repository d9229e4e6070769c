"""What the published experiment's rows say: Table I, mean savings, and savings frame by frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["PaperMean", "means_of", "savings_by_frame"]

Row = dict[str, Any]


@dataclass(frozen=True)
class PaperMean:
    """Means over frames for one field, scene, size and way of rendering.

    The savings of a frame are its mean over presets and rate factors; ``sd`` and ``ci95`` are over
    frames, the interval that of a normal mean. A P picture that x264 made an I picture counts as it
    is; ``second_not_p`` is the share of such clips. FLIP is taken of neither controls nor native
    renders.
    """

    field: str
    scene: str
    size_px: tuple[int, int]
    making: str
    frames: int
    savings_percent: float
    sd_percent: float
    ci95_percent: float
    rf_psnr_db: float
    rf_ssim: float
    rf_flip: float | None
    bands: tuple[float, ...]
    second_not_p: float


def means_of(rows: Sequence[Row]) -> list[PaperMean]:
    """Return a mean for every combination there is, in the order of the rows."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        key = (row["field"], row["scene"], (row["width"], row["height"]), row["render"])
        groups.setdefault(key, []).append(row)
    return [_mean(key, group) for key, group in groups.items()]


def savings_by_frame(
    rows: Sequence[Row], field: str, scene: str
) -> dict[tuple[int, int], NDArray[np.float64]]:
    """Return for each size the savings of every frame, rendered as published, in frame order."""
    kept = [
        row
        for row in rows
        if (row["field"], row["scene"], row["render"]) == (field, scene, "downscaled")
    ]
    sizes = dict.fromkeys((row["width"], row["height"]) for row in kept)
    return {
        size: _per_frame([r for r in kept if (r["width"], r["height"]) == size], "savings_percent")
        for size in sizes
    }


def _mean(key: tuple[Any, ...], group: Sequence[Row]) -> PaperMean:
    savings = _per_frame(group, "savings_percent")
    sd = float(np.std(savings, ddof=1)) if len(savings) > 1 else 0.0
    field, scene, size_px, making = key
    return PaperMean(
        field=field,
        scene=scene,
        size_px=size_px,
        making=making,
        frames=len(savings),
        savings_percent=float(np.mean(savings)),
        sd_percent=sd,
        ci95_percent=1.96 * sd / len(savings) ** 0.5,
        rf_psnr_db=float(np.mean(_per_frame(group, "rf_psnr_db"))),
        rf_ssim=float(np.mean(_per_frame(group, "rf_ssim"))),
        rf_flip=float(np.mean(_per_frame(group, "rf_flip"))) if "rf_flip" in group[0] else None,
        bands=tuple(np.mean([row["rf_residual_bands"] for row in group], axis=0).tolist()),
        second_not_p=float(np.mean([row["second_type"] != "P" for row in group])),
    )


def _per_frame(rows: Sequence[Row], column: str) -> NDArray[np.float64]:
    frames: dict[str, list[float]] = {}
    for row in rows:
        frames.setdefault(row["frame"], []).append(row[column])
    return np.array([np.mean(values) for values in frames.values()])
