"""What every figure of an evaluation has: one look, and its numbers beside it as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from rfcore.files import write_whole
from rfedge.report.figures import STYLE

__all__ = ["BLUE", "GREY", "LINES", "MARKERS", "STYLE", "write_figure"]

LINES = ("#2563eb", "#d97706", "#0f766e", "#be185d", "#6d28d9", "#4d7c0f")
"""Told apart in grey as well by their markers."""
MARKERS = ("o", "s", "^", "D", "v", "P")
BLUE, GREY = LINES[0], "#aab4bf"


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
