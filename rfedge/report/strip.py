"""Pictures side by side in a page, and how two of them differ."""

from __future__ import annotations

import base64
from collections.abc import Iterable

import numpy as np

from rfcore.image import Rgb, jpeg_bytes

__all__ = ["DIFFERENCE_GAIN", "amplified_difference", "embedded"]

DIFFERENCE_GAIN = 4


def amplified_difference(shown: Rgb, camera: Rgb) -> Rgb:
    """Return the absolute difference times ``DIFFERENCE_GAIN``, uint8 [H, W, 3]."""
    difference = np.abs(shown.astype(np.int16) - camera)
    return np.asarray(np.minimum(difference * DIFFERENCE_GAIN, 255), dtype=np.uint8)


def embedded(captions: Iterable[tuple[str, Rgb]]) -> list[dict[str, str]]:
    """Return captions, and pictures as the text of a JPEG's data URI."""
    return [
        {"caption": caption, "data": base64.b64encode(jpeg_bytes(rgb)).decode()}
        for caption, rgb in captions
    ]
