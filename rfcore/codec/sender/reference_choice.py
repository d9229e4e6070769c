"""What the sender decides about a frame before it codes it: references, and the render's light.

Coding with every set of references and comparing would cost a run of x264 each, and comparing bytes
at equal CRF would mislead, since a better reference also gives a better picture at the same CRF.
Instead each 8x8 block gets an estimate of D + lambda R for each picture, from the sum of absolute
Hadamard coefficients and of squares of the difference (0.4 ms a picture at 640x360)::

    coded = min(SSD, step**2 * 64 / 12) + lambda * (1 + max(0, SATD / step - 16))
    copied = SSD                    (reference 0 only)
    step = 2**((CRF - 4) / 6),  lambda = 0.57 * 2**((CRF - 12) / 3)

The 16 is what the quantiser swallows. So estimated, a 640x360 street takes 199, 76, 20 and 2.6
kbit at CRF 17, 23, 29 and 35 against its render, where x264 takes 192, 69, 14 and 2.0; and against
their own means, which stand in for intra prediction, its blocks take 395, 172, 65 and 20, where
x264 takes 310, 163, 77 and 36.

There is no motion in this: the pictures made from the field stand where the frame stands. The
previous frame does not, and x264 looks for it; it is taken along whenever there is one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rfcore.codec.block_means import block_mean_digest
from rfcore.codec.photometric import Photometric, adapt, solve
from rfcore.codec.prediction import Prediction
from rfcore.codec.references import INTRA, RENDER_ONLY, Reference, References
from rfcore.image import I420
from rfcore.native.warp import BLOCK_PX, block_costs

__all__ = ["choose_photometric", "choose_references"]

BLOCK_BITS = 1.0
DEAD_ZONE_SATD = 16.0
INDEX_BITS = 1.0
"""What naming another reference than the first costs a block."""

USELESS_INTRA_RATIO = 1.2
"""Of the cost of intra prediction: beyond it no picture of the field helps. P slices can predict
blocks from their neighbours too, so a picture that helps a few blocks does no harm."""
POOR_INTRA_RATIO = 0.5
"""Of the cost of intra prediction: with a correction worse than this, the warp is tried as well."""
MIN_SAVING = 0.015
"""Of the cost so far: another reference must save at least so much."""

GOOD_INTRA_RATIO = 0.9
"""Of the cost of intra prediction: what an adapted render must stay below. Where the light of a
whole street was changed it reaches 0.75, as in the right light; a field of noon at dusk 1.2."""

NOTICEABLE_LEVELS = 2
"""Median difference of block means from which a change of light is looked for."""
PHOTOMETRIC_BITS = 12 * 16

Costs = NDArray[np.float64]


def choose_references(frame: I420, prediction: Prediction, crf: float, most: int = 3) -> References:
    """Return at most ``most`` references for ``frame``, the most useful last."""
    if min(frame.size_px) < BLOCK_PX:
        return RENDER_ONLY
    costs = _Costs(frame, crf)
    carried = Reference.CORRECTION in prediction.available
    usable = {Reference.RENDER: costs.of(prediction.render)}
    if carried:
        usable[Reference.CORRECTION] = costs.of(prediction.correction)
    if carried and min(map(_total, usable.values())) > POOR_INTRA_RATIO * costs.intra:
        usable[Reference.WARP] = costs.of(prediction.warp)
    has_past = Reference.PREVIOUS in prediction.available
    best = min(usable, key=lambda reference: _total(usable[reference]))
    if _total(usable[best]) > USELESS_INTRA_RATIO * costs.intra:
        return (Reference.PREVIOUS,) if has_past else INTRA
    room = most - 1 - has_past
    chosen = [best]
    if room > 0 and (second := _second(usable, best, costs.index_cost)) is not None:
        chosen.insert(0, second)
    if has_past and most > 1:
        chosen.insert(0, Reference.PREVIOUS)
    return tuple(chosen)


def choose_photometric(frame: I420, render: I420, crf: float) -> Photometric:
    """Return how the render's light is to be changed, if that saves more than it costs to say.

    It must make a good reference of the render: shadows that have moved and lamps that were lit are
    beyond one matrix, and half a change of light only disturbs what is carried from frame to frame.
    """
    if min(frame.size_px) < BLOCK_PX or _light_difference(frame, render) < NOTICEABLE_LEVELS:
        return ()
    found = solve(frame, render)
    costs = _Costs(frame, crf)
    adapted = _total(costs.of(adapt(render, found)))
    saved = _total(costs.of(render)) - adapted
    pays = saved > costs.price_of(PHOTOMETRIC_BITS) and adapted < GOOD_INTRA_RATIO * costs.intra
    return found if pays else ()


class _Costs:
    """D + lambda R of the blocks of one frame at one quality."""

    def __init__(self, frame: I420, crf: float) -> None:
        self._frame = frame
        self._step: float = 2 ** ((crf - 4) / 6)
        self._lambda: float = 0.57 * 2 ** ((crf - 12) / 3)
        self.index_cost = self.price_of(INDEX_BITS)

    def price_of(self, bits: float) -> float:
        """Return lambda times ``bits``."""
        return self._lambda * bits

    def of(self, reference: I420) -> Costs:
        """Return the cost of each block if it is predicted from ``reference`` as reference 0."""
        found = block_costs(self._frame.y, reference.y)
        ssd = found.ssd.astype(np.float64)
        distortion = np.minimum(ssd, BLOCK_PX**2 * self._step**2 / 12)
        bits = BLOCK_BITS + np.maximum(0, found.satd / self._step - DEAD_ZONE_SATD)
        return np.minimum(ssd, distortion + self._lambda * bits)

    @cached_property
    def intra(self) -> float:
        """The cost of the frame without any reference."""
        return _total(self.of(_block_means(self._frame)))


def _second(
    usable: Mapping[Reference, Costs], best: Reference, index_cost: float
) -> Reference | None:
    """Return the reference that saves most beside the best one, if it saves enough."""
    others = [reference for reference in usable if reference is not best]
    together: Callable[[Reference], float] = lambda reference: _total(  # noqa: E731
        np.minimum(usable[best], usable[reference] + index_cost)
    )
    second = min(others, key=together, default=None)
    if second is None or together(second) > (1 - MIN_SAVING) * _total(usable[best]):
        return None
    return second


def _total(costs: Costs) -> float:
    return float(costs.sum())


def _block_means(picture: I420) -> I420:
    """Return the picture with each whole 8x8 luma block at its mean."""
    height, width = (side // BLOCK_PX * BLOCK_PX for side in picture.y.shape)
    blocks = picture.y[:height, :width].reshape(height // BLOCK_PX, BLOCK_PX, width)
    down = blocks.sum(axis=1, dtype=np.uint16).reshape(height // BLOCK_PX, -1, BLOCK_PX)
    means = np.rint(down.sum(axis=2, dtype=np.uint16) / BLOCK_PX**2).astype(np.uint8)
    flat = picture.y.copy()
    flat[:height, :width] = means.repeat(BLOCK_PX, axis=1).repeat(BLOCK_PX, axis=0)
    return I420(flat, picture.u, picture.v)


def _light_difference(frame: I420, render: I420) -> float:
    """Return the median difference of 64 block means; what is not in the field moves few."""
    a, b = (np.frombuffer(block_mean_digest(p), np.uint8).astype(int) for p in (frame, render))
    return float(np.median(np.abs(a - b)))
