"""What the sender decides about a frame before it codes it: references, and the render's light.

Both are decided by the estimate of D + lambda R that ``rfcore.codec.sender.frame_costs`` makes of
each 8x8 block. There is no motion in it: the pictures made from the field stand where the frame
stands. The previous frame does not, and the coder searches it: it is taken whenever there is one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rfcore.codec.block_means import block_mean_digest
from rfcore.codec.h264.config import DEFAULT_REFERENCES
from rfcore.codec.photometric import Photometric, adapt, solve
from rfcore.codec.prediction import Prediction
from rfcore.codec.references import INTRA, RENDER_ONLY, Reference, References
from rfcore.codec.sender.frame_costs import FrameCosts, RateDistortion
from rfcore.image import I420
from rfcore.native.warp import BLOCK_PX

__all__ = [
    "choose_photometric",
    "choose_references",
    "light_differs",
    "relighting_pays",
    "sending_light_pays",
]

INDEX_BITS = 1.0
"""What naming another reference than the first costs a block."""

USELESS_INTRA_RATIO = 1.2
"""Of the cost of intra prediction: beyond it no picture of the field helps. P slices can predict
blocks from their neighbours too, so a picture that helps a few blocks does no harm."""
MIN_SAVING = 0.002
"""Of the cost so far: another reference must save at least so much."""

GOOD_INTRA_RATIO = 0.9
"""Of the cost of intra prediction: what an adapted render must stay below. Where the light of a
whole street was changed it reaches 0.75, as in the right light; a field of noon at dusk 1.2."""

SENT_LIGHT_INTRA_RATIO = 1.15
"""Of the cost of intra prediction: up to which a light is sent. At dusk with a field of noon it is
0.94 to 1.05 for the yardstick's first frame, which takes 15 to 32 % fewer bits with the light, and
1.10 to 1.40 for one half way (7 to 18 %); with the field of another street 1.23 and more, and 4 to
16 % more bits."""

NOTICEABLE_LEVELS = 4
"""Median difference of block means from which a change of light is looked for. In a field's own
light it is 0 to 1 on the yardstick street and up to 2.5 on the sample drive with vehicles, where
from 2 levels on the frames that were relit took 2 to 4 % more bytes. Drifting exposure is 22 %
cheaper than with ``off`` from 4 levels on, 25 % from 2."""
PHOTOMETRIC_BITS = 12 * 16

Costs = NDArray[np.float64]


def choose_references(
    costs: FrameCosts, prediction: Prediction, crf: float, max_references: int = DEFAULT_REFERENCES
) -> References:
    """Return at most ``max_references`` references for a frame, the most useful last.

    That is the render or the correction. The previous frame comes next, then the other one; the
    warp only as a fourth (0.4 and 0.9 % fewer bits, a seventh more of the sender's time on the
    sample drives). It is never last: what skipped blocks copy from it drifts from frame to frame.

    Under the light of the frame before the usual three become four: what the field does not show is
    in earlier frames alone (2.2 % fewer bits on the yardstick's dusk with a field of noon).
    """
    if prediction.learns_light and max_references == DEFAULT_REFERENCES:
        max_references += 1
    if min(costs.frame.size_px) < BLOCK_PX:
        return RENDER_ONLY
    at_crf = RateDistortion.at(crf)
    usable = _usable(costs, prediction, at_crf)
    has_past = Reference.PREVIOUS in prediction.available
    best = min(usable, key=lambda reference: _total(usable[reference]))
    intra = _total(at_crf.coded_or_copied(costs.intra))
    if _total(usable[best]) > USELESS_INTRA_RATIO * intra:
        return (Reference.PREVIOUS,) if has_past else INTRA
    others = [reference for reference in usable if reference is not best]
    index_cost = at_crf.bit_price * INDEX_BITS
    helpful = [r for r in others if _saves(usable[best], usable[r] + index_cost)]
    beside = [Reference.PREVIOUS, *helpful] if has_past else []
    if has_past and max_references > DEFAULT_REFERENCES:
        beside.append(Reference.WARP)
    return (*_in_order(beside[: max_references - 1]), best)


def _usable(
    costs: FrameCosts, prediction: Prediction, at_crf: RateDistortion
) -> dict[Reference, Costs]:
    """Return the costs of the blocks against the pictures that may be reference 0."""
    usable = {Reference.RENDER: at_crf.coded_or_copied(costs.against(prediction.render))}
    if Reference.CORRECTION in prediction.available:
        found = costs.against(prediction.correction)
        usable[Reference.CORRECTION] = at_crf.coded_or_copied(found)
    return usable


def _saves(best: Costs, other: Costs) -> bool:
    return _total(np.minimum(best, other)) < (1 - MIN_SAVING) * _total(best)


def _in_order(references: Sequence[Reference]) -> list[Reference]:
    """Return them as they are fed: the warp before the field's other picture."""
    order = (Reference.PREVIOUS, Reference.WARP, Reference.RENDER, Reference.CORRECTION)
    return [reference for reference in order if reference in references]


def light_differs(frame: I420, render: I420) -> bool:
    """Tell whether a change of the render's light is worth looking for."""
    is_large_enough = min(frame.size_px) >= BLOCK_PX
    return is_large_enough and _light_difference(frame, render) >= NOTICEABLE_LEVELS


def choose_photometric(costs: FrameCosts, render: I420, crf: float) -> Photometric:
    """Return how the render's light is to be changed, if that saves more than it costs to say.

    It must make a good reference of the render: shadows that have moved and lamps that were lit are
    beyond one matrix, and half a change of light only disturbs what is carried from frame to frame.
    """
    found = solve(costs.frame, render)
    at_crf = RateDistortion.at(crf)
    as_it_is, adapted, intra = _totals(costs, render, adapt(render, found), at_crf)
    pays = as_it_is - adapted > at_crf.bit_price * PHOTOMETRIC_BITS
    return found if pays and adapted < GOOD_INTRA_RATIO * intra else ()


def relighting_pays(costs: FrameCosts, render: I420, relit: I420, crf: float) -> bool:
    """Tell whether the relit render makes blocks noticeably cheaper; to say so costs next to
    nothing.

    It must beat intra prediction: of a field that does not show what is there the grid makes a
    blurred copy of the earlier frame, which is a reference already. At dusk with a field of noon
    the cost is 0.86 to 0.93 of intra prediction's, from a wrong pose 1.14 and more.
    """
    as_it_is, adapted, intra = _totals(costs, render, relit, RateDistortion.at(crf))
    return adapted < min((1 - MIN_SAVING) * as_it_is, intra)


def sending_light_pays(
    costs: FrameCosts, changed: Prediction, relit: Prediction, crf: float
) -> bool:
    """Tell whether the light of ``relit``, which is sent, makes the first frame of a stream cheaper
    than it is with ``changed``: by a matrix, or not at all."""
    at_crf = RateDistortion.at(crf)
    as_it_is, in_light, intra = _totals(costs, changed.render, relit.render, at_crf)
    told = at_crf.bit_price * (8 * len(relit.light) - PHOTOMETRIC_BITS * bool(changed.photometric))
    return in_light + told < min(as_it_is, SENT_LIGHT_INTRA_RATIO * intra)


def _totals(
    costs: FrameCosts, render: I420, adapted: I420, at_crf: RateDistortion
) -> tuple[float, float, float]:
    """Return what all blocks cost against the render as it is, in another light, and intra."""
    as_it_is, in_light, intra = (
        _total(at_crf.coded_or_copied(blocks))
        for blocks in (costs.against(render), costs.against(adapted), costs.intra)
    )
    return as_it_is, in_light, intra


def _total(costs: Costs) -> float:
    return float(costs.sum())


def _light_difference(frame: I420, render: I420) -> float:
    """Return the median difference of 64 block means; what is not in the field moves few."""
    a, b = (np.frombuffer(block_mean_digest(p), np.uint8).astype(int) for p in (frame, render))
    return float(np.median(np.abs(a - b)))
