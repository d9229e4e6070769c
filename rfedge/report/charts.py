"""Charts and pictures of reports and figures: one palette, one style.

Charts for a page are inline SVG (``svg``); figures of an experiment are files, with their numbers
beside them as CSV (``write_figure``). Equal input gives equal bytes: ids are salted and nothing is
dated. Pictures are embedded as JPEG data.
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

from rfcore.errors import InvalidInput
from rfcore.files import write_whole
from rfcore.image import Rgb, jpeg_bytes

mpl.use("svg")

INK, MUTED, GRID = "#1c2733", "#6b7785", "#dfe4ea"
PAYLOAD, HEADER, RECONSTRUCTION, RENDER = "#2563eb", "#93b4f5", "#2563eb", "#d97706"
LINES = ("#2563eb", "#d97706", "#0f766e", "#be185d", "#6d28d9", "#4d7c0f")
MARKERS = ("o", "s", "^", "D", "v", "P")
"""A colour and a marker for each line of a plot, so that they differ in grey as well."""
BLUE, GREY = LINES[0], "#aab4bf"
DIFFERENCE_GAIN = 8
"""Factor that small differences of pictures are made visible by."""
Lines = list[list[str]]
"""A CSV file: its header, then its lines."""
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
"""Labels of the stages of a frame, in the order that it passes them."""
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


def _frame_chart(frames: int) -> tuple[Figure, Any]:
    """Return a chart over frames whose axes lie where those of every other such chart do."""
    figure, axes = plt.subplots(figsize=(7.2, 2.6))
    figure.subplots_adjust(left=0.11, right=0.98, bottom=0.2, top=0.87)
    axes.set_xlim(-0.7, frames - 0.3)
    return figure, axes


def bytes_chart(payload_bytes: Sequence[int], packet_bytes: Sequence[int]) -> str:
    """Return a bar chart of payload and header bytes of every frame.

    Raises ``InvalidInput`` without frames, or for lists of different lengths.
    """
    _check_series(payload_bytes, packet_bytes)
    with mpl.rc_context(STYLE):
        figure, axes = _frame_chart(len(packet_bytes))
        number = range(len(packet_bytes))
        header = [a - b for a, b in zip(packet_bytes, payload_bytes, strict=True)]
        axes.bar(number, payload_bytes, color=PAYLOAD, label="payload: the P slice")
        axes.bar(number, header, bottom=payload_bytes, color=HEADER, label="pose and header")
        axes.set(xlabel="frame", ylabel="bytes")
        axes.legend(frameon=False, ncols=2, loc="lower left", bbox_to_anchor=(0, 1), fontsize=9)
        return svg(figure, whole=True)


def quality_chart(reconstruction_db: Sequence[float], render_db: Sequence[float]) -> str:
    """Return PSNR over frames, of the reconstruction and of the render it was predicted from.

    Raises ``InvalidInput`` without frames, or for lists of different lengths.
    """
    _check_series(reconstruction_db, render_db)
    with mpl.rc_context(STYLE):
        figure, axes = _frame_chart(len(reconstruction_db))
        for values, colour, label, along in (
            (reconstruction_db, RECONSTRUCTION, "reconstruction", 0.0),
            (render_db, RENDER, "render alone", 0.22),
        ):
            axes.plot(values, color=colour, linewidth=2, marker="o", markersize=3)
            axes.annotate(label, (along, 1.05), xycoords="axes fraction", color=colour, fontsize=9)
        axes.set(xlabel="frame", ylabel="PSNR against the camera, dB")
        return svg(figure, whole=True)


def curve_chart(curve: Sequence[Sequence[float]]) -> str:
    """Return PSNR in dB over seconds of training, from points of (seconds, dB).

    Raises ``InvalidInput`` without points.
    """
    _check_series(curve)
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
    """Return the median milliseconds of each stage, in the order a frame goes through them.

    Raises ``InvalidInput`` unless there is a value for each of ``STAGES``.
    """
    missing = [stage for stage in STAGES if stage not in stages_ms]
    if missing:
        raise InvalidInput("stages", f"there is no value for {', '.join(missing)}")
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


def _check_series(*series: Sequence[object]) -> None:
    lengths = {len(values) for values in series}
    if len(lengths) != 1 or 0 in lengths:
        raise InvalidInput("chart", f"series of {sorted(lengths)} values: give one or more of each")


def new_axes(height_in: float = 2.8) -> tuple[Any, Any]:
    """Return figure and axes of the page's width."""
    return plt.subplots(figsize=(7.2, height_in))


def svg(figure: Any, *, whole: bool = False) -> str:
    """Return a figure as an SVG element, and close it.

    ``whole``: with its margins as they are, so that charts of one layout align side by side.
    """
    buffer = io.StringIO()
    figure.savefig(
        buffer,
        format="svg",
        bbox_inches=None if whole else "tight",
        transparent=True,
        metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")),
    )
    plt.close(figure)
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def amplified_difference(shown: Rgb, camera: Rgb) -> Rgb:
    """Return ``shown - camera`` times ``DIFFERENCE_GAIN``, around mid-grey, uint8 [H, W, 3]."""
    difference = shown.astype(np.int16) - camera
    return np.asarray(np.clip(128 + difference * DIFFERENCE_GAIN, 0, 255), dtype=np.uint8)


def embedded(captions: Iterable[tuple[str, Rgb]]) -> list[dict[str, str]]:
    """Return captions, and pictures as the text of a JPEG's data URI."""
    return [
        {"caption": caption, "data": base64.b64encode(jpeg_bytes(rgb)).decode()}
        for caption, rgb in captions
    ]


def write_figure(stem: Path, figure: Figure, lines: Sequence[Sequence[str]]) -> list[Path]:
    """Write ``stem.svg`` and ``stem.csv`` and close the figure; return their paths.

    Raises ``InvalidInput`` for lines of different lengths, or without one beside the header.
    """
    if len(lines) < 2 or len({len(line) for line in lines}) != 1:
        raise InvalidInput("figure", f"{stem.name}: its CSV needs a header and lines as long as it")
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
