"""A figure on disk: the drawing as SVG, the numbers it was drawn from as CSV beside it."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from rfcore.files import write_whole

__all__ = ["Lines", "write_figure"]

Lines = list[list[str]]


def write_figure(stem: Path, figure: Figure, lines: Sequence[Sequence[str]]) -> list[Path]:
    """Write ``stem``.svg and ``stem``.csv, whole or not at all; close the figure, return paths."""
    drawing, numbers = io.StringIO(), io.StringIO()
    figure.savefig(drawing, format="svg", bbox_inches="tight", metadata={"Date": None})
    plt.close(figure)
    csv.writer(numbers, lineterminator="\n").writerows(lines)
    paths = [stem.with_name(stem.name + ".svg"), stem.with_name(stem.name + ".csv")]
    for path, content in zip(paths, (drawing.getvalue(), numbers.getvalue()), strict=True):
        write_whole(path, content)
    return paths
