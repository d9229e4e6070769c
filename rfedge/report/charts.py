"""The demo report's charts, as inline SVG.

One palette, one axis per chart, direct labels where a legend would be read twice.

Pictures side by side in a page, and how two of them differ.

What every figure of an evaluation has: one look, and its numbers beside it as CSV.
"""

from __future__ import annotations

import base64
import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from rfcore.files import write_whole
from rfcore.image import Rgb, jpeg_bytes

__all__ = [
    "BLUE",
    "DIFFERENCE_GAIN",
    "GREY",
    "GRID",
    "INK",
    "LINES",
    "MARKERS",
    "MUTED",
    "PAYLOAD",
    "RENDER",
    "STYLE",
    "Lines",
    "amplified_difference",
    "bytes_chart",
    "curve_chart",
    "embedded",
    "new_axes",
    "quality_chart",
    "stages_chart",
    "svg",
    "write_figure",
]


mpl.use("svg")

INK, MUTED, GRID = "#1c2733", "#6b7785", "#dfe4ea"
PAYLOAD, HEADER, RECONSTRUCTION, RENDER = "#2563eb", "#93b4f5", "#2563eb", "#d97706"
STAGES = {
    "convert": "vehicle: camera to YUV",
    "render": "vehicle: render",
    "encode": "vehicle: encode",
    "closed_loop": "vehicle: closed loop",
    "link": "link, both ways",
    "server_queue": "server: wait",
    "server_render": "server: render",
    "server_splice": "server: splice",
    "server_decode": "server: decode",
}
STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "rfedge",
    "font.family": "sans-serif",
    "font.size": 10,
    "axes.edgecolor": GRID,
    "axes.labelcolor": MUTED,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.grid.axis": "y",
    "grid.color": GRID,
    "axes.axisbelow": True,
}
Frame = Mapping[str, Any]


def bytes_chart(frames: Sequence[Frame]) -> str:
    """Return a bar chart of payload and header bytes of every frame."""
    with mpl.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(7.2, 2.4))
        number = range(len(frames))
        payload = [frame["payload_bytes"] for frame in frames]
        header = [frame["packet_bytes"] - frame["payload_bytes"] for frame in frames]
        axes.bar(number, payload, color=PAYLOAD, label="payload: the P slice")
        axes.bar(number, header, bottom=payload, color=HEADER, label="pose and header")
        axes.set(xlabel="frame", ylabel="bytes")
        axes.legend(frameon=False, ncols=2, loc="lower left", bbox_to_anchor=(0, 1), fontsize=9)
        return svg(figure)


def quality_chart(frames: Sequence[Frame]) -> str:
    """Return PSNR over frames, of the reconstruction and of the render it was predicted from."""
    with mpl.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(7.2, 2.4))
        for key, colour, label in (
            ("psnr_db", RECONSTRUCTION, "reconstruction"),
            ("rf_psnr_db", RENDER, "render alone"),
        ):
            values = [frame[key] for frame in frames]
            axes.plot(values, color=colour, linewidth=2, marker="o", markersize=3)
            axes.annotate(
                label,
                (len(values) - 1, values[-1]),
                xytext=(8, 0),
                textcoords="offset points",
                color=colour,
                va="center",
            )
        axes.set(xlabel="frame", ylabel="PSNR against the camera, dB")
        axes.margins(x=0.02)
        return svg(figure)


def curve_chart(curve: Sequence[Sequence[float]]) -> str:
    """Return PSNR in dB over seconds of training, from points of (seconds, dB)."""
    with mpl.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(7.2, 2.8))
        seconds, quality_db = zip(*curve, strict=True)
        axes.plot(seconds, quality_db, color=PAYLOAD, linewidth=2, marker="o", markersize=4)
        axes.annotate(
            f"{quality_db[-1]:.2f} dB",
            (seconds[-1], quality_db[-1]),
            xytext=(0, 8),
            textcoords="offset points",
            ha="right",
            color=PAYLOAD,
        )
        axes.set(xlabel="seconds of training", ylabel="held-out PSNR, dB")
        axes.set_xlim(left=0)
        axes.margins(y=0.15)
        return svg(figure)


def stages_chart(stages_ms: Mapping[str, float]) -> str:
    """Return the median milliseconds of each stage, in the order a frame goes through them."""
    stages_ms = {label: stages_ms[stage] for stage, label in STAGES.items()}
    with mpl.rc_context({**STYLE, "axes.grid.axis": "x"}):
        figure, axes = plt.subplots(figsize=(7.2, 0.42 * len(stages_ms) + 0.6))
        names = list(stages_ms)
        axes.barh(names, list(stages_ms.values()), color=PAYLOAD, height=0.6)
        for position, value in enumerate(stages_ms.values()):
            axes.annotate(
                f"{value:.1f}",
                (value, position),
                xytext=(4, 0),
                textcoords="offset points",
                va="center",
                color=INK,
            )
        axes.invert_yaxis()
        axes.set_xlabel("ms, median over the drive")
        return svg(figure)


def new_axes(height_in: float = 2.8) -> tuple[Any, Any]:
    """Return figure and axes of the page's width."""
    return plt.subplots(figsize=(7.2, height_in))


def svg(figure: Any) -> str:
    """Return a figure as an SVG element, and close it."""
    buffer = io.StringIO()
    figure.savefig(
        buffer,
        format="svg",
        bbox_inches="tight",
        transparent=True,
        metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")),
    )
    plt.close(figure)
    text = buffer.getvalue()
    return text[text.index("<svg") :]


DIFFERENCE_GAIN = 4


def amplified_difference(shown: Rgb, camera: Rgb) -> Rgb:
    """Return the absolute difference times ``DIFFERENCE_GAIN``, uint8 [H, W, 3]."""
    difference = np.abs(shown.astype(np.int16) - camera)
    return np.asarray(np.minimum(difference * DIFFERENCE_GAIN, 255), dtype=np.uint8)


def embedded(captions: Iterable[tuple[str, Rgb]]) -> list[dict[str, str]]:
    """Return captions, and pictures as the text of a JPEG's data URI."""
    return [
        {"caption": caption, "data": base64.b64encode(jpeg_bytes(rgb)).decode()}
        for caption, rgb in captions
    ]


LINES = ("#2563eb", "#d97706", "#0f766e", "#be185d", "#6d28d9", "#4d7c0f")
"""Told apart in grey as well by their markers."""
MARKERS = ("o", "s", "^", "D", "v", "P")
BLUE, GREY = LINES[0], "#aab4bf"
Lines = list[list[str]]


def write_figure(stem: Path, figure: Figure, lines: Sequence[Sequence[str]]) -> list[Path]:
    """Write ``stem.svg`` and ``stem.csv`` and close the figure; return their paths."""
    drawing, numbers = io.StringIO(), io.StringIO()
    with plt.rc_context(STYLE):  # the salt of the file's ids is in it: equal figures, equal files
        figure.savefig(drawing, format="svg", bbox_inches="tight", metadata={"Date": None})
    plt.close(figure)
    csv.writer(numbers, lineterminator="\n").writerows(lines)
    stem.parent.mkdir(parents=True, exist_ok=True)
    paths = [stem.with_name(f"{stem.name}.svg"), stem.with_name(f"{stem.name}.csv")]
    for path, content in zip(paths, (drawing.getvalue(), numbers.getvalue()), strict=True):
        write_whole(path, content)
    return paths
