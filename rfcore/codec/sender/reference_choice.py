"""Decides before a frame is coded which references it has, and under which light its render is.

Both decisions rest on the estimate of D + lambda R that ``rfcore.codec.sender.rate`` makes
for each 8x8 block. It includes no motion: pictures made from the field are aligned with the frame.
The previous frame is not, but the coder searches motion in it, so it is taken whenever there is
one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rfcore.codec.h264.config import DEFAULT_REFERENCES, REFERENCE_FRAMES
from rfcore.codec.packet import median_block_mean_difference
from rfcore.codec.photometric import Photometric, adapt, solve
from rfcore.codec.prediction import Prediction
from rfcore.codec.references import INTRA, RENDER_ONLY, Reference, References
from rfcore.codec.sender.rate import FrameCosts, RateDistortion
from rfcore.image import I420
from rfcore.native.warp import BLOCK_PX

INDEX_BITS = 1.0
"""Bits that a block pays for another reference than the first."""

MEAN_BITS = 6.0
"""Bits that intra prediction of a block pays for its mean. Without them a hazy street seemed
cheaper without its field: in rain, at 32 to 35 dB, frames took four times the bits. Where the field
is of another street, 10 are too many."""

USELESS_INTRA_RATIO = 1.2
"""A picture that costs more than this share of intra prediction does not help. P slices can also
predict blocks from their neighbours, so a picture that helps a few blocks does no harm."""
MIN_SAVING = 0.002
"""Share of the cost so far that another reference must save."""

GOOD_INTRA_RATIO = 0.9
"""An adapted render must cost less than this share of intra prediction. It costs 0.75 where the
light of a whole street was changed, as much as in the right light, and 1.2 with a field of noon at
dusk."""

SENT_LIGHT_INTRA_RATIO = 1.15
"""A light is sent if the render then costs less than this share of intra prediction. At dusk with a
field of noon the share is 0.94 to 1.05 for the benchmark street's first frame, which takes 15 to
32 % fewer bits with the light, and 1.10 to 1.40 for a frame half way (7 to 18 %); with the field of
another street it is 1.23 and more, and frames take 4 to 16 % more bits."""

NOTICEABLE_LEVELS = 4
"""Median difference of block means above which a change of light is looked for. In a field's own
light it is 0 to 1 on the benchmark street and up to 2.5 on the sample drive with vehicles, where
with a threshold of 2 levels relit frames took 2 to 4 % more bytes. Frames of drifting exposure take
22 % fewer bytes than without a change of light; with a threshold of 2 levels 25 % fewer."""
PHOTOMETRIC_BITS = 12 * 16

Costs = NDArray[np.float64]


def choose_references(
    costs: FrameCosts,
    prediction: Prediction,
    crf: float,
    max_references: int = DEFAULT_REFERENCES,
    most: int = REFERENCE_FRAMES,
) -> References:
    """Return at most ``max_references`` references for a frame, the most useful last.

    The most useful is the render or the correction. The previous frame comes next, then the other
    one of the two; the warp only as a fourth (0.4 and 0.9 % fewer bits on the sample drives for a
    seventh more of the sender's time). The warp is never last: skipped blocks that copy it drift
    from frame to frame.

    Under the light of the frame before, four are taken instead of three, since only earlier frames
    show what the field does not (2.2 % fewer bits on the benchmark street at dusk with a field of
    noon). ``most``: those that the stream's coder takes.
    """
    if prediction.learns_light and max_references == DEFAULT_REFERENCES:
        max_references += 1
    if min(costs.frame.size_px) < BLOCK_PX:
        return RENDER_ONLY
    at_crf = RateDistortion.at(crf)
    usable = _usable(costs, prediction, at_crf)
    has_past = Reference.PREVIOUS in prediction.available
    best = min(usable, key=lambda reference: _total(usable[reference]))
    intra = _intra_total(costs, at_crf)
    if _total(usable[best]) > USELESS_INTRA_RATIO * intra:
        return (Reference.PREVIOUS,) if has_past else INTRA
    others = [reference for reference in usable if reference is not best]
    index_cost = at_crf.bit_price * INDEX_BITS
    helpful = [r for r in others if _saves(usable[best], usable[r] + index_cost)]
    beside = [Reference.PREVIOUS, *helpful] if has_past else []
    if has_past and max_references > DEFAULT_REFERENCES:
        beside.append(Reference.WARP)
    return (*_in_order(beside[: min(max_references, most) - 1]), best)


def _usable(
    costs: FrameCosts, prediction: Prediction, at_crf: RateDistortion
) -> dict[Reference, Costs]:
    """Return the costs of the blocks for each picture that may be reference 0."""
    usable = {Reference.RENDER: at_crf.coded_or_copied(costs.against(prediction.render))}
    if Reference.CORRECTION in prediction.available:
        found = costs.against(prediction.correction)
        usable[Reference.CORRECTION] = at_crf.coded_or_copied(found)
    return usable


def _saves(best: Costs, other: Costs) -> bool:
    return _total(np.minimum(best, other)) < (1 - MIN_SAVING) * _total(best)


def _in_order(references: Sequence[Reference]) -> list[Reference]:
    """Return the references in the order in which they are fed to the decoder."""
    order = (Reference.PREVIOUS, Reference.WARP, Reference.RENDER, Reference.CORRECTION)
    return [reference for reference in order if reference in references]


def light_differs(frame: I420, render: I420) -> bool:
    """Return whether a change of the render's light is worth looking for."""
    is_large_enough = min(frame.size_px) >= BLOCK_PX
    return is_large_enough and median_block_mean_difference(frame, render) >= NOTICEABLE_LEVELS


def choose_photometric(costs: FrameCosts, render: I420, crf: float) -> Photometric:
    """Return the matrix for the render's light, if it saves more bits than it takes; else nothing.

    The adapted render must be a good reference. One matrix cannot describe moved shadows or lit
    lamps, and half a change of light only disturbs what is carried from frame to frame.
    """
    found = solve(costs.frame, render)
    at_crf = RateDistortion.at(crf)
    as_it_is, adapted, intra = _totals(costs, render, adapt(render, found), at_crf)
    pays = as_it_is - adapted > at_crf.bit_price * PHOTOMETRIC_BITS
    return found if pays and adapted < GOOD_INTRA_RATIO * intra else ()


def relighting_pays(costs: FrameCosts, render: I420, relit: I420, crf: float) -> bool:
    """Return whether the relit render makes blocks noticeably cheaper; signalling it is nearly
    free.

    It must beat intra prediction: if the field does not show what is there, relighting gives a
    blurred copy of the earlier frame, which is a reference already. At dusk with a field of noon
    the cost is 0.86 to 0.93 of intra prediction's; with a wrong pose it is 1.14 and more.
    """
    as_it_is, adapted, intra = _totals(costs, render, relit, RateDistortion.at(crf))
    return adapted < min((1 - MIN_SAVING) * as_it_is, intra)


def sending_light_pays(
    costs: FrameCosts, changed: Prediction, relit: Prediction, crf: float
) -> bool:
    """Return whether sending the light of ``relit`` makes the first frame of a stream cheaper than
    ``changed``, whose light is changed by a matrix or not at all."""
    at_crf = RateDistortion.at(crf)
    as_it_is, in_light, intra = _totals(costs, changed.render, relit.render, at_crf)
    told = at_crf.bit_price * (8 * len(relit.light) - PHOTOMETRIC_BITS * bool(changed.photometric))
    return in_light + told < min(as_it_is, SENT_LIGHT_INTRA_RATIO * intra)


def _totals(
    costs: FrameCosts, render: I420, adapted: I420, at_crf: RateDistortion
) -> tuple[float, float, float]:
    """Return the cost of all blocks with the plain render, with the adapted one, and intra."""
    as_it_is, in_light = (
        _total(at_crf.coded_or_copied(costs.against(picture))) for picture in (render, adapted)
    )
    return as_it_is, in_light, _intra_total(costs, at_crf)


def _intra_total(costs: FrameCosts, at_crf: RateDistortion) -> float:
    """Return the cost of all blocks when each is predicted from its own mean, which is sent."""
    blocks = at_crf.coded_or_copied(costs.intra)
    return _total(blocks + at_crf.bit_price * MEAN_BITS)


def _total(costs: Costs) -> float:
    return float(costs.sum())
