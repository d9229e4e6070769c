"""The local structure of a picture: its luma less its blur, divided by the local contrast.

What is coarser than a few pixels is lighting, and contrast depends on exposure. A comparison of a
picture with a render should depend on neither.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rfcore.extras import needs

with needs("localise"):
    import cv2

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]

COARSEST_PX = 45
"""Shortest side of the coarsest level of any pyramid, at the least."""
MEAN_PX = 9
CONTRAST_PX = 17
"""Squares over which mean and contrast are taken: box filters, which cost the same at any size."""
LEAST_CONTRAST = np.float32(2)
"""Levels added to the local contrast, so that noise of flat places has little weight."""


def structure(luma: U8) -> F32:
    """Return the local structure float32 [H, W] of luma uint8 [H, W], about -2..2."""
    plane = luma.astype(np.float32)
    fine = cv2.subtract(plane, cv2.blur(plane, (MEAN_PX, MEAN_PX)))
    contrast = cv2.blur(np.abs(fine), (CONTRAST_PX, CONTRAST_PX)) + LEAST_CONTRAST
    return np.asarray(cv2.divide(fine, contrast), np.float32)


def halved(luma: U8) -> U8:
    """Return luma at half the resolution: means of 2x2 pixels, an odd last row or column left."""
    height, width = (side // 2 for side in luma.shape)
    even = np.ascontiguousarray(luma[: 2 * height, : 2 * width])
    return np.asarray(cv2.resize(even, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


class Pyramid:
    """The structures of luma [H, W] and of its halves, finest first, to the coarsest.

    Each is made when it is first asked for: the finest takes ten times as long as all the others,
    and need not take part. Half the resolution is always there: poses are checked at it.
    """

    def __init__(self, luma: U8) -> None:
        self._lumas = [luma]
        self._made: dict[int, F32] = {}
        while len(self._lumas) == 1 or min(luma.shape) >= 2 * COARSEST_PX:
            luma = halved(luma)
            self._lumas.append(luma)

    def __len__(self) -> int:
        """Return the number of levels."""
        return len(self._lumas)

    @property
    def made(self) -> set[int]:
        """The levels that were asked for so far."""
        return set(self._made)

    def __getitem__(self, number: int) -> F32:
        """Return the structure of one level; raise ``IndexError`` beyond the coarsest."""
        if number not in self._made:
            self._made[number] = structure(self._lumas[number])
        return self._made[number]
