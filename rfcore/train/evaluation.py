"""How well a field shows pictures it was not trained on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rfcore.errors import InvalidInput
from rfcore.field import RadianceField
from rfcore.metrics import psnr
from rfcore.views import PosedPicture

__all__ = ["mean_psnr_db"]


def mean_psnr_db(field: RadianceField, pictures: Sequence[PosedPicture]) -> float:
    """Return the mean over pictures of the RGB PSNR of the field's view, clipped to 0..1."""
    if not pictures:
        raise InvalidInput("pictures", "at least one is needed to measure a field")
    return float(np.mean([_psnr_db(field, picture) for picture in pictures]))


def _psnr_db(field: RadianceField, picture: PosedPicture) -> float:
    colour = np.clip(field.render_colour(picture.camera).astype(np.float64), 0.0, 1.0)
    return psnr(colour, picture.read() / 255.0, peak=1.0)
