"""Turns by right angles and mirrorings of pictures, as EXIF and videos' display matrices say.

``Orientation`` has EXIF's numbers (CIPA DC-008, tag 0x0112). A matrix maps offsets from the middle
of the picture as it is stored to the picture as it is shown, x right and y down.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from enum import IntEnum
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Intrinsics, Pose
from rfcore.dataset.source import SourceCamera
from rfcore.errors import DatasetError
from rfcore.lens import BrownLens

Values = TypeVar("Values", bound=np.generic)
FIXED_POINT = 1 << 16

MATRICES = {
    1: ((1, 0), (0, 1)),
    2: ((-1, 0), (0, 1)),
    3: ((-1, 0), (0, -1)),
    4: ((1, 0), (0, -1)),
    5: ((0, 1), (1, 0)),
    6: ((0, -1), (1, 0)),
    7: ((0, -1), (-1, 0)),
    8: ((0, 1), (-1, 0)),
}
WORDS = {
    1: "upright",
    2: "mirrored",
    3: "turned by 180 degrees",
    4: "mirrored and turned by 180 degrees",
    5: "mirrored and turned by 90 degrees counter-clockwise",
    6: "turned by 90 degrees clockwise",
    7: "mirrored and turned by 90 degrees clockwise",
    8: "turned by 90 degrees counter-clockwise",
}


class Orientation(IntEnum):
    """The change from a picture as it is stored to the picture as it is shown."""

    UPRIGHT = 1
    MIRRORED = 2
    UPSIDE_DOWN = 3
    MIRRORED_UPSIDE_DOWN = 4
    MIRRORED_LEFT = 5
    RIGHT = 6
    MIRRORED_RIGHT = 7
    LEFT = 8

    @staticmethod
    def of_display_matrix(where: str, numbers: Sequence[int]) -> Orientation:
        """Return the orientation of FFmpeg's nine numbers (ISO/IEC 14496-12, 8.2.2).

        Raises ``DatasetError`` naming ``where`` for an angle that is not a right one.
        """
        a, b, _, c, d = (round(number / FIXED_POINT, 3) for number in numbers[:5])
        for number, matrix in MATRICES.items():
            if matrix == ((a, c), (b, d)):
                return Orientation(number)
        raise DatasetError(
            f"{where}: is to be shown by the matrix {a:g} {b:g} {c:g} {d:g}, which is no turn by "
            "90, 180 or 270 degrees"
        )

    @property
    def words(self) -> str:
        """The change in words, after "are"."""
        return WORDS[self]

    @property
    def swaps_sides(self) -> bool:
        """Whether width and height change places."""
        return self >= Orientation.MIRRORED_LEFT

    @property
    def mirrors(self) -> bool:
        """Whether left and right change places, which no turn of a camera does."""
        (a, b), (c, d) = MATRICES[self]
        return a * d - b * c < 0

    def size(self, size_px: tuple[int, int]) -> tuple[int, int]:
        """Return (width, height) as shown."""
        return size_px[::-1] if self.swaps_sides else size_px

    def shown(self, stored: NDArray[Values]) -> NDArray[Values]:
        """Return an array [H, W, ...] as shown."""
        (a, b), (c, d) = MATRICES[self]
        if self.swaps_sides:
            stored, a, d = stored.swapaxes(0, 1), b, c
        return np.ascontiguousarray(stored[::d, ::a])

    def camera(self, camera: SourceCamera) -> SourceCamera:
        """Return the camera of the picture as shown."""
        k, ((a, b), (c, d)) = camera.intrinsics, MATRICES[self]
        width_px, height_px = self.size((k.width_px, k.height_px))
        x, y = k.cx_px - k.width_px / 2, k.cy_px - k.height_px / 2
        focal_px = (k.fy_px, k.fx_px) if self.swaps_sides else (k.fx_px, k.fy_px)
        centre_px = (a * x + b * y + width_px / 2, c * x + d * y + height_px / 2)
        lens = camera.lens
        if isinstance(lens, BrownLens):
            turned: dict[str, float] = {}
            for along, down in (("p2", "p1"), ("s1", "s3"), ("s2", "s4")):
                x, y = getattr(lens, along), getattr(lens, down)
                turned |= {along: a * x + b * y, down: c * x + d * y}
            lens = replace(lens, **turned)
        return SourceCamera(Intrinsics(width_px, height_px, *focal_px, *centre_px), lens)

    @property
    def stored_from_shown(self) -> Pose:
        """The turn of the camera's axes, to be composed after world_from_cam as stored."""
        (a, b), (c, d) = MATRICES[self]
        return Pose.from_matrix([[a, c, 0, 0], [b, d, 0, 0], [0, 0, 1, 0]])
