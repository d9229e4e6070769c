"""The section of a recorded demo on the results page."""

from __future__ import annotations

from pathlib import Path

from rfedge.demo.report import METRIC, SUMMARY, figures_of
from rfedge.report.tables import heading, table
from rfedge.results import Result

__all__ = ["demo_section"]


def demo_section(path: Path, result: Result) -> str:
    """Return the summary and the published metric of each drive as a table."""
    drives = figures_of(result)
    rows = [
        [f"{label} ({note})", *(show(drive) for drive in drives.values())]
        for label, note, show in SUMMARY
    ]
    rows += [
        [f"100·I/(I+P) with {label}", *(f"{show(drive):.1f} %" for drive in drives.values())]
        for label, show in METRIC
    ]
    settings, field = result["settings"], result["field"]
    facts = (
        f"Field of {field['gaussians']:,} Gaussians, {field['held_out_psnr_db']:.2f} dB on the "
        f"held-out empty drive; coder {settings['effort']}, CRF {settings['crf']:g}, "
        f"{settings['rate_hz']:g} Hz, link {settings['link_bps'] / 1e6:g} Mbit/s and "
        f"{settings['link_delay_ms']:g} ms."
    )
    return "\n\n".join([heading(path, result), facts, table(["", *drives], rows), ""])
