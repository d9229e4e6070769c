"""How well a field shows pictures it was not trained on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput
from rfcore.field import RadianceField
from rfcore.metrics import psnr, ssim
from rfcore.train.protocol import HeldOut
from rfcore.views import PosedPicture

__all__ = ["held_out_quality", "mean_psnr_db"]


def mean_psnr_db(field: RadianceField, pictures: Sequence[PosedPicture]) -> float:
    """Return the mean over pictures of the RGB PSNR of the field's view, clipped to 0..1."""
    _check(pictures)
    return float(np.mean([psnr(*_pair(field, p), peak=1.0) for p in pictures]))


def held_out_quality(field: RadianceField, pictures: Sequence[PosedPicture]) -> HeldOut:
    """Return the means over pictures of RGB PSNR and SSIM of the field's view."""
    _check(pictures)
    pairs = [_pair(field, picture) for picture in pictures]
    return HeldOut(
        psnr_db=float(np.mean([psnr(*pair, peak=1.0) for pair in pairs])),
        ssim=float(np.mean([ssim(*pair, peak=1.0) for pair in pairs])),
    )


def _check(pictures: Sequence[PosedPicture]) -> None:
    if not pictures:
        raise InvalidInput("pictures", "at least one is needed to measure a field")


def _pair(
    field: RadianceField, picture: PosedPicture
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    colour = np.clip(field.render_colour(picture.camera).astype(np.float64), 0.0, 1.0)
    return colour, picture.read() / 255.0
