"""Rate-distortion curves and BD-rates of a comparison, each with its numbers as CSV."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from rfcore.errors import InvalidInput
from rfedge.evaluate.compare.rows import (
    BEST_OF_ANY_CPU,
    HEADLINE_ANCHOR,
    CompareRow,
    CurveRow,
    of_first_method,
    of_first_window,
    without_field,
)
from rfedge.report.charts import STYLE, Lines, write_figure
from rfedge.results import Result, rows_of

mpl.use("svg")

SHOWN = {
    "": "o",
    "x264-lowdelay": "s",
    "x264-lowdelay-psnr": "D",
    HEADLINE_ANCHOR: "x",
    "x265-lowdelay": "^",
    "svtav1-lowdelay": "v",
}
"""Families in the plot with their markers, ours first, each with its setting that needs the fewest
bytes; codecs of ``--method`` join them, and the CSV has all."""
RIVALS = {
    "x264-our-tools-veryfast": "s",
    HEADLINE_ANCHOR: "o",
    "x264-our-tools-veryslow": "D",
    "x265-medium": "^",
    "svtav1-p6": "v",
    BEST_OF_ANY_CPU: "x",
}
"""Families beside one another in the figure of all drives; squares and diamonds are hollow."""
CODECS = {
    "rfedge": "#2563eb",
    "x264-lowdelay-psnr": "#6b7785",
    "x264-our-tools": "#1c2733",
    "x264": "#4d7c0f",
    "x265": "#0f766e",
    "svtav1": "#d97706",
    BEST_OF_ANY_CPU: "#be185d",
}
"""Colours in all figures, by what names begin with."""
OTHERS, OTHER_MARKERS = ("#6d28d9", "#0891b2", "#a16207"), "P*<>hp"
"""Colours and markers of codecs of ``--method``."""
LOW_DB, MIDDLE_DB, HIGH_DB = 29.0, 33.5, 38.0
LOW_SHARE = 0.15
"""Points in this lowest share of the frontier have their names above, off the axis."""


def write_compare_figures(result: Result, folder: Path) -> list[Path]:
    """Write ``rd_<scene>_<hz>`` and ``cpu_<scene>_<hz>`` for every drive and ``bd_rates`` into
    ``folder``.

    Raises ``InvalidInput`` for a result without rows.
    """
    written = write_bd_rates(result, folder)
    everybody = rows_of(CurveRow, result["curves"])
    for scene, hz in dict.fromkeys((row.scene, row.hz) for row in everybody):
        curves = [row for row in everybody if (row.scene, row.hz) == (scene, hz)]
        written += _written(result, folder / f"rd_{scene}_{hz:g}", *_curves(curves))
        written += _written(result, folder / f"cpu_{scene}_{hz:g}", *_frontier(curves))
    return written


def _written(result: Result, stem: Path, figure: Figure, lines: Lines) -> list[Path]:
    if result["quick"]:
        axes = figure.axes[0]
        axes.set_xlabel(f"{axes.get_xlabel()} (QUICK, not for figures)")
    return write_figure(stem, figure, lines)


def write_bd_rates(result: Result, folder: Path, name: str = "bd_rates") -> list[Path]:
    """Write the figure of all drives against all rivals over the first window into ``folder``.

    Raises ``InvalidInput`` for a result without rows.
    """
    compared = rows_of(CompareRow, result["rows"])
    if not compared:
        raise InvalidInput("result", "there is no row to draw")
    return _written(result, folder / name, *_bd_rates(of_first_window(compared)))


def _curves(curves: Sequence[CurveRow]) -> tuple[Figure, Lines]:
    lines: Lines = [["setting", "point", "psnr_db", "bytes_per_frame", "ssim"]]
    for curve in curves:
        columns = (curve.point, curve.psnr_db, curve.bytes_per_frame, curve.ssim)
        for point, psnr_db, size, ssim in zip(*columns, strict=True):
            values = [f"{point:g}", f"{psnr_db:.3f}", f"{size:.1f}", f"{ssim:.4f}"]
            lines.append([curve.setting, *values])
    with mpl.rc_context({**STYLE, "axes.grid.axis": "both"}):
        figure, axes = plt.subplots(figsize=(7.2, 3.6))
        colours = _colours(each.setting for each in curves)
        shown = {**SHOWN, **_markers_of_others(each.setting for each in curves)}
        if all(each.family != HEADLINE_ANCHOR for each in curves):
            anchors = [c.family for c in curves if c.family.startswith("x264-our-tools")]
            shown |= dict.fromkeys(anchors[:1], SHOWN[HEADLINE_ANCHOR])
        for family, marker in shown.items():
            those = [curve for curve in curves if curve.family == family]
            if those:
                curve = those[0] if not family else min(those, key=_middle_bytes)
                _draw(axes, curve, colours[_codec(curve.setting)], marker)
        axes.set(xlabel="kB a frame", ylabel="Y-PSNR, dB", ylim=(LOW_DB, HIGH_DB), xscale="log")
        axes.legend(frameon=False, loc="upper left", fontsize=9)
    return figure, lines


def _frontier(curves: Sequence[CurveRow]) -> tuple[Figure, Lines]:
    """Return bytes over processor time of both ends, of every setting; low and left is good.

    A colour a codec; of its settings those are named that nobody beats in both, and all of ours.
    """
    everybody = {curve.setting: curve for curve in curves}.values()
    anchor = next(curve for curve in everybody if curve.family.startswith("x264-lowdelay"))
    lines: Lines = [["setting", "both_ends_ms", "bytes_percent"]]
    least = math.inf
    colours = _colours(curve.setting for curve in everybody)
    percents = {
        curve.setting: 100 * math.exp(_middle_bytes(curve) - _middle_bytes(anchor))
        for curve in everybody
    }
    with mpl.rc_context({**STYLE, "axes.grid.axis": "both"}):
        figure, axes = plt.subplots(figsize=(7.2, 3.6))
        for curve in sorted(everybody, key=lambda each: each.both_ends_ms):
            percent = percents[curve.setting]
            lines.append([curve.setting, f"{curve.both_ends_ms:.2f}", f"{percent:.2f}"])
            at = (curve.both_ends_ms, percent)
            codec = _codec(curve.setting)
            axes.plot(*at, "o", color=colours[codec], markersize=5, label=codec)
            if percent < least or not curve.family:
                low = percent < LOW_SHARE * max(percents.values())
                heights = (5, 14) if low else (5, -11)
                _name_point(axes, at, curve, heights[len(axes.texts) % 2])
            least = min(least, percent)
        axes.set(xlabel="processor time of both ends, ms a frame", xscale="log", ylim=(0, None))
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_ylabel(f"bytes at {MIDDLE_DB:g} dB, % of\n{anchor.setting}")
        by_codec = dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
        axes.legend(
            by_codec.values(),
            by_codec,
            frameon=False,
            ncols=6,
            loc="lower left",
            bbox_to_anchor=(0, 1),
            fontsize=8,
        )
    return figure, lines


def _codec(setting: str) -> str:
    """Return whose a setting is, ``x264-our-tools`` of ``x264-our-tools-medium``."""
    return next((codec for codec in CODECS if setting.startswith(codec)), setting)


def _colours(names: Iterable[str]) -> dict[str, str]:
    """Return a colour for each codec: those of ``--method`` get theirs in their order."""
    others = dict.fromkeys(codec for codec in map(_codec, names) if codec not in CODECS)
    return {**CODECS, **dict(zip(others, cycle(OTHERS), strict=False))}


def _markers_of_others(settings: Iterable[str]) -> dict[str, str]:
    """Return a marker for each codec of ``--method``, whose family has its name."""
    others = dict.fromkeys(name for name in settings if _codec(name) not in CODECS)
    return dict(zip(others, cycle(OTHER_MARKERS), strict=False))


def _name_point(axes: Any, at: tuple[float, float], curve: CurveRow, height_pt: int) -> None:
    """Write a setting's name without its codec's, which the colour tells."""
    axes.annotate(
        _label(curve).removeprefix(_codec(curve.setting)).lstrip("-"),
        at,
        (0, height_pt),
        textcoords="offset points",
        fontsize=7,
        ha="center",
    )


def _draw(axes: Any, curve: CurveRow, colour: str, marker: str) -> None:
    sizes = [size / 1000 for size in curve.bytes_per_frame]
    axes.plot(
        sizes,
        curve.psnr_db,
        color=colour,
        marker=marker,
        markersize=4,
        linewidth=1.8,
        label=_label(curve),
    )


def _label(curve: CurveRow) -> str:
    """Return a setting's name, ours without the digest of its field."""
    return curve.setting if curve.family else without_field(curve.setting)


def _middle_bytes(curve: CurveRow) -> float:
    """Return the logarithm of the rate at 33.5 dB, on straight lines between points."""
    return float(np.interp(MIDDLE_DB, curve.psnr_db, np.log(curve.bytes_per_frame)))


def _bd_rates(rows: Sequence[CompareRow]) -> tuple[Figure, Lines]:
    """Return what ours saves on each drive, by rival; intervals are of the headline's."""
    lines: Lines = [["scene", "hz", "method", "rival", "setting", "bd_rate_percent", "low", "high"]]
    for row in rows:
        interval = (math.nan, math.nan) if row.ci95 is None else row.ci95
        numbers = [f"{value:.2f}" for value in (row.bd_rate_percent, *interval)]
        names = [row.method, row.rival, row.rival_setting]
        lines.append([row.scene, f"{row.hz:g}", *names, *numbers])
    ours = of_first_method(rows)
    drives = list(dict.fromkeys((row.scene, row.hz) for row in ours))
    with mpl.rc_context({**STYLE, "axes.grid.axis": "both"}):
        figure, axes = plt.subplots(figsize=(7.2, 0.3 * len(drives) + 1.2))
        settings = [row.rival_setting for row in ours]
        colours = _colours(settings)
        for rival, marker in {**RIVALS, **_markers_of_others(settings)}.items():
            those = [row for row in ours if row.rival == rival]
            if not those:
                continue
            places = [drives.index((row.scene, row.hz)) for row in those]
            values = [row.bd_rate_percent for row in those]
            colour = colours[_codec(rival)]
            (drawn,) = axes.plot(values, places, marker, color=colour, markersize=5, label=rival)
            drawn.set_fillstyle("none" if marker in "sD" else "full")
            intervals = [row.ci95 for row in those if row.ci95 is not None]
            if rival == HEADLINE_ANCHOR and intervals:  # all or, of a quick run, none
                axes.hlines(places, *zip(*intervals, strict=True), color=colour)
        axes.set_yticks(range(len(drives)), [f"{scene}, {hz:g} Hz" for scene, hz in drives])
        axes.tick_params("y", labelsize=8)
        axes.invert_yaxis()
        axes.set_xlabel("BD-rate of ours against the rival, %")
        shown = [value for row in ours for value in (row.bd_rate_percent, *(row.ci95 or ()))]
        axes.set_xlim(min(shown) - 5, max(0.0, *shown) + 5)
        if axes.lines:
            axes.legend(frameon=False, ncols=3, loc="lower left", bbox_to_anchor=(0, 1), fontsize=8)
    return figure, lines
