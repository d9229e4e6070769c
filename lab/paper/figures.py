"""Figures of the published experiment, each with its numbers beside it as CSV.

Savings by image, by preset and CRF, and what renders miss by spatial frequency, from the rows of
the result; and camera and renders of one frame side by side, from pictures.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from lab.paper.render_quality import BANDS
from lab.paper.report import PaperRow, means_of, paper_parts, paper_rows, savings_by_frame
from lab.report import Report
from rfcore.errors import InvalidInput
from rfcore.image import Rgb
from rfedge.report.charts import LINES, MARKERS, STYLE, write_figure
from rfedge.results import Result

mpl.use("svg")

VIEW_PX = 320
"""Width of a view in the drawing, so that a page of figures stays small."""


def write_views(views: Sequence[tuple[str, Rgb]], folder: Path) -> list[Path]:
    """Write ``fig2_views``, a row per scene; names are ``scene: what``. Raises ``InvalidInput``
    without views."""
    if not views:
        raise InvalidInput("views", "there is none to show")
    folder.mkdir(parents=True, exist_ok=True)
    scenes = list(dict.fromkeys(name.split(":")[0] for name, _ in views))
    columns = len(views) // len(scenes)
    with mpl.rc_context({**STYLE, "axes.grid": False}):
        figure, axes = plt.subplots(
            len(scenes),
            columns,
            figsize=(2.6 * columns, 1.7 * len(scenes)),
            squeeze=False,
            layout="constrained",
        )
        for axis, (name, pixels) in zip(axes.flat, views, strict=True):
            step = max(1, pixels.shape[1] // VIEW_PX)
            axis.imshow(pixels[::step, ::step], interpolation="none")
            axis.set_title(name, fontsize=8)
            axis.set_axis_off()
    lines = [["view", "width", "height"]]
    lines += [[name, str(pixels.shape[1]), str(pixels.shape[0])] for name, pixels in views]
    return write_figure(folder / "fig2_views", figure, lines)


PUBLISHED_FIGURES = {
    (kind, field): 3 + 2 * row + column
    for row, kinds in enumerate((("empty",), ("parked", "vehicles")))
    for kind in kinds
    for column, field in enumerate(("ingp", "3dgs"))
}
"""The published number by kind of scene (the end of its name, after a hyphen) and field."""


def write_paper_figures(result: Result, folder: Path, _name: str) -> list[Path]:
    """Write a plot of savings by CRF and preset, one of savings per image for each field and scene,
    and one of what the renders miss by spatial frequency.

    Raises ``InvalidInput`` without rows.
    """
    rows = paper_rows(result)
    if not rows:
        raise InvalidInput("rows", "there is none to draw")
    folder.mkdir(parents=True, exist_ok=True)
    pairs = dict.fromkeys((row.field, row.scene) for row in rows if not row.is_control)
    written = write_figure(folder / "savings_by_crf_preset", *_by_setting(rows))
    for field, scene in pairs:
        curves = savings_by_frame(rows, field, scene)
        written += write_figure(folder / _savings_name(field, scene), *_per_image(curves))
    return written + write_figure(folder / "residual_by_frequency", *_by_band(rows))


def _savings_name(field: str, scene: str) -> str:
    """Return the name as published where the figure is one of theirs."""
    kind = scene.rsplit("-", 1)[-1]
    number = PUBLISHED_FIGURES.get((kind, field))
    return f"savings_{scene}_{field}" if number is None else f"fig{number}_savings_{kind}_{field}"


def _by_band(rows: Sequence[PaperRow]) -> tuple[Figure, list[list[str]]]:
    """Residual energy over the camera's by band, a line per size, mean over scenes, by field."""
    means = [m for m in means_of(rows) if ":" not in m.name and m.making == "downscaled"]
    names = [f"{low:.3g}..{high:.3g}" for low, high in BANDS]
    lines = [["field", "scene", "size", *names]]
    with mpl.rc_context({**STYLE, "axes.grid.axis": "both"}):
        figure, axes = plt.subplots(figsize=(7.2, 3.0))
        sizes = list(dict.fromkeys(mean.size_px for mean in means))
        for mean in means:
            size = "{}x{}".format(*mean.size_px)
            lines.append([mean.name, mean.scene, size, *(f"{ratio:.4f}" for ratio in mean.bands)])
            index = sizes.index(mean.size_px)
            axes.plot(
                names,
                mean.bands,
                color=LINES[index % len(LINES)],
                marker=MARKERS[list(dict.fromkeys(m.name for m in means)).index(mean.name) % 4],
                linestyle="-" if mean.scene == means[0].scene else "--",
                markersize=4,
                linewidth=1.5,
                label=f"{mean.name}, {mean.scene}, {size}",
            )
        axes.set(xlabel="cycles a pixel", ylabel="residual / camera energy", yscale="log")
        axes.legend(frameon=False, ncols=2, loc="lower left", bbox_to_anchor=(0, 1), fontsize=7)
    return figure, lines


def _per_image(
    curves: dict[tuple[int, int], NDArray[np.float64]],
) -> tuple[Figure, list[list[str]]]:
    with mpl.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(7.2, 2.8))
        for (size, values), colour, marker in zip(curves.items(), LINES, MARKERS, strict=False):
            label = "{}x{}".format(*size)
            axes.plot(values, color=colour, marker=marker, markersize=3, linewidth=1.5, label=label)
        axes.set(xlabel="number of the picture", ylabel="100 I / (I + P), %")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.legend(frameon=False, ncols=4, loc="lower left", bbox_to_anchor=(0, 1), fontsize=9)
    lines = [["image", *("{}x{}".format(*size) for size in curves)]]
    for index, savings in enumerate(zip(*curves.values(), strict=True)):
        lines.append([str(index), *(f"{value:.2f}" for value in savings)])
    return figure, lines


def _by_setting(rows: Sequence[PaperRow]) -> tuple[Figure, list[list[str]]]:
    """Mean savings over frames and sizes, by preset and CRF, of the fields alone."""
    kept = [row for row in rows if not row.is_control and row.render == "downscaled"]
    settings = dict.fromkeys((row.preset, row.crf) for row in kept)
    fields = dict.fromkeys(row.field for row in kept)
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


def _mean_of(rows: Sequence[PaperRow], field: str, setting: tuple[str, float]) -> float:
    chosen = [
        row.savings_percent
        for row in rows
        if row.field == field and (row.preset, row.crf) == setting
    ]
    return float(np.mean(chosen))


REPORT = Report(
    "paper",
    "The published experiment",
    "What the published two-frame clip saves by the published metric, beside controls that know "
    "nothing of the place and beside an I picture of equal quality.",
    paper_parts,
    write_paper_figures,
)
