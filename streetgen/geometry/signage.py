"""Paint signs as textures: lettering on plates and boards, and the faces of traffic signs.

Pictures of one kind are stacked into one texture, one row each (``atlas``, ``atlas_uv``).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from streetgen.geometry.mesh import F32, Material, Texture

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


WHITE, BLACK, RED, BLUE = (
    (244, 244, 240),
    (22, 22, 24),
    (196, 24, 30),
    (18, 74, 160),
)
FACES = ("30", "P", "50", "no parking", "give way", "ZONE\n30", "bus", "crossing", "dead end")
NAMES = ("Linden Road", "Station Road", "Mill Lane", "Harbour St", "Museum Sq", "Abbey Walk")
ROUND = ("30", "50", "no parking")
SIDE_PX = 256


def face_uv(face: int) -> F32:
    """Return the corners [4, 2] of a face in the texture of all."""
    return atlas_uv(len(FACES), face)


def name_uv(name: int) -> F32:
    """Return the corners [4, 2] of a street's name in the texture of all."""
    return atlas_uv(len(NAMES), name)


@lru_cache(maxsize=1)
def sign_materials() -> tuple[Material, ...]:
    """Return what signs and lights are made of; the same objects at each call."""
    names = tuple(Lettered(text, WHITE, BLUE, font=0) for text in NAMES)
    lit = {"signal red": (1.0, 0.03, 0.02), "signal amber": (1.0, 0.45, 0.02)}
    lit["signal green"] = (0.03, 0.9, 0.35)
    return (
        Material("sign post", (0.46, 0.47, 0.48), roughness=0.4, metallic=0.85),
        Material("sign back", (0.42, 0.43, 0.44), roughness=0.5, metallic=0.6),
        Material("sign face", np.concatenate([face_picture(text) for text in FACES], axis=0)),
        Material("street name", atlas(names, (640, 128)), roughness=0.5),
        Material("signal case", (0.018, 0.02, 0.019), roughness=0.5),
        *(Material(name, colour, gloss=True) for name, colour in lit.items()),
        *(
            Material(f"{name} off", tuple(0.12 * c for c in colour), gloss=True)  # type: ignore[arg-type]
            for name, colour in lit.items()
        ),
    )


def face_picture(text: str) -> Texture:
    """Return the square picture of a face by its text or meaning."""
    painters = {
        "no parking": _no_parking,
        "give way": _give_way,
        "crossing": _crossing,
        "dead end": _dead_end,
    }
    if text in painters:
        return painters[text]()
    if text in ("P", "bus"):
        return board(Lettered(text.upper(), WHITE, BLUE), (SIDE_PX, SIDE_PX))
    if "\n" in text:
        return board(Lettered(text, BLACK, WHITE), (SIDE_PX, SIDE_PX))
    return _limit(text)


def _limit(text: str) -> Texture:
    """Paint a speed limit: black figures in a red ring."""
    picture = board(Lettered(text, BLACK, WHITE, border=False), (SIDE_PX, SIDE_PX))
    return _ringed(picture)


def _no_parking() -> Texture:
    picture = _ringed(_plain(BLUE))
    cv2.line(picture, (56, 56), (200, 200), RED, 26, cv2.LINE_AA)
    return picture


def _ringed(picture: Texture) -> Texture:
    cv2.circle(picture, (128, 128), 112, RED, 30, cv2.LINE_AA)
    outside = np.hypot(*np.mgrid[-127.5:128, -127.5:128]) > 126
    picture[outside] = WHITE
    return picture


def _give_way() -> Texture:
    picture = _plain(WHITE)
    corners = np.array([[12, 24], [244, 24], [128, 236]])
    cv2.polylines(picture, [corners], True, RED, 30, cv2.LINE_AA)
    return picture


def _crossing() -> Texture:
    """Paint a walker on stripes in a triangle on blue."""
    picture = _plain(BLUE)
    cv2.fillPoly(picture, [np.array([[128, 26], [232, 222], [24, 222]])], WHITE, cv2.LINE_AA)
    cv2.circle(picture, (132, 92), 13, BLACK, -1, cv2.LINE_AA)
    for start, end in (
        ((130, 106), (124, 156)),
        ((124, 156), (102, 200)),
        ((124, 156), (152, 200)),
        ((128, 116), (100, 144)),
        ((128, 116), (158, 140)),
    ):
        cv2.line(picture, start, end, BLACK, 11, cv2.LINE_AA)
    for left in (52, 92, 132, 172):
        cv2.rectangle(picture, (left, 206), (left + 22, 216), BLACK, -1)
    return picture


def _dead_end() -> Texture:
    picture = _plain(BLUE)
    cv2.rectangle(picture, (110, 90), (146, 230), WHITE, -1)
    cv2.rectangle(picture, (64, 52), (192, 92), RED, -1)
    cv2.rectangle(picture, (6, 6), (249, 249), WHITE, 4)
    return picture


def _plain(colour: tuple[int, int, int]) -> Texture:
    picture = np.empty((SIDE_PX, SIDE_PX, 3), np.uint8)
    picture[:] = colour
    return picture
