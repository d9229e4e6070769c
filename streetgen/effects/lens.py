"""Resample a pinhole frame as a distorting lens would show it.

The lens's focal length is scaled up until every output pixel has a source in the pinhole frame, so
that no edges stay blank.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Intrinsics
from rfcore.errors import InvalidInput
from rfcore.lens import BrownLens, LensCamera
from rfcore.tables import Range
from streetgen.frame import F32, LinearFrame, sampled

ZOOMS = np.geomspace(0.8, 3.0, 200)

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class LensDistortion:
    """The lens's coefficients (``rfcore.lens.BrownLens``)."""

    k1: Annotated[float, Range(-1, 1)] = -0.12
    k2: Annotated[float, Range(-1, 1)] = 0.02
    p1: Annotated[float, Range(-0.1, 0.1)] = 0.0
    p2: Annotated[float, Range(-0.1, 0.1)] = 0.0

    def apply(self, frame: LinearFrame, _rng: np.random.Generator) -> LinearFrame:
        """Resample the frame; its camera becomes a ``LensCamera``."""
        lens = BrownLens(self.k1, self.k2, self.p1, self.p2)
        intrinsics, u_px, v_px = _source_map(frame.camera.intrinsics, lens)
        nearest = v_px.astype(int), u_px.astype(int)
        return replace(
            frame,
            colour=sampled(frame.colour, u_px, v_px),
            depth_m=frame.depth_m[nearest],
            labels=None if frame.labels is None else frame.labels[nearest],
            camera=LensCamera(intrinsics, lens, frame.camera.world_from_cam),
        )


@lru_cache(maxsize=2)
def _source_map(pinhole: Intrinsics, lens: BrownLens) -> tuple[Intrinsics, F32, F32]:
    """Return the lens's intrinsics and the source of each pixel; a drive's frames share them."""
    intrinsics = _fitting(pinhole, lens)
    u, v = np.meshgrid(np.arange(pinhole.width_px) + 0.5, np.arange(pinhole.height_px) + 0.5)
    source = _source_px(np.stack([u.ravel(), v.ravel()], axis=1), intrinsics, pinhole, lens)
    u_px, v_px = (source[:, i].reshape(u.shape).astype(np.float32) for i in (0, 1))
    return intrinsics, u_px, v_px


def _source_px(pixels: F64, lensed: Intrinsics, pinhole: Intrinsics, lens: BrownLens) -> F64:
    """Return the positions in the pinhole's frame that the lens's pixels show."""
    sensor = (pixels - (lensed.cx_px, lensed.cy_px)) / (lensed.fx_px, lensed.fy_px)
    directions = lens.undistort(sensor)
    return np.asarray(directions * (pinhole.fx_px, pinhole.fy_px) + (pinhole.cx_px, pinhole.cy_px))


def _fitting(pinhole: Intrinsics, lens: BrownLens) -> Intrinsics:
    """Return the least zoom at which all pixels of the edge come from inside the frame."""
    k = pinhole
    u, v = np.arange(k.width_px) + 0.5, np.arange(k.height_px) + 0.5
    edge = np.concatenate(
        [np.stack([u, np.full_like(u, y)], axis=1) for y in (v[0], v[-1])]
        + [np.stack([np.full_like(v, x), v], axis=1) for x in (u[0], u[-1])]
    )
    for zoom in ZOOMS:
        lensed = replace(k, fx_px=k.fx_px * zoom, fy_px=k.fy_px * zoom)
        try:
            source = _source_px(edge, lensed, k, lens)
        except InvalidInput:
            continue
        low, high = source.min(axis=0), source.max(axis=0)
        if (low >= 0).all() and high[0] < k.width_px and high[1] < k.height_px:
            return lensed
    raise InvalidInput("lens", f"{lens} leaves blank edges at {ZOOMS[-1]:g} times the focal length")
