"""Savings on each recorded drive, beside x264 with our tools and the strongest rival.

A saving is negative: bits of ours in percent more than the rival's. Bits and times are of rows of
``compare*.json``; a drive that was coded with several fields counts with the first.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rfcore.errors import InvalidInput
from rfedge.evaluate.compare.rows import (
    BEST_OF_ANY_CPU,
    HEADLINE_ANCHOR,
    BreakEvenRow,
    CompareRow,
    without_field,
)
from rfedge.results import Result, rows_of

Window = tuple[float, float]
"""Lowest and highest luma PSNR of a BD-rate, dB."""
FIRST, HIGH = (32.0, 35.0), (35.0, 38.0)
"""The window of headlines, and that of high quality."""
WINDOWS = ((30.0, 33.0), FIRST, HIGH)
"""From low to high quality, without the one that holds two others."""
Series = Mapping[str, Mapping[str, float]]
"""Values by name and by what they are named under in a legend."""
COLOURS = ("#2563eb", "#d97706", "#6b7785")
GROUP_IN = 0.36
"""Height of a group of bars, in inches."""
NUMBER_SPACE = 0.18
"""Share of the axis beside the longest bar, where its number stands."""


@dataclass(frozen=True)
class DriveSavings:
    """All rows of one drive with our coder and one field, by rival and window."""

    scene: str
    hz: float
    rows: Mapping[tuple[str, Window], CompareRow]
    without_field: CompareRow | None
    """Our coder without the field against ``HEADLINE_ANCHOR`` over ``FIRST``."""
    paid: BreakEvenRow | None
    """The field's own bytes; None if no quality was common to both curves."""

    @property
    def name(self) -> str:
        """The drive with its rate."""
        return f"{self.scene}, {self.hz:g} Hz"

    def against(self, rival: str, window: Window = FIRST) -> CompareRow | None:
        """Return the row against a family of rivals; None where the curves share no window."""
        return self.rows.get((rival, window))

    @property
    def anchor(self) -> CompareRow:
        """The row against x264 with our tools; raises ``InvalidInput`` without one."""
        return self._first(HEADLINE_ANCHOR)

    @property
    def best(self) -> CompareRow:
        """The row against the strongest rival; raises ``InvalidInput`` without one."""
        return self._first(BEST_OF_ANY_CPU)

    @property
    def time_ratio(self) -> float:
        """Our processor time of both ends over that of x264 with our tools."""
        return self.anchor.both_ends_ms[0] / self.anchor.rival_both_ends_ms[0]

    def _first(self, rival: str) -> CompareRow:
        row = self.against(rival)
        if row is None:
            raise InvalidInput("rows", f"{self.name} lacks a row against {rival}")
        return row


def savings_of(result: Result) -> list[DriveSavings]:
    """Return the savings of each drive of a comparison that has both rivals over ``FIRST``."""
    rows = rows_of(CompareRow, result["rows"])
    paid = rows_of(BreakEvenRow, result.get("break_even", ()))
    drives: dict[tuple[str, float], list[CompareRow]] = {}
    for row in rows:
        drives.setdefault((row.scene, row.hz), []).append(row)
    found = [_savings(of_drive, paid) for of_drive in drives.values()]
    return [each for each in found if {(r, FIRST) for r in BOTH} <= set(each.rows)]


BOTH = (HEADLINE_ANCHOR, BEST_OF_ANY_CPU)


def _savings(rows: Sequence[CompareRow], paid: Iterable[BreakEvenRow]) -> DriveSavings:
    first = rows[0]
    digest = first.method.rsplit("-", 1)[-1]
    ours = [row for row in rows if row.method == first.method]
    bare = [
        row
        for row in rows
        if without_field(row.method).startswith("rfedge-without-field")
        and row.method.endswith(digest)
        and (row.rival, _window(row)) == (HEADLINE_ANCHOR, FIRST)
    ]
    even = [p for p in paid if (p.scene, p.hz, p.method) == (first.scene, first.hz, first.method)]
    by_rival = {(row.rival, _window(row)): row for row in ours}
    return DriveSavings(
        first.scene, first.hz, by_rival, next(iter(bare), None), next(iter(even), None)
    )


def _window(row: CompareRow) -> Window:
    low_db, high_db = row.window_db
    return low_db, high_db


def percent(row: CompareRow | None, *, named: bool = False) -> str:
    """Return bits against a rival as a table shows them, with the rival's setting if ``named``."""
    if row is None:
        return "-"
    setting = f" ({row.rival_setting})" if named else ""
    return f"{row.bd_rate_percent:+.0f} %{setting}"


def times(drive: DriveSavings) -> str:
    """Return milliseconds of both ends a frame: ours, x264's with our tools, the strongest's."""
    x264, best = drive.anchor, drive.best
    values = (x264.both_ends_ms[0], x264.rival_both_ends_ms[0], best.rival_both_ends_ms[0])
    return " / ".join(f"{value:.0f}" for value in values)


def span(values: Iterable[float], unit: str = " %", form: str = ".0f") -> str:
    """Return the least and the largest of one or more values in words: ``55 to 81 %``."""
    listed = list(values)
    ends = [format(value, form) for value in (min(listed), max(listed))]
    texts = (text if float(text) else format(0.0, form) for text in ends)
    return f"{' to '.join(dict.fromkeys(texts))}{unit}"


def signed_span(values: Iterable[float]) -> str:
    """Return ``span`` of percents with their signs."""
    return span(values, form="+.0f")


def write_bars(stem: Path, label: str, series: Series, *, is_log: bool = False) -> list[Path]:
    """Draw a group of bars for each name and write its numbers beside it; return the files.

    Raises ``InvalidInput`` without a value.
    """
    from matplotlib import pyplot as plt

    from rfedge.report.charts import INK, STYLE, write_figure

    legend = list(dict.fromkeys(each for values in series.values() for each in values))
    if not legend:
        raise InvalidInput("figure", f"{stem.name}: there is no value to draw")
    height = 0.8 / len(legend)
    with plt.rc_context({**STYLE, "axes.grid.axis": "x"}):
        size_in = (7.2, GROUP_IN * len(series) * max(1, len(legend) / 2) + 1.0)
        figure, axes = plt.subplots(figsize=size_in)
        for k, (each, colour) in enumerate(zip(legend, COLOURS, strict=False)):
            at = [place for place, values in enumerate(series.values()) if each in values]
            values = [of[each] for of in series.values() if each in of]
            middles = [place + (k - (len(legend) - 1) / 2) * height for place in at]
            bars = axes.barh(middles, values, height * 0.9, color=colour, label=each)
            form = "{:.0f}" if is_log else "{:+.0f}"
            axes.bar_label(bars, fmt=form, padding=3, fontsize=8, color=INK)
        axes.set_yticks(range(len(series)), list(series), fontsize=8)
        axes.invert_yaxis()
        axes.set_xlabel(label)
        if is_log:
            axes.set_xscale("log")
        else:
            axes.axvline(0, color=INK, linewidth=0.8)
        axes.margins(x=NUMBER_SPACE / 2)
        if len(legend) > 1:
            axes.legend(frameon=False, ncols=3, loc="lower left", bbox_to_anchor=(0, 1), fontsize=9)
    lines = [["name", *legend]]
    for name, of in series.items():
        lines.append([name, *(f"{of[each]:.6g}" if each in of else "" for each in legend)])
    return write_figure(stem, figure, lines)
