"""Figures and table of the published experiment, each figure with its numbers beside it as CSV."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("svg")

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from rich.table import Table

from rfedge.evaluate.paper_summary import means_of, savings_by_frame
from rfedge.report.figures import STYLE
from rfedge.report.svg_file import write_figure

__all__ = ["paper_table", "write_paper_figures"]

Row = dict[str, Any]
LINES = ("#2563eb", "#d97706", "#0f766e", "#be185d")
"""One a size, told apart in grey as well by their markers."""
MARKERS = ("o", "s", "^", "D")


def paper_table(rows: Sequence[Row]) -> Table:
    """Return the means with their spread, and the quality of the render itself."""
    table = Table(
        "field", "scene", "size", "render", "100 I/(I+P) %", "sd", "95 %", "RF dB", "RF SSIM"
    )
    for mean in means_of(rows):
        table.add_row(
            mean.field,
            mean.scene,
            "{}x{}".format(*mean.size_px),
            mean.making,
            f"{mean.savings_percent:.1f}",
            f"{mean.sd_percent:.1f}",
            f"±{mean.ci95_percent:.1f}",
            f"{mean.rf_psnr_db:.2f}",
            f"{mean.rf_ssim:.3f}",
        )
    return table


def write_paper_figures(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Write a plot of savings per image for each field and scene, and one by CRF and preset."""
    folder.mkdir(parents=True, exist_ok=True)
    pairs = dict.fromkeys((row["field"], row["scene"]) for row in rows if ":" not in row["field"])
    written = []
    for field, scene in pairs:
        curves = savings_by_frame(rows, field, scene)
        written += write_figure(folder / f"savings_{scene}_{field}", *_per_image(curves))
    return written + write_figure(folder / "savings_by_crf_preset", *_by_setting(rows))


def _per_image(curves: dict[tuple[int, int], Any]) -> tuple[Figure, list[list[str]]]:
    with mpl.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(7.2, 2.8))
        for (size, values), colour, marker in zip(curves.items(), LINES, MARKERS, strict=False):
            label = "{}x{}".format(*size)
            axes.plot(values, color=colour, marker=marker, markersize=3, linewidth=1.5, label=label)
        axes.set(xlabel="image", ylabel="100 I / (I + P), %")
        axes.legend(frameon=False, ncols=4, loc="lower left", bbox_to_anchor=(0, 1), fontsize=9)
    lines = [["image", *("{}x{}".format(*size) for size in curves)]]
    for index, values in enumerate(zip(*curves.values(), strict=True)):
        lines.append([str(index), *(f"{value:.2f}" for value in values)])
    return figure, lines


def _by_setting(rows: Sequence[Row]) -> tuple[Figure, list[list[str]]]:
    """Mean savings over frames and sizes, by preset and CRF, of the fields alone."""
    kept = [row for row in rows if ":" not in row["field"] and row["render"] == "downscaled"]
    settings = dict.fromkeys((row["preset"], row["crf"]) for row in kept)
    fields = dict.fromkeys(row["field"] for row in kept)
    lines = [["preset", "crf", *fields]]
    with mpl.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(7.2, 2.8))
        width = 0.8 / len(fields)
        for number, (field, colour) in enumerate(zip(fields, LINES, strict=False)):
            means = [_mean_of(kept, field, setting) for setting in settings]
            axes.bar(
                np.arange(len(means)) + number * width, means, width, color=colour, label=field
            )
        names = [f"{preset}\n{crf:g}" for preset, crf in settings]
        axes.set_xticks(np.arange(len(names)) + 0.4 - width / 2, names, fontsize=8)
        axes.set(ylabel="100 I / (I + P), %")
        axes.legend(frameon=False, ncols=4, loc="lower left", bbox_to_anchor=(0, 1), fontsize=9)
    for preset, crf in settings:
        figures = [f"{_mean_of(kept, field, (preset, crf)):.2f}" for field in fields]
        lines.append([preset, f"{crf:g}", *figures])
    return figure, lines


def _mean_of(rows: Sequence[Row], field: str, setting: tuple[str, float]) -> float:
    chosen = [
        row["savings_percent"]
        for row in rows
        if row["field"] == field and (row["preset"], row["crf"]) == setting
    ]
    return float(np.mean(chosen))
