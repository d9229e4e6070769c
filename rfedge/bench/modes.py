"""What the specialisations of the renderer save and cost, as ratios within one run.

Every mode is a kernel of its own: SH degree, antialiasing, depth and opacity are decided once a
picture. The modes take turns, one picture each a round, so that a ratio is of pictures drawn in
the same moments; ``ratio`` is to colour alone with all three degrees.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from rfcore.camera import Camera
from rfcore.raster.gaussians import Gaussians
from rfcore.raster.native import Rasterizer
from rfedge.bench.street import street_camera
from rfedge.bench.timing import medians_ms

__all__ = ["BASELINE", "mode_rows"]

SIZES_PX = ((300, 168), (640, 360), (1920, 1080))
BASELINE = "degree 3"


def mode_rows(gaussians: Gaussians) -> list[dict[str, Any]]:
    """Return one row per size and mode, on one thread."""
    rasterizers = _rasterizers(gaussians)
    rows = []
    for width, height in SIZES_PX:
        medians = medians_ms(_modes(rasterizers, street_camera(width, height)))
        rows += [
            {
                "width": width,
                "height": height,
                "gaussians": len(gaussians),
                "isa": rasterizers["plain"].isa,
                "mode": mode,
                "native_ms": native_ms,
                "ratio": native_ms / medians[BASELINE],
            }
            for mode, native_ms in medians.items()
        ]
    return rows


def _rasterizers(gaussians: Gaussians) -> dict[str, Rasterizer]:
    without_bands = replace(gaussians, sh=np.ascontiguousarray(gaussians.sh[:, :1]))
    return {
        "plain": Rasterizer(gaussians),
        "without bands": Rasterizer(without_bands),
        "antialiased": Rasterizer(gaussians, antialiased=True),
    }


def _modes(rasterizers: dict[str, Rasterizer], camera: Camera) -> dict[str, Callable[[], object]]:
    plain = rasterizers["plain"]
    return {
        BASELINE: lambda: plain.render_colour(camera),
        "degree 1": lambda: plain.render_colour(camera, sh_degree=1),
        "degree 0": lambda: plain.render_colour(camera, sh_degree=0),
        "field of degree 0": lambda: rasterizers["without bands"].render_colour(camera),
        "antialiased": lambda: rasterizers["antialiased"].render_colour(camera),
        "depth and opacity": lambda: plain.render(camera),
    }
