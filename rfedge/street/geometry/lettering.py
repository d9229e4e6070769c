"""Letters on signs, plates and boards: texts stacked into one texture, one row each."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from rfedge.street.geometry.mesh import F32, Texture

__all__ = ["Lettered", "atlas", "atlas_uv", "board"]

FONTS = (cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_TRIPLEX, cv2.FONT_HERSHEY_SIMPLEX)
Grey = tuple[int, int, int]


@dataclass(frozen=True)
class Lettered:
    """A text in sRGB colours (0..255), bordered or not."""

    text: str
    ink: Grey
    paper: Grey
    font: int = 0
    border: bool = True


def board(lettered: Lettered, size_px: tuple[int, int]) -> Texture:
    """Return a picture (width, height) filled with a text as large as fits; lines by ``\\n``."""
    width, height = size_px
    picture = np.empty((height, width, 3), np.uint8)
    picture[:] = lettered.paper
    lines = lettered.text.split("\n")
    room = height / len(lines)
    for i, line in enumerate(lines):
        _write(picture, line, lettered, (width, room), i * room)
    if lettered.border:
        edge = max(height // 40, 2)
        cv2.rectangle(
            picture, (edge, edge), (width - 1 - edge, height - 1 - edge), lettered.ink, edge
        )
    return picture


def atlas(rows: tuple[Lettered, ...], size_px: tuple[int, int]) -> Texture:
    """Return boards of one size below each other."""
    return np.concatenate([board(row, size_px) for row in rows])


def atlas_uv(rows: int, row: int) -> F32:
    """Return the corners [4, 2] of a row, anticlockwise from the lower left, half a row's edge in.

    The margin keeps neighbouring rows out of bilinear filters.
    """
    margin = 0.01 / rows
    low, high = (row % rows + 1) / rows - margin, (row % rows) / rows + margin
    return np.array([[0.004, low], [0.996, low], [0.996, high], [0.004, high]], np.float32)


def _write(
    picture: Texture, line: str, lettered: Lettered, room: tuple[float, float], top: float
) -> None:
    """Centre a line in its room, as large as 0.86 of the width and 0.62 of the height allow."""
    font = FONTS[lettered.font % len(FONTS)]
    (wide, high), _ = cv2.getTextSize(line, font, 1.0, 2)
    scale = min(0.86 * room[0] / max(wide, 1), 0.62 * room[1] / max(high, 1))
    thick = max(round(2.4 * scale), 1)
    (wide, high), _ = cv2.getTextSize(line, font, scale, thick)
    place = (int((room[0] - wide) / 2), int(top + (room[1] + high) / 2))
    cv2.putText(picture, line, place, font, scale, lettered.ink, thick, cv2.LINE_AA)
