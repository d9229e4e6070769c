"""What the sender decides about a frame before it codes it: references, and the render's light.

Both are decided by the estimate of D + lambda R that ``rfcore.codec.sender.frame_costs`` makes of
each 8x8 block. There is no motion in it: the pictures made from the field stand where the frame
stands. The previous frame does not, and x264 looks for it; it is taken along whenever there is one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from rfcore.codec.block_means import block_mean_digest
from rfcore.codec.photometric import Photometric, adapt, solve
from rfcore.codec.prediction import Prediction
from rfcore.codec.references import INTRA, RENDER_ONLY, Reference, References
from rfcore.codec.sender.frame_costs import FrameCosts, RateDistortion
from rfcore.image import I420
from rfcore.native.warp import BLOCK_PX

__all__ = ["choose_photometric", "choose_references"]

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


def choose_references(
    costs: FrameCosts, prediction: Prediction, crf: float, max_references: int = 3
) -> References:
    """Return at most ``max_references`` references for a frame, the most useful last."""
    if min(costs.frame.size_px) < BLOCK_PX:
        return RENDER_ONLY
    at_crf = RateDistortion.at(crf)
    usable, intra = _usable(costs, prediction, at_crf)
    has_past = Reference.PREVIOUS in prediction.available
    best = min(usable, key=lambda reference: _total(usable[reference]))
    if _total(usable[best]) > USELESS_INTRA_RATIO * intra:
        return (Reference.PREVIOUS,) if has_past else INTRA
    room = max_references - 1 - has_past
    chosen = [best]
    second = _second(usable, best, at_crf.bit_price * INDEX_BITS) if room > 0 else None
    if second is not None:
        chosen.insert(0, second)
    if has_past and max_references > 1:
        chosen.insert(0, Reference.PREVIOUS)
    return tuple(chosen)


def _usable(
    costs: FrameCosts, prediction: Prediction, at_crf: RateDistortion
) -> tuple[dict[Reference, Costs], float]:
    """Return the costs of the blocks by reference, and of the whole frame without any."""
    usable = {Reference.RENDER: at_crf.coded_or_copied(costs.against(prediction.render))}
    intra = _total(at_crf.coded_or_copied(costs.intra))
    if Reference.CORRECTION in prediction.available:
        found = costs.against(prediction.correction)
        usable[Reference.CORRECTION] = at_crf.coded_or_copied(found)
        if min(map(_total, usable.values())) > POOR_INTRA_RATIO * intra:
            usable[Reference.WARP] = at_crf.coded_or_copied(costs.against(prediction.warp))
    return usable, intra


def choose_photometric(costs: FrameCosts, render: I420, crf: float) -> Photometric:
    """Return how the render's light is to be changed, if that saves more than it costs to say.

    It must make a good reference of the render: shadows that have moved and lamps that were lit are
    beyond one matrix, and half a change of light only disturbs what is carried from frame to frame.
    """
    frame = costs.frame
    if min(frame.size_px) < BLOCK_PX or _light_difference(frame, render) < NOTICEABLE_LEVELS:
        return ()
    found = solve(frame, render)
    at_crf = RateDistortion.at(crf)
    as_it_is, adapted, intra = (
        _total(at_crf.coded_or_copied(blocks))
        for blocks in (costs.against(render), costs.against(adapt(render, found)), costs.intra)
    )
    pays = as_it_is - adapted > at_crf.bit_price * PHOTOMETRIC_BITS
    return found if pays and adapted < GOOD_INTRA_RATIO * intra else ()


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


def _light_difference(frame: I420, render: I420) -> float:
    """Return the median difference of 64 block means; what is not in the field moves few."""
    a, b = (np.frombuffer(block_mean_digest(p), np.uint8).astype(int) for p in (frame, render))
    return float(np.median(np.abs(a - b)))
