"""Figures and table of the published experiment, each figure with its numbers beside it as CSV.

The figure that shows what the fields see: camera and renders of one frame, side by side.

What the published experiment's rows say: Table I, mean savings, and savings frame by frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.table import Table

from rfcore.errors import InvalidInput
from rfcore.image import Rgb
from rfedge.experiments.picture_quality import BANDS
from rfedge.report.charts import STYLE, write_figure

__all__ = [
    "PaperMean",
    "means_of",
    "paper_table",
    "savings_by_frame",
    "write_paper_figures",
    "write_views",
]


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


Row = dict[str, Any]


@dataclass(frozen=True)
class PaperMean:
    """Means over frames for one field, scene, size and way of rendering.

    The savings of a frame are its mean over presets and rate factors; ``sd`` and ``ci95`` are over
    frames, the interval that of a normal mean. A P picture that x264 made an I picture counts as it
    is; ``second_not_p`` is the share of such clips. FLIP is taken of neither controls nor native
    renders.
    """

    field: str
    scene: str
    size_px: tuple[int, int]
    making: str
    frames: int
    savings_percent: float
    sd_percent: float
    ci95_percent: float
    rf_psnr_db: float
    rf_ssim: float
    rf_flip: float | None
    bands: tuple[float, ...]
    second_not_p: float


def means_of(rows: Sequence[Row]) -> list[PaperMean]:
    """Return a mean for every combination there is, in the order of the rows."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        key = (row["field"], row["scene"], (row["width"], row["height"]), row["render"])
        groups.setdefault(key, []).append(row)
    return [_mean(key, group) for key, group in groups.items()]


def savings_by_frame(
    rows: Sequence[Row], field: str, scene: str
) -> dict[tuple[int, int], NDArray[np.float64]]:
    """Return for each size the savings of every frame, rendered as published, in frame order."""
    kept = [
        row
        for row in rows
        if (row["field"], row["scene"], row["render"]) == (field, scene, "downscaled")
    ]
    sizes = dict.fromkeys((row["width"], row["height"]) for row in kept)
    return {
        size: _per_frame([r for r in kept if (r["width"], r["height"]) == size], "savings_percent")
        for size in sizes
    }


def _mean(key: tuple[Any, ...], group: Sequence[Row]) -> PaperMean:
    savings = _per_frame(group, "savings_percent")
    sd = float(np.std(savings, ddof=1)) if len(savings) > 1 else 0.0
    field, scene, size_px, making = key
    return PaperMean(
        field=field,
        scene=scene,
        size_px=size_px,
        making=making,
        frames=len(savings),
        savings_percent=float(np.mean(savings)),
        sd_percent=sd,
        ci95_percent=1.96 * sd / len(savings) ** 0.5,
        rf_psnr_db=float(np.mean(_per_frame(group, "rf_psnr_db"))),
        rf_ssim=float(np.mean(_per_frame(group, "rf_ssim"))),
        rf_flip=float(np.mean(_per_frame(group, "rf_flip"))) if "rf_flip" in group[0] else None,
        bands=tuple(np.mean([row["rf_residual_bands"] for row in group], axis=0).tolist()),
        second_not_p=float(np.mean([row["second_type"] != "P" for row in group])),
    )


def _per_frame(rows: Sequence[Row], column: str) -> NDArray[np.float64]:
    frames: dict[str, list[float]] = {}
    for row in rows:
        frames.setdefault(row["frame"], []).append(row[column])
    return np.array([np.mean(values) for values in frames.values()])


mpl.use("svg")

LINES = ("#2563eb", "#d97706", "#0f766e", "#be185d")
"""One a size, told apart in grey as well by their markers."""
PUBLISHED_FIGURES = {
    (kind, field): 3 + 2 * row + column
    for row, kinds in enumerate((("empty",), ("parked", "vehicles")))
    for kind in kinds
    for column, field in enumerate(("ingp", "3dgs"))
}
"""By kind of scene (what follows the last hyphen of its name) and field."""
MARKERS = ("o", "s", "^", "D")


def paper_table(rows: Sequence[Row]) -> Table:
    """Return the means with their spread, and the quality of the render itself."""
    table = Table(
        *("field", "scene", "size", "render", "100 I/(I+P) %", "sd", "95 %"),
        *("RF dB", "RF SSIM", "RF FLIP"),
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
            "-" if mean.rf_flip is None else f"{mean.rf_flip:.3f}",
        )
    return table


def write_paper_figures(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Write a plot of savings per image for each field and scene, one by CRF and preset, and one
    of what the renders miss by spatial frequency."""
    folder.mkdir(parents=True, exist_ok=True)
    pairs = dict.fromkeys((row["field"], row["scene"]) for row in rows if ":" not in row["field"])
    written = []
    for field, scene in pairs:
        curves = savings_by_frame(rows, field, scene)
        written += write_figure(folder / _savings_name(field, scene), *_per_image(curves))
    written += write_figure(folder / "savings_by_crf_preset", *_by_setting(rows))
    return written + write_figure(folder / "residual_by_frequency", *_by_band(rows))


def _savings_name(field: str, scene: str) -> str:
    """Return the name as published where the figure is one of theirs."""
    kind = scene.rsplit("-", 1)[-1]
    number = PUBLISHED_FIGURES.get((kind, field))
    return f"savings_{scene}_{field}" if number is None else f"fig{number}_savings_{kind}_{field}"


def _by_band(rows: Sequence[Row]) -> tuple[Figure, list[list[str]]]:
    """Residual energy over the camera's by band, a line per size, mean over scenes, by field."""
    means = [m for m in means_of(rows) if ":" not in m.field and m.making == "downscaled"]
    names = [f"{low:.3g}..{high:.3g}" for low, high in BANDS]
    lines = [["field", "scene", "size", *names]]
    with mpl.rc_context({**STYLE, "axes.grid.axis": "both"}):
        figure, axes = plt.subplots(figsize=(7.2, 3.0))
        sizes = list(dict.fromkeys(mean.size_px for mean in means))
        for mean in means:
            size = "{}x{}".format(*mean.size_px)
            lines.append([mean.field, mean.scene, size, *(f"{ratio:.4f}" for ratio in mean.bands)])
            index = sizes.index(mean.size_px)
            axes.plot(
                names,
                mean.bands,
                color=LINES[index % len(LINES)],
                marker=MARKERS[list(dict.fromkeys(m.field for m in means)).index(mean.field) % 4],
                linestyle="-" if mean.scene == means[0].scene else "--",
                markersize=4,
                linewidth=1.5,
                label=f"{mean.field}, {mean.scene}, {size}",
            )
        axes.set(xlabel="cycles a pixel", ylabel="residual / camera energy", yscale="log")
        axes.legend(frameon=False, ncols=2, loc="lower left", bbox_to_anchor=(0, 1), fontsize=7)
    return figure, lines


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
