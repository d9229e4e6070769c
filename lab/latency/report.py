"""The latency experiment's rows, as tables and as figures.

``scene``, ``hz`` and ``method`` name a sender in every kind of row; ``crf`` and ``psnr_db`` are the
operating point that its clip was coded at. Latencies are in milliseconds a frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lab.report import Report
from rfcore.errors import InvalidInput
from rfedge.report.tables import Column, Table, columns, shown
from rfedge.results import Result, rows_of


@dataclass(frozen=True)
class NeededRow:
    """The needs of one sender's frames: sizes, uplink, and computing at both ends."""

    scene: str
    hz: float
    method: str
    crf: float
    """The CRF that gives ``psnr_db``."""
    psnr_db: float = field(metadata=shown("dB", ".2f"))
    kbit_per_frame: float = field(metadata=shown("kbit a frame", ".1f"))
    """Mean over all frames but the first."""
    largest_kbit: float = field(metadata=shown("largest", ".1f"))
    first_frame_kbit: float = field(metadata=shown("first", ".1f"))
    uplink_bps_p99_within: Mapping[str, float]
    """Lowest constant rate at which 99 % of the frames are in time, by the budget in ms."""
    stage_ms: Mapping[str, float]
    """Processor time of each stage at one thread, lower quartiles."""


@dataclass(frozen=True)
class PlayedRow:
    """One sender's frames over one link. None: that quantile of the frames never came."""

    scene: str
    hz: float
    method: str
    crf: float
    psnr_db: float
    """Luma PSNR of the drive, the same for both methods."""
    link: str = field(metadata=shown("link"))
    rate_bps: float
    """Mean rate of the link."""
    frames: int
    """Frames played, the clip again and again."""
    dropped: int
    """Frames that were not sent because two were still under way."""
    tau_ms: Mapping[str, float]
    """Transmission time: mean, p50 and p99."""
    network_ms: Mapping[str, float]
    """Time from sending to arrival: waiting, transmission and delay."""
    network_p99_ms: float | None = field(metadata=shown("p99 ms", ".2f", "never"))
    """Quantile over all frames, dropped ones among them."""
    share_within: Mapping[str, float]
    """Share of the frames that came in time, by the budget in ms."""
    network_quantiles_ms: Sequence[float | None]
    """Quantiles of the network latency at equal steps of the share, from 0 to 1."""


@dataclass(frozen=True)
class ShownRow:
    """One sender's frames from capture to shown, with what both ends compute. None: that quantile
    of the frames never came."""

    scene: str
    hz: float
    method: str
    crf: float
    psnr_db: float
    """Luma PSNR of the drive, the same for both methods."""
    width_px: int
    height_px: int
    link: str = field(metadata=shown("link"))
    rate_bps: float
    """Mean rate of the link."""
    frames: int
    """Frames played, the clip again and again."""
    dropped: int
    """Frames that a newer one overtook before they were coded."""
    sent_ms: Mapping[str, float]
    """Latency of the frames that were sent: mean, p50 and p99."""
    shown_p50_ms: float | None
    """Quantiles over all frames, dropped ones among them."""
    shown_p99_ms: float | None
    share_within: Mapping[str, float]
    """Share of all frames that were shown in time, by the budget in ms."""
    sender_busy_percent: float
    """Share of the time that one core of the vehicle computes."""
    receiver_busy_percent: float
    """Share of the time that one core of the server computes."""
    pose_ahead: bool = False
    """Poses were sent ahead of their frames."""


def sender_of(row: NeededRow | PlayedRow | ShownRow) -> str:
    """Return drive and method in a few words."""
    return f"{row.scene} {row.hz:g} Hz, {row.method.split('-')[0]}"


CDF_RATE_BPS = 4e6
"""The rate whose distribution is drawn: the demo's link."""

SENDER = Column("sender", sender_of)
AHEAD = Column("pose ahead", lambda row: "yes" if row.pose_ahead else "no")
WITHIN_5 = Column(
    "uplink for 99 % within 5 ms, Mbit/s", lambda row: row.uplink_bps_p99_within["5"] / 1e6, ".2f"
)
WITHIN_10 = Column("within 10 ms", lambda row: row.uplink_bps_p99_within["10"] / 1e6, ".2f")
NETWORK_P50 = Column("sending to arrival, p50 ms", lambda row: row.network_ms["p50"], ".2f")
DROPPED = Column("dropped %", lambda row: 100 * row.dropped / row.frames, ".0f")
SHOWN_P50 = Column("to shown, p50 ms", lambda row: row.sent_ms["p50"], ".0f")
SHOWN_P99 = Column("p99 ms", lambda row: row.sent_ms["p99"], ".0f")
IN_TIME = Column("shown within 100 ms, %", lambda row: 100 * row.share_within["100"], ".0f")


def latency_parts(result: Result) -> Iterator[Table | str]:
    """Yield what uplink is needed, and what each link makes of the frames."""
    requirement = result["requirement"]
    yield (
        f"Both methods at the same luma PSNR; the first frame, which a stream sends once, apart. "
        f"{result['played_frames']} frames are played over each link (the clip again and again), "
        f"with at most two under way; a frame dropped before coding counts as late. They cannot "
        f"show {100 * requirement['share']:g} %: to claim that with 95 % confidence, "
        f"{requirement['frames_needed']:,} different frames in a row would have to be in time."
    )
    needed = rows_of(NeededRow, result["needed"])
    sizes = ("psnr_db", "kbit_per_frame", "largest_kbit", "first_frame_kbit", WITHIN_5, WITHIN_10)
    yield Table("What each sender needs", columns(NeededRow, SENDER, *sizes), needed)
    carried = columns(PlayedRow, "link", SENDER, NETWORK_P50, "network_p99_ms", DROPPED)
    played = rows_of(PlayedRow, result["rows"])
    yield Table(
        "The link alone: half of the frames that were sent, 99 % of all frames", carried, played
    )
    yield (
        "From capture to shown: either end computes with one thread, one frame at a time, as long "
        "as that frame took when it was measured, and frames wait for it; a vehicle codes the "
        "newest picture, and older ones are dropped."
    )
    seen = columns(ShownRow, "link", SENDER, AHEAD, SHOWN_P50, SHOWN_P99, DROPPED, IN_TIME)
    yield Table("From capture to shown", seen, rows_of(ShownRow, result["shown"]))


def write_latency_figures(result: Result, folder: Path, _name: str) -> list[Path]:
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


def _by_sender(rows: Sequence[PlayedRow]) -> dict[str, list[PlayedRow]]:
    senders: dict[str, list[PlayedRow]] = {}
    for row in rows:
        senders.setdefault(sender_of(row), []).append(row)
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
            axes.step(x, y, where="post", color=LINES[number % 6], label=sender_of(row))
            lines += [[sender_of(row), f"{b:.2f}", f"{a:.3f}"] for a, b in arrived]
        axes.axvspan(5, 10, color="#dfe4ea", zorder=0, label="budgets: 5 to 10 ms")
        axes.set(xlabel=f"network latency at {CDF_RATE_BPS / 1e6:g} Mbit/s, ms", ylabel="share")
        axes.legend(frameon=False, ncols=2, loc="lower left", bbox_to_anchor=(0, 1), fontsize=9)
    return write_figure(stem, figure, lines)


def _stack_figure(
    needed: Sequence[NeededRow], played: Sequence[PlayedRow], stem: Path
) -> list[Path]:
    from matplotlib import pyplot as plt

    from rfedge.report.charts import LINES, STYLE, write_figure

    network = {sender_of(r): r.network_ms["p50"] for r in played if r.rate_bps == CDF_RATE_BPS}
    stacks = {
        sender_of(row): {**row.stage_ms, "network": network[sender_of(row)]} for row in needed
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


REPORT = Report(
    "latency",
    "Latency over links",
    "How long our frames and those of x264 take over constant and recorded links at equal quality, "
    "and which uplink they need.",
    latency_parts,
    write_latency_figures,
)
