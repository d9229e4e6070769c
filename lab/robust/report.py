"""The robustness experiment's rows, as tables and as a figure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lab.report import Report
from rfcore.errors import InvalidInput
from rfedge.report.tables import Table, columns, shown
from rfedge.results import Result, rows_of


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
    """Seed of the losses."""


@dataclass(frozen=True)
class LossRow:
    """SSIM of one method at the rate that all are compared at, interpolated between CRFs: means
    over the seeds of loss."""

    method: str = field(metadata=shown("method"))
    rtt_ms: float = field(metadata=shown("RTT ms", "g"))
    loss_percent: float = field(metadata=shown("loss %", "g"))
    ssim: float = field(metadata=shown("SSIM", ".4f"))
    ssim_p5: float = field(metadata=shown("worst 5 % of frames", ".4f"))
    seeds: int = field(default=1, metadata=shown("seeds"))
    ssim_ci95: Sequence[float] | None = field(
        default=None, metadata=shown("95 %", "{:.4f}..{:.4f}")
    )
    """Interval of the mean over the seeds; None for one seed."""


@dataclass(frozen=True)
class DisturbanceRow:
    """Kilobits a frame at equal quality under one disturbance, or the reason why not."""

    condition: str = field(metadata=shown("condition"))
    level: str = field(metadata=shown("level"))
    reason: str | None = None
    kbit: float | None = field(default=None, metadata=shown("kbit a frame", ".1f"))
    more_percent: float | None = field(default=None, metadata=shown("more %", "+.1f"))
    """Bits above those of ours undisturbed."""
    x264_kbit: float | None = field(default=None, metadata=shown("x264 kbit", ".1f"))
    against_x264_percent: float | None = field(
        default=None, metadata=shown("against x264, %", "+.1f")
    )
    frames_found: int | None = field(default=None, metadata=shown("frames found"))
    """Number of frames whose poses were refined."""


def robust_parts(result: Result) -> Iterator[Table | str]:
    """Yield SSIM over a lossy link at one rate, and bits under disturbed poses and light."""
    frames = result["frames"]
    yield (
        f"{frames['count']} frames of `{frames['drive']}`. Loss: bursts of two datagrams of 1200 "
        f"bytes on average, no repetition; the mean SSIM against the camera of what a viewer sees, "
        f"at one total rate, {result['equal_rate_kbps']:.0f} kbit/s, interpolated between CRFs. "
        "last-sent, last-acked and render-only are ours: which frame is predicted from. **The "
        "product does not use datagrams.** It sends over TCP, where loss costs time and no picture "
        "is damaged: [what loss does there](faults.md)."
    )
    lossy = sorted(rows_of(LossRow, result["rows"]), key=lambda row: (row.loss_percent, row.rtt_ms))
    title = (
        f"SSIM over a lossy link of datagrams, which the product does not use, all at "
        f"{result['equal_rate_kbps']:.0f} kbit/s"
    )
    yield Table(title, columns(LossRow), lossy)
    disturbed = rows_of(DisturbanceRow, result["disturbances"])
    title = f"Without loss: bits at {result['quality_db']:g} dB, ours against ours undisturbed"
    not_run = [f"{row.condition}: {row.reason}" for row in disturbed if row.reason is not None]
    title += f". Not run: {'; '.join(not_run)}" if not_run else ""
    run = [row for row in disturbed if row.reason is None]
    yield Table(title, columns(DisturbanceRow), run)


def write_robust_figure(result: Result, folder: Path, name: str) -> list[Path]:
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


REPORT = Report(
    "robust",
    "Loss, wrong poses, another light",
    "What a viewer would see over datagrams, which the product does not use, and what wrong poses, "
    "another lane and another light cost in bits.",
    robust_parts,
    write_robust_figure,
)
