"""What was measured for sizing an uplink: a cell for each codec, size of picture and rate.

A cell's curve is bytes a frame over luma PSNR on a grid of half decibels, without the first frame,
with the 95 % interval that resampling the frames gives. Between cells and grid points logarithms
are interpolated (``rfedge.sizing.interpolate``). The tables that ship are the result file
``tables.json`` beside this module, made by ``rfedge eval sizing``.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rfcore.errors import InvalidInput
from rfedge.results import read_result, rows_of

__all__ = ["CODECS", "SHIPPED", "SizingCell", "SizingTables", "read_tables", "shipped_tables"]

KIND = "sizing"
SHIPPED = Path(__file__).with_name("tables.json")
CODECS = ("rfedge", "x264", "x265", "svtav1")
"""Ours at the default effort; rivals for low delay, tuned for PSNR where they can be."""


@dataclass(frozen=True)
class SizingCell:
    """One codec at one size and rate.

    ``psnr_db`` ascends; ``bytes_per_frame`` and its 95 % interval ``low_bytes`` .. ``high_bytes``
    belong to it, [N] each. ``frame_ratios``: bytes of each frame over their mean, in order of time,
    near 34 dB; ``sender_ms`` and ``receiver_ms``: processor time a frame there, renders included.
    """

    codec: str
    width_px: int
    height_px: int
    hz: float
    frames: int
    psnr_db: Sequence[float]
    bytes_per_frame: Sequence[float]
    low_bytes: Sequence[float]
    high_bytes: Sequence[float]
    frame_ratios: Sequence[float]
    sender_ms: float
    receiver_ms: float

    @property
    def pixels(self) -> int:
        """Of one picture."""
        return self.width_px * self.height_px

    def log_bytes(self, psnr_db: float, column: str = "bytes_per_frame") -> float:
        """Return the logarithm of a column at a quality, beyond the grid by its last slope."""
        return interpolated(self.psnr_db, [math.log(n) for n in getattr(self, column)], psnr_db)


@dataclass(frozen=True)
class SizingTables:
    """All cells, and in words what they were measured on."""

    cells: tuple[SizingCell, ...]
    measured_on: str

    def of(self, codec: str) -> tuple[SizingCell, ...]:
        """Return the cells of one codec; raise ``InvalidInput`` if there are none."""
        found = tuple(cell for cell in self.cells if cell.codec == codec)
        if not found:
            raise InvalidInput("codec", f"{codec!r} was not measured: {', '.join(self.codecs)}")
        return found

    @property
    def codecs(self) -> tuple[str, ...]:
        """The codecs there are, in the order of ``CODECS``."""
        there = {cell.codec for cell in self.cells}
        return tuple(codec for codec in CODECS if codec in there)


def read_tables(path: Path) -> SizingTables:
    """Read a result of ``rfedge eval sizing``; raise ``InvalidInput`` for another file."""
    result = read_result(path, KIND)
    return SizingTables(tuple(rows_of(SizingCell, result["cells"])), str(result["measured_on"]))


def shipped_tables() -> SizingTables:
    """Return the tables that come with the package."""
    return read_tables(SHIPPED)


def interpolated(xs: Sequence[float], ys: Sequence[float], x: float) -> float:
    """Return y at x, linearly between points and by the end slopes beyond; ``xs`` ascend."""
    if len(xs) == 1:
        return ys[0]
    right = min(max(bisect_left(xs, x), 1), len(xs) - 1)
    x0, x1, y0, y1 = xs[right - 1], xs[right], ys[right - 1], ys[right]
    return y0 + (y1 - y0) * (x - x0) / (x1 - x0)
