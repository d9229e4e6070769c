"""The tables for sizing an uplink: one measured cell for each codec, picture size and rate.

A cell's curve is bytes a frame over luma PSNR on a grid of half decibels, without the first frame,
with the 95 % interval that resampling the frames gives. Between cells and grid points logarithms
are interpolated. The tables that ship are the result file ``tables.json`` beside this module, made
by ``rfedge-lab size-tables``.

``log_at`` estimates bytes and times at any size, rate and quality, between and a little beyond the
measured cells. Logarithms are interpolated linearly: over decibels within a cell, over log(Hz)
between cells of one size, over log(pixels) between sizes. At a size that was measured at fewer
rates than another, the effect of the rate beyond them is taken from the size with the widest range.
How far outside the measured ranges a figure may be asked for is ``MAX_BEYOND_FACTOR`` (pixels,
rate) and ``MAX_BEYOND_DB``; tables of one cell, as of a user's own drive, allow its size and rate
alone.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rfcore.errors import InvalidInput
from rfedge.results import read_result, rows_of

MAX_BEYOND_FACTOR = 2.0
MAX_BEYOND_DB = 1.0
MARGIN = 1e-6
KIND = "sizing"
SHIPPED = Path(__file__).with_name("tables.json")
SHIPPED_ON = (
    "one synthetic street, with vehicles that its field has never seen; a field of 640x360 pictures"
)
SAME_RATE = 0.02
"""Rates that differ by less, as ratios, count as one."""
CODECS = ("rfedge", "x264", "x265", "svtav1")
"""Ours at the default effort; rivals at low delay, tuned for PSNR where that is possible."""


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
        """Number of pixels of one picture."""
        return self.width_px * self.height_px

    def log_bytes(self, psnr_db: float, column: str = "bytes_per_frame") -> float:
        """Return the logarithm of a column at a quality, extrapolated by the last slope."""
        return interpolated(self.psnr_db, [math.log(n) for n in getattr(self, column)], psnr_db)


@dataclass(frozen=True)
class SizingTables:
    """All cells, with the drives and the machine that they were measured on, in words."""

    cells: tuple[SizingCell, ...]
    measured_on: str
    machine: str

    def of(self, codec: str) -> tuple[SizingCell, ...]:
        """Return the cells of one codec; raise ``InvalidInput`` if there are none."""
        found = tuple(cell for cell in self.cells if cell.codec == codec)
        if not found:
            raise InvalidInput("codec", f"{codec!r} was not measured: {', '.join(self.codecs)}")
        return found

    @property
    def codecs(self) -> tuple[str, ...]:
        """The codecs of the cells, in the order of ``CODECS``."""
        there = {cell.codec for cell in self.cells}
        return tuple(codec for codec in CODECS if codec in there)

    @property
    def measured_at(self) -> str:
        """The sizes and rates of the cells, in words."""
        rates: dict[tuple[int, int], set[float]] = {}
        for cell in self.cells:
            rates.setdefault((cell.width_px, cell.height_px), set()).add(cell.hz)
        return "; ".join(f"{w}x{h} at {_listed(hz)} Hz" for (w, h), hz in sorted(rates.items()))


def _listed(rates_hz: Iterable[float]) -> str:
    *others, last = (f"{hz:.3g}" for hz in sorted(rates_hz))
    return f"{', '.join(others)} and {last}" if others else last


def read_tables(path: Path) -> SizingTables:
    """Read a result of ``rfedge-lab size-tables``; raise ``InvalidInput`` for another file."""
    result = read_result(path, KIND)
    cells = tuple(rows_of(SizingCell, result["cells"]))
    return SizingTables(cells, str(result["measured_on"]), machine_name(result["host"]))


def machine_name(host: Mapping[str, Any]) -> str:
    """Return the machine of a result (``rfedge.results.host``) in words."""
    return f"{host['cpu']}, {host['cores']} cores, {host['isa']}"


def shipped_tables() -> SizingTables:
    """Return the tables that come with the package."""
    return replace(read_tables(SHIPPED), measured_on=SHIPPED_ON)


def interpolated(xs: Sequence[float], ys: Sequence[float], x: float) -> float:
    """Return y at x, linearly between points and by the end slopes beyond; ``xs`` ascend."""
    if len(xs) == 1:
        return ys[0]
    right = min(max(bisect_left(xs, x), 1), len(xs) - 1)
    x0, x1, y0, y1 = xs[right - 1], xs[right], ys[right - 1], ys[right]
    return y0 + (y1 - y0) * (x - x0) / (x1 - x0)


Value = Callable[[SizingCell], float]
"""Returns a logarithm of one of a cell's values."""


@dataclass(frozen=True)
class CameraDemand:
    """The camera asked about: a size in pixels, pictures a second, and luma PSNR."""

    width_px: int
    height_px: int
    hz: float
    psnr_db: float

    @property
    def pixels(self) -> int:
        """Number of pixels of one picture."""
        return self.width_px * self.height_px


def log_at(cells: Sequence[SizingCell], wanted: CameraDemand, value: Value) -> float:
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


def check_reach(cells: Sequence[SizingCell], wanted: CameraDemand) -> tuple[str, ...]:
    """Return a note for each value of ``wanted`` that lies outside the cells of one codec, and one
    for what lies between them.

    Raises ``InvalidInput`` naming the value and the range if it lies too far outside.
    """
    pixels = [cell.pixels for cell in cells]
    rates = [cell.hz for cell in cells]
    factor = 1.0 if len(cells) == 1 else MAX_BEYOND_FACTOR
    size = f"{wanted.width_px}x{wanted.height_px}"
    notes = [
        _beyond("size", f"{size} ({wanted.pixels:,} px)", wanted.pixels, pixels, factor),
        _beyond("hz", f"{wanted.hz:g} Hz", wanted.hz, rates, factor),
        _beyond_db(cells, wanted.psnr_db),
        _between(cells, wanted),
    ]
    if min(rates) <= wanted.hz <= max(rates):
        notes += _borrowed(cells, wanted)
    return tuple(note for note in notes if note)


def is_measured(cell: SizingCell, wanted: CameraDemand) -> bool:
    """Return whether ``cell`` has the wanted size and rate."""
    return cell.pixels == wanted.pixels and math.isclose(cell.hz, wanted.hz, rel_tol=SAME_RATE)


def _between(cells: Sequence[SizingCell], wanted: CameraDemand) -> str | None:
    """Return a note that names what the wanted size and rate are interpolated between."""
    if any(is_measured(cell, wanted) for cell in cells):
        return None
    sizes: dict[float, str] = {c.pixels: f"{c.width_px}x{c.height_px}" for c in cells}
    rates = {cell.hz: f"{cell.hz:.3g} Hz" for cell in cells}
    wanted_px = f"{wanted.width_px}x{wanted.height_px}"
    parts = []
    for shown, value, names in (
        (wanted_px, wanted.pixels, sizes),
        (f"{wanted.hz:g} Hz", wanted.hz, rates),
    ):
        below = max((v for v in names if v <= value * (1 + SAME_RATE)), default=None)
        above = min((v for v in names if v >= value * (1 - SAME_RATE)), default=None)
        if below is not None and above is not None and below < above:
            parts.append(f"{shown} is interpolated between {names[below]} and {names[above]}")
    return "; ".join(parts) or None


def _borrowed(cells: Sequence[SizingCell], wanted: CameraDemand) -> Iterator[str]:
    """Yield a note for each size that the wanted one is interpolated from and that was not measured
    at its rate: the effect of the rate is then that of the size with the widest range."""
    below = max((c.pixels for c in cells if c.pixels <= wanted.pixels), default=0)
    above = min((c.pixels for c in cells if c.pixels >= wanted.pixels), default=0)
    for pixels in sorted({below, above} - {0}):
        here = [cell for cell in cells if cell.pixels == pixels]
        if not _within(wanted.hz, [cell.hz for cell in here]):
            yield (
                f"{here[0].width_px}x{here[0].height_px} was measured at "
                f"{_listed(cell.hz for cell in here)} Hz alone; the effect of {wanted.hz:g} Hz is "
                "another size's"
            )


def _within(value: float, measured: Sequence[float]) -> bool:
    return min(measured) * (1 - MARGIN) <= value <= max(measured) * (1 + MARGIN)


def _beyond(
    name: str, shown: str, value: float, measured: Sequence[float], factor: float
) -> str | None:
    low, high = min(measured), max(measured)
    if _within(value, measured):
        return None
    if not _within(value, (low / factor, high * factor)):
        reach = "no further" if factor == 1 else f"at most {factor:g} times beyond"
        raise InvalidInput(
            name,
            f"{shown} is outside the measured {low:,g}..{high:,g}, and estimates go {reach}; "
            "measure your own with --drive and --field",
        )
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
