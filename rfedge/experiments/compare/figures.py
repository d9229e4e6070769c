"""Rate-distortion curves and BD-rate bars of a comparison, each with its numbers as CSV."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from rfcore.errors import InvalidInput
from rfedge.experiments.compare.report import CompareRow, CurveRow, without_field
from rfedge.report.charts import STYLE, Lines, write_figure
from rfedge.results import Result, rows_of

__all__ = ["write_compare_figures"]

mpl.use("svg")

SHOWN = {
    "": ("#2563eb", "o"),
    "x264-lowdelay": ("#1c2733", "s"),
    "x264-lowdelay-psnr": ("#6b7785", "D"),
    "x264-our-tools-medium": ("#9aa5b1", "x"),
    "x265-lowdelay": ("#0f766e", "^"),
    "svtav1-lowdelay": ("#d97706", "v"),
}
"""Families in the plot, ours first, each with its setting that needs the fewest bytes; the CSV has
all of them."""
LOW_DB, MIDDLE_DB, HIGH_DB = 29.0, 33.5, 38.0


def write_compare_figures(result: Result, folder: Path) -> list[Path]:
    """Write ``rd_<scene>_<hz>`` and ``cpu_<scene>_<hz>`` for every drive and ``bd_rate_bars`` into
    ``folder``.

    Raises ``InvalidInput`` for a result without rows.
    """
    compared = rows_of(CompareRow, result["rows"])
    if not compared:
        raise InvalidInput("result", "there is no row to draw")
    folder.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    everybody = rows_of(CurveRow, result["curves"])
    for scene, hz in dict.fromkeys((row.scene, row.hz) for row in everybody):
        curves = [row for row in everybody if (row.scene, row.hz) == (scene, hz)]
        written += write_figure(folder / f"rd_{scene}_{hz:g}", *_curves(curves))
        written += write_figure(folder / f"cpu_{scene}_{hz:g}", *_frontier(curves))
    rows = [row for row in compared if row.window_db == compared[0].window_db]
    return written + write_figure(folder / "bd_rate_bars", *_bars(rows))


def _curves(curves: Sequence[CurveRow]) -> tuple[Figure, Lines]:
    lines: Lines = [["setting", "point", "psnr_db", "bytes_per_frame", "ssim"]]
    for curve in curves:
        columns = (curve.point, curve.psnr_db, curve.bytes_per_frame, curve.ssim)
        for point, psnr_db, size, ssim in zip(*columns, strict=True):
            values = [f"{point:g}", f"{psnr_db:.3f}", f"{size:.1f}", f"{ssim:.4f}"]
            lines.append([curve.setting, *values])
    with mpl.rc_context({**STYLE, "axes.grid.axis": "both"}):
        figure, axes = plt.subplots(figsize=(7.2, 3.6))
        for family, (colour, marker) in SHOWN.items():
            those = [curve for curve in curves if curve.family == family]
            if those:
                _draw(
                    axes, those[0] if not family else min(those, key=_middle_bytes), colour, marker
                )
        axes.set(xlabel="kB a frame", ylabel="Y-PSNR, dB", ylim=(LOW_DB, HIGH_DB), xscale="log")
        axes.legend(frameon=False, loc="upper left", fontsize=9)
    return figure, lines


def _frontier(curves: Sequence[CurveRow]) -> tuple[Figure, Lines]:
    """Return bytes over processor time of both ends, of every setting; low and left is good.

    Named are ours, and those that nobody beats in both.
    """
    everybody = {curve.setting: curve for curve in curves}.values()
    anchor = next(curve for curve in everybody if curve.family.startswith("x264-lowdelay"))
    lines: Lines = [["setting", "both_ends_ms", "bytes_percent"]]
    least = math.inf
    with mpl.rc_context({**STYLE, "axes.grid.axis": "both"}):
        figure, axes = plt.subplots(figsize=(7.2, 3.6))
        for curve in sorted(everybody, key=lambda each: each.both_ends_ms):
            percent = 100 * math.exp(_middle_bytes(curve) - _middle_bytes(anchor))
            lines.append([curve.setting, f"{curve.both_ends_ms:.2f}", f"{percent:.2f}"])
            at = (curve.both_ends_ms, percent)
            axes.plot(*at, "o", color=SHOWN.get(curve.family, ("#9aa5b1", "."))[0], markersize=5)
            if percent < least or not curve.family:
                name = curve.setting if curve.family else without_field(curve.setting)
                axes.annotate(
                    name, at, (0, -11), textcoords="offset points", fontsize=7, ha="center"
                )
            least = min(least, percent)
        axes.set(xlabel="processor time of both ends, ms a frame", xscale="log", ylim=(0, None))
        axes.set_ylabel(f"bytes at {MIDDLE_DB:g} dB, % of\n{anchor.setting}")
    return figure, lines


def _draw(axes: Any, curve: CurveRow, colour: str, marker: str) -> None:
    sizes = [size / 1000 for size in curve.bytes_per_frame]
    label = curve.setting if curve.family else without_field(curve.setting)
    axes.plot(
        sizes,
        curve.psnr_db,
        color=colour,
        marker=marker,
        markersize=4,
        linewidth=1.8,
        label=label,
    )


def _middle_bytes(curve: CurveRow) -> float:
    """Return the logarithm of the rate at 33.5 dB, on straight lines between points."""
    return float(np.interp(MIDDLE_DB, curve.psnr_db, np.log(curve.bytes_per_frame)))


def _bars(rows: Sequence[CompareRow]) -> tuple[Figure, Lines]:
    methods = list(dict.fromkeys(row.method for row in rows))
    ours = [row for row in rows if row.method == methods[0]]
    drives = list(dict.fromkeys((row.scene, row.hz) for row in ours))
    rivals = list(dict.fromkeys(row.rival for row in ours))
    lines: Lines = [["scene", "hz", "method", "rival", "setting", "bd_rate_percent", "low", "high"]]
    for row in rows:
        numbers = [f"{value:.2f}" for value in (row.bd_rate_percent, *row.ci95)]
        names = [row.method, row.rival, row.rival_setting]
        lines.append([row.scene, f"{row.hz:g}", *names, *numbers])
    with mpl.rc_context({**STYLE, "axes.grid.axis": "x"}):
        figure, axes = plt.subplots(figsize=(7.2, 0.22 * len(rivals) * len(drives) + 0.8))
        height = 0.8 / len(drives)
        colours = ("#2563eb", "#d97706", "#93b4f5", "#fbbf24")
        for number, ((scene, hz), colour) in enumerate(zip(drives, colours, strict=False)):
            those = {r.rival: r for r in ours if (r.scene, r.hz) == (scene, hz)}
            places = [index + number * height for index in range(len(rivals))]
            figures = [those[r].bd_rate_percent if r in those else 0.0 for r in rivals]
            axes.barh(places, figures, height, color=colour, label=f"{scene}, {hz:g} Hz")
        axes.set_yticks([k + 0.4 - height / 2 for k in range(len(rivals))], rivals, fontsize=8)
        axes.invert_yaxis()
        axes.set_xlabel("BD-rate of ours against the rival, %")
        axes.legend(frameon=False, ncols=2, loc="lower left", bbox_to_anchor=(0, 1), fontsize=9)
    return figure, lines
