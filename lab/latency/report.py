"""The latency experiment's rows, as figures and as a section of the results page.

``scene``, ``hz`` and ``method`` name a sender in every kind of row; ``crf`` and ``psnr_db`` are the
operating point that its clip was coded at. Latencies are in milliseconds a frame.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from rfcore.errors import InvalidInput
from rfedge.report.tables import heading, pivot, print_table, table
from rfedge.results import Result, rows_of

__all__ = [
    "NeededRow",
    "PlayedRow",
    "ShownRow",
    "latency_section",
    "print_needed",
    "write_latency_figures",
]


@dataclass(frozen=True)
class NeededRow:
    """What one sender's frames need: sizes, uplink, and computing at both ends."""

    scene: str
    hz: float
    method: str
    crf: float
    psnr_db: float
    kbit_per_frame: float
    """Mean over all frames but the first."""
    largest_kbit: float
    first_frame_kbit: float
    uplink_bps_p99_within: Mapping[str, float]
    """Lowest constant rate at which 99 % of the frames are in time, by the budget in ms."""
    stage_ms: Mapping[str, float]
    """Processor time of each stage at one thread, lower quartiles."""

    @property
    def sender(self) -> str:
        """Drive and method in a few words."""
        return _sender(self)


@dataclass(frozen=True)
class PlayedRow:
    """One sender's frames over one link. None: that quantile of the frames never came."""

    scene: str
    hz: float
    method: str
    crf: float
    psnr_db: float
    link: str
    rate_bps: float
    frames: int
    dropped: int
    """Frames that were not sent because two were still under way."""
    tau_ms: Mapping[str, float]
    """Transmission time: mean, p50 and p99."""
    network_ms: Mapping[str, float]
    """From sending to arrival: waiting, transmission and delay."""
    network_p99_ms: float | None
    """Of all frames, dropped ones among them."""
    share_within: Mapping[str, float]
    """Share of the frames that came in time, by the budget in ms."""
    network_quantiles_ms: Sequence[float | None]
    """At equal steps of the share, from 0 to 1."""

    @property
    def sender(self) -> str:
        """Drive and method in a few words."""
        return _sender(self)


@dataclass(frozen=True)
class ShownRow:
    """One sender's frames from capture to shown, with what both ends compute. None: that quantile
    of the frames never came."""

    scene: str
    hz: float
    method: str
    crf: float
    psnr_db: float
    width_px: int
    height_px: int
    link: str
    rate_bps: float
    frames: int
    dropped: int
    """Frames that a newer one overtook before they were coded."""
    sent_ms: Mapping[str, float]
    """Of the frames that were sent: mean, p50 and p99."""
    shown_p50_ms: float | None
    """Of all frames, dropped ones among them."""
    shown_p99_ms: float | None
    share_within: Mapping[str, float]
    """Share of all frames that were shown in time, by the budget in ms."""
    sender_busy_percent: float
    """Of the time, one core of the vehicle."""
    receiver_busy_percent: float


def _sender(row: NeededRow | PlayedRow | ShownRow) -> str:
    return f"{row.scene} {row.hz:g} Hz, {row.method.split('-')[0]}"


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


def latency_section(path: Path, result: Result) -> str:
    """Return the tables: what uplink is needed, and what each link makes of the frames."""
    requirement = result["requirement"]
    notes = (
        f"Both methods at the same luma PSNR; the first frame, which a stream sends once, apart. "
        f"{result['played_frames']} frames are played over each link (the clip again and again), "
        f"with at most two under way; a frame dropped before coding counts as late. They cannot "
        f"show {100 * requirement['share']:g} %: to claim that with 95 % confidence, "
        f"{requirement['frames_needed']:,} different frames in a row would have to be in time."
    )
    carried = (
        "From sending to arrival in ms: half of the frames that were sent, 99 % of all frames "
        f"(how many were dropped); {path.name} has more quantiles."
    )
    computed = (
        "From capture to shown: either end computes with one thread, one frame at a time, as long "
        "as that frame took when it was measured, and frames wait for it; a vehicle codes the "
        "newest picture, and older ones are dropped. In ms half and 99 % of the frames that were "
        "sent, and how many of all were shown within 100 ms."
    )
    needed = [_needed_cells(row) for row in rows_of(NeededRow, result["needed"])]
    played = rows_of(PlayedRow, result["rows"])
    shown = rows_of(ShownRow, result["shown"])
    tables = (
        carried,
        pivot("sender", ((_sender(row), row.link, _played_cell(row)) for row in played)),
        computed,
        pivot("sender", ((_sender(row), row.link, _shown_cell(row)) for row in shown)),
    )
    return "\n\n".join([heading(path, result), notes, table(NEEDED, needed), *tables, ""])


def print_needed(console: Console, rows: Sequence[NeededRow]) -> None:
    """Print what uplink each sender needs."""
    columns = (*NEEDED[:4], "kbit", "p99 <= 5 ms, Mbit/s", "p99 <= 10 ms, Mbit/s")
    cells = [[*_needed_cells(row)[:5], *_needed_cells(row)[-2:]] for row in rows]
    print_table(console, "Uplink that 99 % of the frames need", columns, cells)


def write_latency_figures(result: Result, folder: Path) -> list[Path]:
    """Write ``tau_vs_throughput``, ``latency_cdf`` and ``stage_stack`` (SVG and CSV).

    Raises ``InvalidInput`` for a result without rows.
    """
    played = rows_of(PlayedRow, result["rows"])
    needed = rows_of(NeededRow, result["needed"])
    if not (played and needed):
        raise InvalidInput("result", "there is no row to draw")
    return [
        *_tau_figure(played, folder / "tau_vs_throughput"),
        *_cdf_figure(played, folder / "latency_cdf"),
        *_stack_figure(needed, played, folder / "stage_stack"),
    ]


def _needed_cells(row: NeededRow) -> list[str]:
    uplink = row.uplink_bps_p99_within
    return [
        row.scene,
        f"{row.hz:g}",
        row.method,
        f"{row.psnr_db:.2f}",
        f"{row.kbit_per_frame:.1f}",
        f"{row.largest_kbit:.1f}",
        f"{row.first_frame_kbit:.1f}",
        *(f"{uplink[budget] / 1e6:.2f}" for budget in ("5", "10")),
    ]


def _played_cell(row: PlayedRow) -> str:
    dropped = f" ({100 * row.dropped / row.frames:.0f} %)" if row.dropped else ""
    return f"{row.network_ms['p50']:.2f} / {_ms(row.network_p99_ms)}{dropped}"


def _shown_cell(row: ShownRow) -> str:
    in_time = 100 * row.share_within["100"]
    return f"{row.sent_ms['p50']:.0f} / {row.sent_ms['p99']:.0f}, {in_time:.0f} %"


def _ms(value: float | None) -> str:
    return "never" if value is None else f"{value:.2f}"


def _by_sender(rows: Sequence[PlayedRow]) -> dict[str, list[PlayedRow]]:
    senders: dict[str, list[PlayedRow]] = {}
    for row in rows:
        senders.setdefault(row.sender, []).append(row)
    return senders


def _tau_figure(played: Sequence[PlayedRow], stem: Path) -> list[Path]:
    from matplotlib import pyplot as plt

    from rfedge.report.charts import LINES, MARKERS, STYLE, write_figure

    lines = [["sender", "Mbit/s", "mean tau ms"]]
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(7.2, 3.2))
        senders = _by_sender([row for row in played if row.link.endswith("Mbit/s")])
        for number, (name, rows) in enumerate(senders.items()):
            x = [row.rate_bps / 1e6 for row in rows]
            y = [row.tau_ms["mean"] for row in rows]
            style: dict[str, Any] = {"color": LINES[number % 6], "marker": MARKERS[number % 6]}
            axes.plot(x, y, label=name, linewidth=1.5, markersize=4, **style)
            lines += [[name, f"{a:g}", f"{b:.3f}"] for a, b in zip(x, y, strict=True)]
        axes.axhspan(5, 10, color="#dfe4ea", zorder=0, label="budgets: 5 to 10 ms")
        axes.set(xscale="log", yscale="log", xlabel="throughput, Mbit/s", ylabel="tau, ms a frame")
        axes.legend(frameon=False, ncols=2, loc="lower left", bbox_to_anchor=(0, 1), fontsize=9)
    return write_figure(stem, figure, lines)


def _cdf_figure(played: Sequence[PlayedRow], stem: Path) -> list[Path]:
    from matplotlib import pyplot as plt

    from rfedge.report.charts import LINES, STYLE, write_figure

    lines = [["sender", "share", "network ms"]]
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(7.2, 3.2))
        drawn = [row for row in played if row.rate_bps == CDF_RATE_BPS]
        for number, row in enumerate(drawn):
            quantiles = row.network_quantiles_ms
            arrived = [(ms, k / (len(quantiles) - 1)) for k, ms in enumerate(quantiles) if ms]
            x, y = zip(*arrived, strict=True)
            axes.step(x, y, where="post", color=LINES[number % 6], label=row.sender)
            lines += [[row.sender, f"{b:.2f}", f"{a:.3f}"] for a, b in arrived]
        axes.axvspan(5, 10, color="#dfe4ea", zorder=0, label="budgets: 5 to 10 ms")
        axes.set(xlabel=f"network latency at {CDF_RATE_BPS / 1e6:g} Mbit/s, ms", ylabel="share")
        axes.legend(frameon=False, ncols=2, loc="lower left", bbox_to_anchor=(0, 1), fontsize=9)
    return write_figure(stem, figure, lines)


def _stack_figure(
    needed: Sequence[NeededRow], played: Sequence[PlayedRow], stem: Path
) -> list[Path]:
    from matplotlib import pyplot as plt

    from rfedge.report.charts import LINES, STYLE, write_figure

    network = {r.sender: r.network_ms["p50"] for r in played if r.rate_bps == CDF_RATE_BPS}
    stacks = {row.sender: {**row.stage_ms, "network": network[row.sender]} for row in needed}
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
