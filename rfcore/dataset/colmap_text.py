"""COLMAP's text model: ``cameras.txt``, ``images.txt``, ``points3D.txt``.

Lines that start with ``#`` are comments. An image takes two lines; the second, its 2D points, may
be empty and is skipped.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rfcore.dataset.colmap_model import ColmapImage, ColmapModel, camera_of, image_of
from rfcore.dataset.keys import finite_numbers, text_lines
from rfcore.dataset.source import SourceCamera, SourcePoints
from rfcore.errors import DatasetError

__all__ = ["read_text_model"]


def read_text_model(folder: Path) -> ColmapModel:
    """Read a text model. Raises ``DatasetError`` naming the file and the line."""
    return ColmapModel(
        cameras=dict(_cameras(folder / "cameras.txt")),
        images=tuple(_images(folder / "images.txt")),
        points=_points(folder / "points3D.txt"),
    )


def _rows(file: Path, at_least: int) -> Iterator[tuple[str, list[str]]]:
    """Yield the place and the words of every line that is not a comment."""
    for i, line in enumerate(text_lines(file), start=1):
        words = line.split()
        if words and not words[0].startswith("#"):
            yield _checked(f"{file}: line {i}", words, at_least)


def _checked(where: str, words: list[str], at_least: int) -> tuple[str, list[str]]:
    if len(words) < at_least:
        raise DatasetError(f"{where}: has {len(words)} values, at least {at_least} are needed")
    return where, words


def _cameras(file: Path) -> Iterator[tuple[int, SourceCamera]]:
    for where, words in _rows(file, 4):
        size_px = (_whole(where, words[2]), _whole(where, words[3]))
        parameters = finite_numbers(where, words[4:])
        yield _whole(where, words[0]), camera_of(where, words[1], size_px, parameters)


def _images(file: Path) -> Iterator[ColmapImage]:
    lines = iter(enumerate(text_lines(file), start=1))
    for i, line in lines:
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        where, words = _checked(f"{file}: line {i}", line.split(maxsplit=9), 10)
        numbers = finite_numbers(where, words[1:8])
        yield image_of(where, words[9].strip(), _whole(where, words[8]), numbers)
        next(lines, None)


def _points(file: Path) -> SourcePoints | None:
    if not file.is_file():
        return None
    rows = [finite_numbers(where, words[1:7]) for where, words in _rows(file, 8)]
    if not rows:
        return None
    table = np.array(rows)
    if (table[:, 3:] < 0).any() or (table[:, 3:] > 255).any():
        raise DatasetError(f"{file}: a point's colour is outside 0..255")
    return SourcePoints(np.ascontiguousarray(table[:, :3]), table[:, 3:].astype(np.uint8))


def _whole(where: str, word: str) -> int:
    if not word.isascii() or not word.isdigit():
        raise DatasetError(f"{where}: '{word}' is not a whole number")
    return int(word[:20])
