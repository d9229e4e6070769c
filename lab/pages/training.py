"""The section of recorded training runs on the results page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rfedge.report.tables import table
from rfedge.results import Result, read_result

__all__ = ["training_section"]

COLUMNS = (
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
    runs = {path.stem: read_result(path, "training") for path in paths}
    rows = [_cells(name, run) for name, run in runs.items()]
    commands = [
        f"* {name}: `{run['command']}` at `{run['revision']}`" for name, run in runs.items()
    ]
    return "\n\n".join(["## training", table(COLUMNS, rows), "\n".join(commands), ""])


def _cells(name: str, run: Result) -> list[str]:
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
