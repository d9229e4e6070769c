"""Sections of the results page about comparisons with other codecs, and about training runs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from rfedge.report.markdown_parts import Row, heading, table

__all__ = ["compare_section", "training_section"]

COMPARE_COLUMNS = (
    "scene",
    "Hz",
    "method",
    "rival",
    "window dB",
    "BD-rate %",
    "95 %",
    "saving at 31 / 33 / 35 dB, %",
    "CPU ms",
    "rival's",
    "field dB",
)
SAVING_AT_DB = ("31", "33", "35")
"""A quality that a curve does not reach has no saving."""

RUN_COLUMNS = (
    "run",
    "views",
    "size",
    "held out dB",
    "SSIM",
    "seconds",
    "iterations",
    "primitives",
    "MB",
)


def compare_section(path: Path, result: Row) -> str:
    """Return a comparison as a table; bytes count the whole message of a frame, header included."""
    rows = [_compare_cells(row) for row in result["rows"]]
    return "\n\n".join([heading(path, result), table(COMPARE_COLUMNS, rows), ""])


def training_section(paths: Sequence[Path]) -> str:
    """Return a table of training runs, and the command of each."""
    runs = {path.stem: json.loads(path.read_text()) for path in paths}
    rows = [_run_cells(name, run) for name, run in runs.items()]
    commands = [
        f"* {name}: `{run['command']}` at `{run['revision']}`" for name, run in runs.items()
    ]
    return "\n\n".join(["## training", table(RUN_COLUMNS, rows), "\n".join(commands), ""])


def _compare_cells(row: Row) -> list[str]:
    low, high = row["ci95"]
    at_db = row["saving_percent_at_db"]
    savings = " / ".join(f"{at_db[db]:.0f}" if db in at_db else "-" for db in SAVING_AT_DB)
    quality_db = row["field_psnr_db"]
    return [
        row["scene"],
        f"{row['hz']:g}",
        row["method"].rsplit("-", 1)[0],
        f"{row['rival']} ({row['rival_setting']})",
        "{:g}..{:g}".format(*row["window_db"]),
        f"{row['bd_rate_percent']:.1f}",
        f"{low:.1f}..{high:.1f}",
        savings,
        f"{row['cpu_ms']:.0f}",
        f"{row['rival_cpu_ms']:.0f}",
        "-" if quality_db is None else f"{quality_db:.2f}",
    ]


def _run_cells(name: str, run: Row) -> list[str]:
    held_out = run["held_out"]
    psnr_db, ssim = held_out["psnr_db"], held_out["ssim"]
    return [
        name,
        str(run["views"]),
        f"{run['width']}x{run['height']}",
        "-" if psnr_db is None else f"{psnr_db:.2f}",
        "-" if ssim is None else f"{ssim:.3f}",
        f"{run['seconds']:.0f}",
        str(run["iterations"]),
        str(run["primitives"]),
        f"{run['bytes'] / 1e6:.1f}",
    ]
