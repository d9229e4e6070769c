"""Sections of the results page about a comparison, the never-worse table and the published test."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rfedge.experiments.paper.figures import means_of
from rfedge.report.markdown_parts import Row, heading, table

__all__ = ["compare_section", "never_worse_section", "paper_section"]

COMPARE_COLUMNS = (
    "scene",
    "Hz",
    "method",
    "rival",
    "window dB",
    "BD-rate %",
    "95 %",
    "saving at 31 / 33 / 35 dB, %",
    "SSIM",
    "rival's",
    "deviation dB",
    "rival's",
    "first frame kB",
    "rival's",
    "CPU ms",
    "rival's",
    "field dB",
)
SAVING_AT_DB = ("31", "33", "35")
"""A quality that a curve does not reach has no saving."""
BREAK_EVEN_COLUMNS = (
    "scene",
    "Hz",
    "method",
    "saved kB a pass",
    "field MB",
    "passes to break even",
    "saving after 1 / 10 / 100 passes, %",
)
NEVER_COLUMNS = (
    "scene",
    "Hz",
    "field",
    "dB",
    "bytes",
    "of them header",
    "x264",
    "excess without header %",
    "against x264 tuned for PSNR %",
    "at most 2 %",
    "mostly predicted from",
    "CPU ms",
    "x264's",
)
PAPER_COLUMNS = (
    "field",
    "scene",
    "size",
    "render",
    "frames",
    "100 I/(I+P) %",
    "sd",
    "95 %",
    "RF dB",
    "SSIM",
    "LPIPS",
    "FLIP",
    "residual by band",
)


def compare_section(path: Path, result: Row) -> str:
    """Return a comparison as tables; bytes count the whole message of a frame, header included."""
    compared = [_compare_cells(row) for row in result["rows"]]
    parts = [heading(path, result), table(COMPARE_COLUMNS, compared)]
    if result.get("break_even"):
        cells = [_break_even_cells(row) for row in result["break_even"]]
        parts += ["What the field's own bytes leave:", table(BREAK_EVEN_COLUMNS, cells)]
    if result.get("bits"):
        parts += ["Where the bits go, near 33.5 dB (bytes a frame; share of the macroblocks):"]
        parts += [_bits_table(result["bits"])]
    parts += [_foreground_line(row) for row in result.get("foreground", ())]
    return "\n\n".join([*parts, ""])


def never_worse_section(path: Path, result: Row) -> str:
    """Return the never-worse table."""
    rows = [
        [
            row["scene"],
            f"{row['hz']:g}",
            row["control"],
            f"{row['at_db']:g}",
            f"{row['bytes']:.0f}",
            f"{row['header_bytes']:.0f}",
            f"{row['rival_bytes']:.0f}",
            f"{row['excess_percent']:+.1f}",
            f"{row['excess_percent_psnr_tuned']:+.1f}",
            "yes" if row["holds"] else "**no**",
            row["references"],
            f"{row['cpu_ms']:.0f}",
            f"{row['rival_cpu_ms']:.0f}",
        ]
        for row in result["rows"]
    ]
    return "\n\n".join([heading(path, result), table(NEVER_COLUMNS, rows), ""])


def paper_section(path: Path, result: Row) -> str:
    """Return the published experiment's table; means over presets and CRFs, then over frames."""
    rows = [
        [
            mean.field,
            mean.scene,
            "{}x{}".format(*mean.size_px),
            mean.making,
            str(mean.frames),
            f"{mean.savings_percent:.1f}",
            f"{mean.sd_percent:.1f}",
            f"±{mean.ci95_percent:.1f}",
            f"{mean.rf_psnr_db:.2f}",
            f"{mean.rf_ssim:.3f}",
            "n/a",
            "-" if mean.rf_flip is None else f"{mean.rf_flip:.3f}",
            " / ".join(f"{ratio:.2f}" for ratio in mean.bands),
        ]
        for mean in means_of(result["rows"])
    ]
    bands = ", ".join("{:.3g}..{:.3g}".format(*band) for band in result["bands_cycles_per_px"])
    note = (
        "`name:behind` and `name:grey` are controls (medium, CRF 23). Residual: luma energy of "
        f"camera - render over the camera's, by cycles a pixel {bands}. LPIPS {result['lpips']}."
    )
    return "\n\n".join([heading(path, result), table(PAPER_COLUMNS, rows), note, ""])


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
        f"{row['ssim']:.3f}",
        f"{row['rival_ssim']:.3f}",
        f"{row['psnr_deviation_db']:.2f}",
        f"{row['rival_psnr_deviation_db']:.2f}",
        f"{row['first_frame_bytes'] / 1000:.1f}",
        f"{row['rival_first_frame_bytes'] / 1000:.1f}",
        f"{row['cpu_ms']:.0f}",
        f"{row['rival_cpu_ms']:.0f}",
        "-" if quality_db is None else f"{quality_db:.2f}",
    ]


def _break_even_cells(row: Row) -> list[str]:
    passes = row["passes_to_break_even"]
    return [
        row["scene"],
        f"{row['hz']:g}",
        row["method"].rsplit("-", 1)[0],
        f"{row['saved_bytes_per_pass'] / 1000:.1f}",
        f"{row['field_bytes'] / 1e6:.2f}",
        "never" if passes is None else str(passes),
        " / ".join(f"{saving:.0f}" for saving in row["saving_percent_after"].values()),
    ]


def _bits_table(rows: Sequence[Row]) -> str:
    kinds = list(dict.fromkeys(row["shows"] for row in rows))
    drives = list(dict.fromkeys((row["scene"], row["hz"]) for row in rows))
    lines = []
    for scene, hz in drives:
        those = {row["shows"]: row for row in rows if (row["scene"], row["hz"]) == (scene, hz)}
        cells = [
            f"{those[kind]['bytes_per_frame']:.0f} ({those[kind]['area_percent']:.0f} %)"
            for kind in kinds
        ]
        lines.append([scene, f"{hz:g}", *cells])
    return table(("scene", "Hz", *kinds), lines)


def _foreground_line(row: Row) -> str:
    if row["bd_rate_percent"] is None:
        against = "they share no window of a decibel"
    else:
        low, high = row["window_db"]
        against = (
            f"ours, the whole picture, has a BD-rate of {row['bd_rate_percent']:+.0f} % at equal "
            f"quality of the foreground ({low:.1f}..{high:.1f} dB)"
        )
    return (
        f"Foreground only, RFDVC-style, {row['scene']} at {row['hz']:g} Hz "
        f"({row['foreground_percent']:.0f} % of the pixels; {row['mask']}): the whole picture "
        f"never passes {row['whole_picture_ceiling_db']:.2f} dB; {against}."
    )
