"""The robustness experiment's rows, as a figure and as a section of the results page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console

from rfcore.errors import InvalidInput
from rfedge.report.tables import heading, print_table, table
from rfedge.results import Result, rows_of

__all__ = [
    "CrossingRow",
    "DisturbanceRow",
    "LossRow",
    "print_robust",
    "robust_section",
    "write_robust_figure",
]


@dataclass(frozen=True)
class CrossingRow:
    """One method's clip at one CRF over the lossy link; its first frame is not counted."""

    method: str
    rtt_ms: float
    loss_percent: float
    crf: float
    kbps: float
    ssim: float
    """Mean, of what a viewer sees against the camera."""
    ssim_p5: float
    """Fifth percentile over the frames."""
    not_new: int
    """Frames at which a viewer still saw an earlier picture."""
    frames: int
    seed: int = 5
    """Of the losses; earlier records had this one and did not say so."""


@dataclass(frozen=True)
class LossRow:
    """SSIM of one method at the rate that all are compared at, interpolated between CRFs: means
    over the seeds of loss."""

    method: str
    rtt_ms: float
    loss_percent: float
    ssim: float
    ssim_p5: float
    seeds: int = 1
    ssim_ci95: Sequence[float] | None = None
    """Of the mean over the seeds; None for one seed."""


@dataclass(frozen=True)
class DisturbanceRow:
    """Kilobits a frame at equal quality under one disturbance, or the reason why not."""

    condition: str
    level: str
    reason: str | None = None
    kbit: float | None = None
    more_percent: float | None = None
    """Against ours undisturbed."""
    x264_kbit: float | None = None
    against_x264_percent: float | None = None
    frames_found: int | None = None
    """Whose poses were refined."""


LOSS_COLUMNS = ("method", "loss %", "RTT ms", "seeds", "SSIM", "95 %", "worst 5 % of frames")
REST_COLUMNS = (
    "condition",
    "level",
    "frames found",
    "kbit a frame",
    "more %",
    "x264",
    "against x264 %",
)


def robust_section(path: Path, result: Result) -> str:
    """Return the tables: SSIM over a lossy link at one rate, and bits under disturbed poses."""
    frames = result["frames"]
    notes = (
        f"{frames['count']} frames of `{frames['drive']}`. Loss: bursts of two datagrams of 1200 "
        f"bytes on average, no repetition; the mean SSIM against the camera of what a viewer sees, "
        f"at one total rate, {result['equal_rate_kbps']:.0f} kbit/s, interpolated between CRFs. "
        "last-sent, last-acked and render-only are ours: which frame is predicted from."
    )
    rest = (
        f"Without loss: bits at {result['quality_db']:g} dB, ours against ours undisturbed and "
        "against low-delay x264."
    )
    loss = [
        _loss_cells(row)
        for row in sorted(
            rows_of(LossRow, result["rows"]), key=lambda row: (row.loss_percent, row.rtt_ms)
        )
    ]
    disturbed = [_disturbed_cells(row) for row in rows_of(DisturbanceRow, result["disturbances"])]
    return "\n\n".join(
        [
            heading(path, result),
            notes,
            table(LOSS_COLUMNS, loss),
            rest,
            table(REST_COLUMNS, disturbed),
            "",
        ]
    )


def print_robust(console: Console, result: Result) -> None:
    """Print both tables."""
    rate = f"SSIM over a lossy link, all at {result['equal_rate_kbps']:.0f} kbit/s"
    loss = [_loss_cells(row) for row in rows_of(LossRow, result["rows"])]
    print_table(console, rate, LOSS_COLUMNS, loss)
    bits = f"Bits at {result['quality_db']:g} dB"
    disturbed = [_disturbed_cells(row) for row in rows_of(DisturbanceRow, result["disturbances"])]
    print_table(console, bits, REST_COLUMNS, disturbed)


def _loss_cells(row: LossRow) -> list[str]:
    interval = "-" if row.ssim_ci95 is None else "{:.4f}..{:.4f}".format(*row.ssim_ci95)
    link = (f"{row.loss_percent:g}", f"{row.rtt_ms:g}", str(row.seeds))
    return [row.method, *link, f"{row.ssim:.4f}", interval, f"{row.ssim_p5:.4f}"]


def _disturbed_cells(row: DisturbanceRow) -> list[str]:
    if row.reason is not None:
        return [row.condition, f"n/a: {row.reason}", *["n/a"] * (len(REST_COLUMNS) - 2)]
    return [
        row.condition,
        row.level,
        "-" if row.frames_found is None else str(row.frames_found),
        f"{row.kbit:.1f}",
        f"{row.more_percent:+.1f}",
        f"{row.x264_kbit:.1f}",
        f"{row.against_x264_percent:+.1f}",
    ]


def write_robust_figure(result: Result, folder: Path, name: str = "loss_ssim") -> list[Path]:
    """Write figure and numbers: SSIM over loss with the 95 % intervals of several seeds, a line per
    method, a panel per round trip.

    Raises ``InvalidInput`` for a result without rows.
    """
    from matplotlib import pyplot as plt

    from rfedge.report.charts import LINES, MARKERS, STYLE, write_figure

    rows = rows_of(LossRow, result["rows"])
    if not rows:
        raise InvalidInput("result", "there is no row to draw")
    methods = list(dict.fromkeys(row.method for row in rows))
    rtts = list(dict.fromkeys(row.rtt_ms for row in rows))
    with plt.rc_context(STYLE):
        figure, panels = plt.subplots(1, len(rtts), figsize=(7.2, 3.0), sharey=True, squeeze=False)
        for axes, rtt_ms in zip(panels[0], rtts, strict=True):
            for number, method in enumerate(methods):
                chosen = [r for r in rows if (r.method, r.rtt_ms) == (method, rtt_ms)]
                x, y = [r.loss_percent for r in chosen], [r.ssim for r in chosen]
                style = {"color": LINES[number % 6], "marker": MARKERS[number % 6]}
                reach = np.abs(np.subtract([_interval(r) for r in chosen], np.c_[y])).T
                axes.errorbar(x, y, reach, label=method, linewidth=1.5, markersize=4, **style)
            axes.set(xlabel="datagrams lost, %", title=f"round trip {rtt_ms:g} ms")
        panels[0][0].set_ylabel(f"SSIM at {result['equal_rate_kbps']:.0f} kbit/s")
        figure.legend(
            *panels[0][0].get_legend_handles_labels(),
            frameon=False,
            ncols=3,
            loc="upper center",
            bbox_to_anchor=(0.5, 0.0),
            fontsize=8,
        )
    lines = [["method", "rtt_ms", "loss_percent", "ssim", "low", "high", "ssim_p5"]]
    for row in rows:
        numbers = (f"{row.rtt_ms:g}", f"{row.loss_percent:g}")
        values = (row.ssim, *_interval(row), row.ssim_p5)
        lines.append([row.method, *numbers, *(f"{value:.5f}" for value in values)])
    return write_figure(folder / name, figure, lines)


def _interval(row: LossRow) -> Sequence[float]:
    """Return the 95 % interval of a mean; of one seed the value itself, twice."""
    return (row.ssim, row.ssim) if row.ssim_ci95 is None else row.ssim_ci95
