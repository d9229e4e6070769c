"""The latency experiment as figures and as a section of the results page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rfedge.report.markdown_parts import heading, table

__all__ = ["latency_section", "write_latency_figures"]

Row = Mapping[str, Any]

CDF_RATE_BPS = 4e6
"""The rate whose distribution is drawn: the demo's link."""

NEEDED = (
    "scene",
    "Hz",
    "method",
    "dB",
    "kbit a frame",
    "largest",
    "first",
    "uplink for p99 within 5 ms, Mbit/s",
    "within 10 ms",
)
PLAYED = (
    "scene",
    "Hz",
    "method",
    "link",
    "tau mean ms",
    "network p50 ms",
    "p99 ms",
    "end to end p50 ms",
    "within 5 ms %",
    "within 10 ms %",
    "dropped %",
)


def latency_section(path: Path, result: Row) -> str:
    """Return the tables: what uplink is needed, and what each link makes of the frames."""
    requirement = result["requirement"]
    notes = (
        f"Both methods at the same luma PSNR; the first frame, which a stream sends once, apart. "
        f"{result['played_frames']} frames are played over each link (the clip again and again), "
        f"with at most two under way; a frame dropped before coding counts as late. They cannot "
        f"show {100 * requirement['share']:g} %: to claim that with 95 % confidence, "
        f"{requirement['frames_needed']:,} different frames in a row would have to be in time. "
        "End to end adds the processor time of both ends with one thread (of x264 the encoder's "
        "alone)."
    )
    needed = [_needed_cells(row) for row in result["needed"]]
    played = [_played_cells(row) for row in result["rows"]]
    return "\n\n".join(
        [heading(path, result), notes, table(NEEDED, needed), table(PLAYED, played), ""]
    )


def write_latency_figures(result: Row, folder: Path) -> list[Path]:
    """Write ``tau_vs_throughput``, ``latency_cdf`` and ``stage_stack`` (SVG and CSV)."""
    return [
        *_tau_figure(result, folder / "tau_vs_throughput"),
        *_cdf_figure(result, folder / "latency_cdf"),
        *_stack_figure(result, folder / "stage_stack"),
    ]


def _label(row: Row) -> str:
    return f"{row['scene']} {row['hz']:g} Hz, {row['method'].split('-')[0]}"


def _needed_cells(row: Row) -> list[str]:
    uplink = row["uplink_bps_p99_within"]
    return [
        row["scene"],
        f"{row['hz']:g}",
        row["method"],
        f"{row['psnr_db']:.2f}",
        f"{row['kbit_per_frame']:.1f}",
        f"{row['largest_kbit']:.1f}",
        f"{row['first_frame_kbit']:.1f}",
        *(f"{uplink[budget] / 1e6:.2f}" for budget in ("5", "10")),
    ]


def _played_cells(row: Row) -> list[str]:
    share = row["share_within"]
    return [
        row["scene"],
        f"{row['hz']:g}",
        row["method"],
        row["link"],
        f"{row['tau_ms']['mean']:.2f}",
        f"{row['network_ms']['p50']:.2f}",
        _ms(row["network_p99_ms"]),
        _ms(row["end_to_end_p50_ms"]),
        *(f"{100 * share[budget]:.1f}" for budget in ("5", "10")),
        f"{100 * row['dropped'] / row['frames']:.1f}",
    ]


def _ms(value: float | None) -> str:
    return "never" if value is None else f"{value:.2f}"


def _by_sender(rows: Sequence[Row]) -> dict[str, list[Row]]:
    senders: dict[str, list[Row]] = {}
    for row in rows:
        senders.setdefault(_label(row), []).append(row)
    return senders


def _tau_figure(result: Row, stem: Path) -> list[Path]:
    from matplotlib import pyplot as plt

    from rfedge.report.charts import LINES, MARKERS, STYLE, write_figure

    lines = [["sender", "Mbit/s", "mean tau ms"]]
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(7.2, 3.2))
        senders = _by_sender([row for row in result["rows"] if row["link"].endswith("Mbit/s")])
        for number, (name, rows) in enumerate(senders.items()):
            x = [row["rate_bps"] / 1e6 for row in rows]
            y = [row["tau_ms"]["mean"] for row in rows]
            style: Row = {"color": LINES[number % 6], "marker": MARKERS[number % 6]}
            axes.plot(x, y, label=name, linewidth=1.5, markersize=4, **style)
            lines += [[name, f"{a:g}", f"{b:.3f}"] for a, b in zip(x, y, strict=True)]
        axes.axhspan(5, 10, color="#dfe4ea", zorder=0)
        axes.set(xscale="log", yscale="log", xlabel="throughput, Mbit/s", ylabel="tau, ms a frame")
        axes.legend(frameon=False, ncols=2, loc="lower left", bbox_to_anchor=(0, 1), fontsize=9)
    return write_figure(stem, figure, lines)


def _cdf_figure(result: Row, stem: Path) -> list[Path]:
    from matplotlib import pyplot as plt

    from rfedge.report.charts import LINES, STYLE, write_figure

    lines = [["sender", "share", "network ms"]]
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(7.2, 3.2))
        drawn = [row for row in result["rows"] if row["rate_bps"] == CDF_RATE_BPS]
        for number, row in enumerate(drawn):
            quantiles = row["network_quantiles_ms"]
            arrived = [(ms, k / (len(quantiles) - 1)) for k, ms in enumerate(quantiles) if ms]
            x, y = zip(*arrived, strict=True)
            axes.step(x, y, where="post", color=LINES[number % 6], label=_label(row))
            lines += [[_label(row), f"{b:.2f}", f"{a:.3f}"] for a, b in arrived]
        axes.axvspan(5, 10, color="#dfe4ea", zorder=0)
        axes.set(xlabel=f"network latency at {CDF_RATE_BPS / 1e6:g} Mbit/s, ms", ylabel="share")
        axes.legend(frameon=False, ncols=2, loc="lower left", bbox_to_anchor=(0, 1), fontsize=9)
    return write_figure(stem, figure, lines)


def _stack_figure(result: Row, stem: Path) -> list[Path]:
    from matplotlib import pyplot as plt

    from rfedge.report.charts import LINES, STYLE, write_figure

    played = {_label(r): r for r in result["rows"] if r["rate_bps"] == CDF_RATE_BPS}
    stacks = {
        _label(row): {**row["stage_ms"], "network": played[_label(row)]["network_ms"]["p50"]}
        for row in result["needed"]
    }
    stages = list(dict.fromkeys(stage for stack in stacks.values() for stage in stack))
    lines = [["sender", *stages]]
    with plt.rc_context({**STYLE, "axes.grid.axis": "x"}):
        figure, axes = plt.subplots(figsize=(7.2, 0.5 * len(stacks) + 1.2))
        left = [0.0] * len(stacks)
        for number, stage in enumerate(stages):
            widths = [stack.get(stage, 0.0) for stack in stacks.values()]
            alpha = 1.0 if number < len(LINES) else 0.5
            colour = LINES[number % 6]
            axes.barh(list(stacks), widths, 0.6, left, color=colour, alpha=alpha, label=stage)
            left = [a + b for a, b in zip(left, widths, strict=True)]
        axes.invert_yaxis()
        axes.set_xlabel("ms a frame: one thread, network at 4 Mbit/s")
        axes.legend(frameon=False, ncols=3, loc="lower left", bbox_to_anchor=(0, 1), fontsize=8)
    for name, stack in stacks.items():
        lines.append([name, *(f"{stack.get(stage, 0.0):.2f}" for stage in stages)])
    return write_figure(stem, figure, lines)
