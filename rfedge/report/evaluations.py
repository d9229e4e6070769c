"""The section of the results page about training runs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from rfedge.report.markdown_parts import Row, table

__all__ = ["training_section"]

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


def training_section(paths: Sequence[Path]) -> str:
    """Return a table of training runs, and the command of each."""
    runs = {path.stem: json.loads(path.read_text()) for path in paths}
    rows = [_run_cells(name, run) for name, run in runs.items()]
    commands = [
        f"* {name}: `{run['command']}` at `{run['revision']}`" for name, run in runs.items()
    ]
    return "\n\n".join(["## training", table(RUN_COLUMNS, rows), "\n".join(commands), ""])


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
