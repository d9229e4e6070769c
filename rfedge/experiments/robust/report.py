"""The robustness experiment as a figure and as a section of the results page."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rfedge.report.markdown_parts import heading, table

__all__ = ["robust_section", "write_robust_figure"]

Row = Mapping[str, Any]
LOSS_COLUMNS = ("method", "loss %", "RTT ms", "SSIM", "worst 5 % of frames")
REST_COLUMNS = ("condition", "level", "kbit a frame", "more %", "x264", "against x264 %")


def robust_section(path: Path, result: Row) -> str:
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
        [
            row["method"],
            f"{row['loss_percent']:g}",
            f"{row['rtt_ms']:g}",
            f"{row['ssim']:.4f}",
            f"{row['ssim_p5']:.4f}",
        ]
        for row in sorted(result["rows"], key=lambda r: (r["loss_percent"], r["rtt_ms"]))
    ]
    disturbed = [_disturbed_cells(row) for row in result["disturbances"]]
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


def _disturbed_cells(row: Row) -> list[str]:
    if "reason" in row:
        return [row["condition"], f"n/a: {row['reason']}", *["n/a"] * 4]
    return [
        row["condition"],
        row["level"],
        f"{row['kbit']:.1f}",
        f"{row['more_percent']:+.1f}",
        f"{row['x264_kbit']:.1f}",
        f"{row['against_x264_percent']:+.1f}",
    ]


def write_robust_figure(result: Row, folder: Path) -> list[Path]:
    """Write ``loss_ssim``: SSIM over loss, a line per method, a panel per round trip."""
    from matplotlib import pyplot as plt

    from rfedge.report.charts import LINES, MARKERS, STYLE, write_figure

    rows = result["rows"]
    methods = list(dict.fromkeys(row["method"] for row in rows))
    rtts = list(dict.fromkeys(row["rtt_ms"] for row in rows))
    with plt.rc_context(STYLE):
        figure, panels = plt.subplots(1, len(rtts), figsize=(7.2, 3.0), sharey=True, squeeze=False)
        for axes, rtt_ms in zip(panels[0], rtts, strict=True):
            for number, method in enumerate(methods):
                chosen = [r for r in rows if (r["method"], r["rtt_ms"]) == (method, rtt_ms)]
                x, y = [r["loss_percent"] for r in chosen], [r["ssim"] for r in chosen]
                style = {"color": LINES[number % 6], "marker": MARKERS[number % 6]}
                axes.plot(x, y, label=method, linewidth=1.5, markersize=4, **style)
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
    lines = [["method", "rtt_ms", "loss_percent", "ssim", "ssim_p5"]]
    for row in rows:
        numbers = (f"{row['rtt_ms']:g}", f"{row['loss_percent']:g}")
        lines.append([row["method"], *numbers, f"{row['ssim']:.5f}", f"{row['ssim_p5']:.5f}"])
    return write_figure(folder / "loss_ssim", figure, lines)
