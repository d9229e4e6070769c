"""The figure that shows what the fields see: camera and renders of one frame, side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl

mpl.use("svg")

from matplotlib import pyplot as plt

from rfcore.errors import InvalidInput
from rfcore.image import Rgb
from rfedge.report.figures import STYLE
from rfedge.report.svg_file import write_figure

__all__ = ["write_views"]

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
