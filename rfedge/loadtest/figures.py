"""The load report's charts, as inline SVG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np

from rfedge.report.figures import GRID, INK, MUTED, PAYLOAD, RENDER, STYLE, new_axes, svg

__all__ = ["latency_chart", "uplink_chart"]


def latency_chart(latency_ms: Mapping[str, Sequence[float]], deadline_ms: float) -> str:
    """Return the share of acknowledged frames over their latency, a curve for each run."""
    with mpl.rc_context(STYLE):
        figure, axes = new_axes()
        colours = mpl.colormaps["viridis"](np.linspace(0.1, 0.85, max(1, len(latency_ms))))
        for (name, values), colour in zip(latency_ms.items(), colours, strict=True):
            ordered = np.sort(np.array(values))
            share = 100.0 * np.arange(1, len(ordered) + 1) / len(ordered)
            axes.plot(ordered, share, color=colour, linewidth=2, label=name)
        axes.axvline(deadline_ms, color=RENDER, linewidth=1.5, linestyle="--")
        axes.annotate(
            "deadline",
            (deadline_ms, 4),
            xytext=(5, 0),
            textcoords="offset points",
            color=RENDER,
        )
        axes.set(xlabel="ms from due to acknowledged", ylabel="% of frames", xscale="log")
        for set_formatter in (axes.xaxis.set_major_formatter, axes.xaxis.set_minor_formatter):
            set_formatter(mpl.ticker.FormatStrFormatter("%g"))
        axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(1, 1), fontsize=9)
        return svg(figure)


def uplink_chart(
    carried: Sequence[tuple[float, int]], server_vehicles: int | None, most: int
) -> str:
    """Return vehicles over the uplink they share (Mbit/s), and what the server carried."""
    with mpl.rc_context(STYLE):
        figure, axes = new_axes()
        rates, vehicles = zip(*carried, strict=True)
        axes.plot(rates, vehicles, color=PAYLOAD, linewidth=2, marker="o", markersize=4)
        for rate, count in carried:
            label = f"{count}+" if count >= most else str(count)
            axes.annotate(
                label,
                (rate, count),
                xytext=(0, 7),
                textcoords="offset points",
                ha="center",
                color=INK,
            )
        if server_vehicles:
            axes.axhline(server_vehicles, color=RENDER, linewidth=1.5, linestyle="--")
            axes.annotate(
                f"held by the server in this test: {server_vehicles}",
                (rates[-1], server_vehicles),
                xytext=(0, -12),
                textcoords="offset points",
                ha="right",
                color=RENDER,
            )
        axes.set(xlabel="throughput of the shared uplink, Mbit/s", ylabel="vehicles", xscale="log")
        axes.set_xticks(rates, [f"{rate:g}" for rate in rates])
        axes.minorticks_off()
        axes.yaxis.get_major_locator().set_params(integer=True)
        axes.tick_params(colors=MUTED)
        axes.spines["bottom"].set_color(GRID)
        axes.margins(y=0.15)
        return svg(figure)
