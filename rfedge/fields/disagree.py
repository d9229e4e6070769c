"""Where a field and the street disagree, as a picture an operator can look at.

The render is brought to the frame's light first, each plane by one gain and offset, so that what is
red has changed on the street, or was never learnt, and is not the hour of the day.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput
from rfcore.field import RadianceField, render_field_view
from rfcore.image import I420, Rgb
from rfcore.native.yuv import i420_from_rgb, rgb_from_i420
from rfcore.views import PosedPicture

__all__ = ["block_differences", "disagreement_picture"]

SHOWN_FRAMES = 4
BLOCK_PX = 8
FULL_RED_LEVELS = 60
"""Mean absolute difference of a block's luma that is drawn fully red."""
CHANGED_LEVELS = 20
ROUNDS = 3


def disagreement_picture(
    field: RadianceField, pictures: Sequence[PosedPicture]
) -> tuple[Rgb, list[str]]:
    """Return frames evenly along ``pictures``, a row each, and a line about each.

    Raises ``InvalidInput`` without pictures or for pictures of several sizes, ``DatasetError`` for
    one that cannot be read.
    """
    if not pictures:
        raise InvalidInput("from", "no pictures to compare the field with")
    chosen = np.linspace(0, len(pictures) - 1, min(SHOWN_FRAMES, len(pictures))).round()
    rows, lines = [], []
    for picture in (pictures[int(place)] for place in chosen):
        seen = picture.read()
        frame = i420_from_rgb(seen)
        shown = _in_light_of(frame, field, picture)
        levels = block_differences(frame, shown)
        rows.append(np.concatenate([seen, rgb_from_i420(shown), _reddened(seen, levels)], axis=1))
        share = 100 * float((levels > CHANGED_LEVELS).mean())
        lines.append(f"{picture.name}: {share:.1f} % of the blocks differ")
    if len({row.shape for row in rows}) > 1:
        raise InvalidInput("from", "pictures of several sizes; give passes of one camera")
    return np.ascontiguousarray(np.concatenate(rows, axis=0)), lines


def block_differences(frame: I420, shown: I420) -> NDArray[np.float64]:
    """Return the mean absolute luma difference of each whole 8x8 block, [H // 8, W // 8]."""
    off = np.abs(frame.y.astype(np.float64) - shown.y)
    height, width = (side // BLOCK_PX for side in off.shape)
    blocks = off[: height * BLOCK_PX, : width * BLOCK_PX]
    means = blocks.reshape(height, BLOCK_PX, width, BLOCK_PX).mean(axis=(1, 3))
    return np.asarray(means)


def _in_light_of(frame: I420, field: RadianceField, picture: PosedPicture) -> I420:
    render = render_field_view(field, picture.camera).render
    y, u, v = map(_matched, render.planes, frame.planes)
    return I420(y, u, v)


def _matched(plane: NDArray[np.uint8], like: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return ``plane`` with the gain and offset, by least squares, that bring it to ``like``.

    Three times, each time without what is further than twice the median off: it has changed.
    """
    x, y = plane.astype(np.float64), like.astype(np.float64)
    keep, out = np.ones(x.shape, bool), x
    for _ in range(ROUNDS):
        middle, off = y[keep].mean(), x - x[keep].mean()
        gain = float((off * y)[keep].sum() / max(float((off * off)[keep].sum()), 1e-9))
        out = middle + gain * off
        error = np.abs(out - y)
        keep = error <= 2 * np.median(error) + 1e-9
    return np.asarray(np.clip(np.rint(out), 1, 255), np.uint8)


def _reddened(seen: Rgb, levels: NDArray[np.float64]) -> Rgb:
    share = np.zeros(seen.shape[:2])
    spread = np.clip(levels / FULL_RED_LEVELS, 0, 1).repeat(BLOCK_PX, 0).repeat(BLOCK_PX, 1)
    share[: spread.shape[0], : spread.shape[1]] = spread
    grey = seen.mean(axis=2, keepdims=True) * 0.6
    red = np.array([255.0, 0.0, 0.0])
    return np.asarray(grey + share[..., None] * (red - grey)).round().astype(np.uint8)
