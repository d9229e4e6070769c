"""Between and a little beyond the measured cells: bytes and times at any size, rate and quality.

Logarithms are interpolated linearly: over decibels within a cell, over log(Hz) between cells of one
size, over log(pixels) between sizes. At a size that was measured at fewer rates than another, the
effect of the rate beyond them is taken from the size with the widest range. How far outside the
measured ranges a figure may be asked for is ``MAX_BEYOND_FACTOR`` (pixels, rate) and
``MAX_BEYOND_DB``; tables of one cell, as of a user's own drive, allow its size and rate alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from rfcore.errors import InvalidInput
from rfedge.sizing.tables import SizingCell, interpolated

__all__ = ["Wanted", "check_reach", "log_at"]

MAX_BEYOND_FACTOR = 2.0
MAX_BEYOND_DB = 1.0
MARGIN = 1e-6

Value = Callable[[SizingCell], float]
"""A logarithm taken of a cell."""


@dataclass(frozen=True)
class Wanted:
    """The camera asked about: a size in pixels, pictures a second, and luma PSNR."""

    width_px: int
    height_px: int
    hz: float
    psnr_db: float

    @property
    def pixels(self) -> int:
        """Of one picture."""
        return self.width_px * self.height_px


def log_at(cells: Sequence[SizingCell], wanted: Wanted, value: Value) -> float:
    """Return ``value`` of one codec's cells at the wanted size and rate."""
    rows: dict[int, dict[float, float]] = {}
    for cell in cells:
        rows.setdefault(cell.pixels, {})[cell.hz] = value(cell)
    widest = max(rows.values(), key=lambda row: math.log(max(row) / min(row)))
    sizes = sorted(rows)
    at_sizes = [_at_rate(rows[pixels], widest, wanted.hz) for pixels in sizes]
    return interpolated([math.log(n) for n in sizes], at_sizes, math.log(wanted.pixels))


def _at_rate(row: dict[float, float], widest: dict[float, float], hz: float) -> float:
    edge_hz = min(max(hz, min(row)), max(row))
    beyond = 0.0 if edge_hz == hz else _over_rate(widest, hz) - _over_rate(widest, edge_hz)
    return _over_rate(row, edge_hz) + beyond


def _over_rate(row: dict[float, float], hz: float) -> float:
    rates = sorted(row)
    logs = [math.log(rate) for rate in rates]
    return interpolated(logs, [row[rate] for rate in rates], math.log(hz))


def check_reach(cells: Sequence[SizingCell], wanted: Wanted) -> tuple[str, ...]:
    """Return in words what about ``wanted`` lies outside the cells of one codec.

    Raises ``InvalidInput`` naming the value and the range for what lies too far outside.
    """
    pixels = [cell.pixels for cell in cells]
    rates = [cell.hz for cell in cells]
    factor = 1.0 if len(cells) == 1 else MAX_BEYOND_FACTOR
    size = f"{wanted.width_px}x{wanted.height_px}"
    notes = [
        _beyond("size", f"{size} ({wanted.pixels:,} px)", wanted.pixels, pixels, factor),
        _beyond("hz", f"{wanted.hz:g} Hz", wanted.hz, rates, factor),
        _beyond_db(cells, wanted.psnr_db),
    ]
    here = [cell.hz for cell in _nearest_size(cells, wanted.pixels)]
    if min(rates) <= wanted.hz <= max(rates) and not _within(wanted.hz, here):
        ends = " and ".join(f"{hz:.3g}" for hz in sorted({min(here), max(here)})) + " Hz"
        notes.append(f"{size} was measured at {ends}; the effect of the rate is another size's")
    return tuple(note for note in notes if note)


def _within(value: float, measured: Sequence[float]) -> bool:
    return min(measured) * (1 - MARGIN) <= value <= max(measured) * (1 + MARGIN)


def _beyond(
    name: str, shown: str, value: float, measured: Sequence[float], factor: float
) -> str | None:
    low, high = min(measured), max(measured)
    if _within(value, measured):
        return None
    if not _within(value, (low / factor, high * factor)):
        allowed = "nothing else" if factor == 1 else f"at most {factor:g} times beyond"
        raise InvalidInput(
            name, f"{shown} is outside the measured {low:,g}..{high:,g}, of which {allowed} can be "
            "told; measure your own with --drive and --field"
        )  # fmt: skip
    return f"{shown} is {max(low / value, value / high):.2f} times outside {low:,g}..{high:,g}"


def _beyond_db(cells: Sequence[SizingCell], psnr_db: float) -> str | None:
    low_db = max(cell.psnr_db[0] for cell in cells)
    high_db = min(cell.psnr_db[-1] for cell in cells)
    beyond_db = max(low_db - psnr_db, psnr_db - high_db)
    if beyond_db <= 0:
        return None
    allowed_db = MAX_BEYOND_DB
    if beyond_db > allowed_db:
        raise InvalidInput(
            "db", f"{psnr_db:g} dB is more than {allowed_db:g} dB outside the {low_db:g}.."
            f"{high_db:g} dB that were measured of {cells[0].codec}"
        )  # fmt: skip
    return f"{psnr_db:g} dB is {beyond_db:.1f} dB outside {low_db:g}..{high_db:g} dB"


def _nearest_size(cells: Sequence[SizingCell], pixels: int) -> list[SizingCell]:
    nearest = min(cells, key=lambda cell: abs(math.log(cell.pixels / pixels))).pixels
    return [cell for cell in cells if cell.pixels == nearest]
