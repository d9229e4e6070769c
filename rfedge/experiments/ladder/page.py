"""``docs/ladder.md`` and the ladder's figure, from ``results/ladder.json``: generated, never typed.

``python -m rfedge.experiments.ladder.page results docs`` (``make figures``). The page shows one
CRF, the middle one; the file has the others.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rfcore.files import write_whole
from rfedge.report.markdown_parts import heading, table

__all__ = ["ladder_page", "middle_rows", "write_ladder_figure"]

Row = Mapping[str, Any]

INTRODUCTION = """# What accuracy costs in time

Generated from `results/ladder.json` by `make figures`. A rung is everything a sender may decide
about a frame but its CRF; `cav-agent --deadline-ms 33 --ladder results/ladder.json` picks the best
one that fits, and steps down and up while it drives.

* **Times** are milliseconds of processor time a frame with one thread, lower quartiles over the
  drive without its first frame: what one core needs when nothing disturbs it. The sender's hold
  conversion, render, choice of references, x264 and the closed loop; the receiver's render,
  references, splice and decoding. Renders are timed once per quality. Where other programs ran
  beside it, rungs that do the same work (with and without `no-light`) show how far a time is off.
* **Bits** are those of the whole message. **Rate** is bits at equal quality against the first rung
  of the first field (the mean over the qualities both reach): what a rung costs the link. A cheaper
  rung is not worse in quality at the same CRF, it needs more bits for it.
* **Front**: no other rung at this CRF takes less time without more bits at equal quality.
* Names: share of the splats drawn (or samples along a ray), `shN` harmonics of at most that degree,
  `half-size` rendered at half the width and height, `Nref` at most N references, `render-only` the
  paper's single one, `no-light` without looking for a change of light, `rough` with cheaper copies
  of the references for x264 to predict from, x264's preset.
"""

STAGES = (
    ("convert", "convert"),
    ("render", "render"),
    ("references", "references"),
    ("encode", "encode"),
    ("closed_loop", "closed loop"),
)
COLUMNS = (
    "rung",
    "front",
    "sender ms",
    "receiver ms",
    "kbit",
    "PSNR dB",
    "SSIM",
    "rate %",
    *(title for _, title in STAGES),
)


def ladder_page(result: Row, runs: Mapping[str, Row]) -> str:
    """Return the page of a ladder and of training runs (by name), which are its offline side."""
    rows = middle_rows(result)
    front = sorted((r for r in rows if r["on_front"]), key=lambda r: r["sender_ms"])
    sections = [
        INTRODUCTION,
        heading(Path("ladder"), result).replace("## ladder", "## Where it was measured"),
        _fields(result),
        "![sender time against rate](figures/ladder_pareto.svg)",
        f"## The front at CRF {_crf(rows):g}",
        _table(front),
        "## Every rung",
        _table(sorted(rows, key=lambda r: (r["settings"]["kind"], r["rate_percent"]))),
        "## CRF",
        "The first rung at each CRF:",
        _table([r for r in result["rows"] if _without_crf(r) == _without_crf(rows[0])]),
        "## The offline side",
        _offline(runs),
    ]
    return "\n\n".join(section.strip("\n") for section in sections) + "\n"


def middle_rows(result: Row) -> list[Row]:
    """Return the rows at the middle CRF."""
    crfs = sorted({row["settings"]["crf"] for row in result["rows"]})
    middle = crfs[len(crfs) // 2]
    return [row for row in result["rows"] if row["settings"]["crf"] == middle]


def write_ladder_figure(result: Row, folder: Path) -> list[Path]:
    """Write ``ladder_pareto.svg`` and its numbers as CSV; return their paths."""
    from matplotlib import pyplot as plt

    from rfedge.report.charts import BLUE, GREY, LINES, STYLE, write_figure

    rows = middle_rows(result)
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(7.2, 3.6))
        kinds = dict.fromkeys(row["settings"]["kind"] for row in rows)
        for kind, colour in zip(kinds, (GREY, LINES[1]), strict=False):
            of_kind = [row for row in rows if row["settings"]["kind"] == kind]
            x, y = [r["sender_ms"] for r in of_kind], [r["rate_percent"] for r in of_kind]
            axes.scatter(x, y, s=14, color=colour, label=kind)
        front = sorted((r for r in rows if r["on_front"]), key=lambda r: r["sender_ms"])
        x, y = [r["sender_ms"] for r in front], [r["rate_percent"] for r in front]
        axes.plot(x, y, color=BLUE, marker="o", markersize=4, linewidth=1.5, label="front")
        axes.set(
            xlabel="sender, ms of processor time a frame",
            ylabel="bits at equal quality, % more",
            xscale="log",
        )
        axes.legend(frameon=False, ncols=3, loc="lower left", bbox_to_anchor=(0, 1), fontsize=9)
    lines = [["rung", "sender_ms", "receiver_ms", "rate_percent", "kbit", "psnr_db", "on_front"]]
    for row in sorted(rows, key=lambda r: r["sender_ms"]):
        numbers = (row["sender_ms"], row["receiver_ms"], row["rate_percent"])
        lines.append(
            [
                row["rung"],
                *(f"{number:.2f}" for number in numbers),
                f"{row['bits_per_frame'] / 1e3:.2f}",
                f"{row['psnr_db']:.3f}",
                str(int(row["on_front"])),
            ]
        )
    return write_figure(folder / "ladder_pareto", figure, lines)


def _fields(result: Row) -> str:
    width, height = result["size_px"]
    parts = [
        f"{f['kind']} of {f['primitives']:,} primitives"
        + (f", {f['held_out_psnr_db']:.2f} dB held out" if f["held_out_psnr_db"] else "")
        for f in result["fields"]
    ]
    frames = result["frames"]
    return (
        f"{width}x{height}, {frames['count']} frames of `{frames['drive']}`; fields: "
        f"{'; '.join(parts)}."
    )


def _table(rows: Sequence[Row]) -> str:
    return table(COLUMNS, [_cells(row) for row in rows])


def _cells(row: Row) -> list[str]:
    stages = row["sender_stage_ms"]
    return [
        row["rung"],
        "yes" if row["on_front"] else "",
        f"{row['sender_ms']:.1f}",
        f"{row['receiver_ms']:.1f}",
        f"{row['bits_per_frame'] / 1e3:.1f}",
        f"{row['psnr_db']:.2f}",
        f"{row['ssim']:.3f}",
        f"{row['rate_percent']:+.1f}",
        *(f"{stages[name]:.1f}" for name, _ in STAGES),
    ]


def _without_crf(row: Row) -> dict[str, Any]:
    return {name: value for name, value in row["settings"].items() if name != "crf"}


def _crf(rows: Sequence[Row]) -> float:
    return float(rows[0]["settings"]["crf"])


def _offline(runs: Mapping[str, Row]) -> str:
    """Return quality over training time, of every run that kept its curve."""
    lines = [
        [name, f"{seconds:.0f}", f"{quality_db:.2f}"]
        for name, run in runs.items()
        for seconds, quality_db in _thinned(run.get("curve", ()))
    ]
    if not lines:
        return "No training run is recorded."
    return (
        "Seconds of training and quality on pictures the field was not trained on, from the runs "
        "in `results/train` (their commands: `docs/results.md`). Samples per pixel of the ground "
        "truth were not varied.\n\n" + table(("run", "seconds", "held out dB"), lines)
    )


def _thinned(curve: Sequence[Sequence[float]]) -> Sequence[Sequence[float]]:
    """Return about five points of a curve, its last among them."""
    step = max(1, len(curve) // 5)
    return list(curve)[::-1][::step][::-1]


def main(results: Path, docs: Path) -> None:
    """Write page and figure."""
    result = json.loads((results / "ladder.json").read_text())
    runs = {p.stem: json.loads(p.read_text()) for p in sorted(results.glob("train/*.json"))}
    write_whole(docs / "ladder.md", ladder_page(result, runs))
    write_ladder_figure(result, docs / "figures")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
