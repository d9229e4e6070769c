"""A ladder's rows, and what is made of them: ``docs/ladder.md``, the figure, the printed front.

``python -m rfedge.evaluate.ladder.page results docs`` (``make figures``). The page shows one
CRF, the middle one; the file has the others.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from rfcore.codec.sender.ladder import quality_name
from rfcore.errors import InvalidInput
from rfcore.field.quality import Quality
from rfcore.files import write_whole
from rfedge.report.tables import heading, print_table, table
from rfedge.results import Result, read_result, rows_of

__all__ = [
    "LadderRow",
    "TrackingRow",
    "ladder_page",
    "middle_rows",
    "print_front",
    "write_ladder_figure",
]


@dataclass(frozen=True)
class LadderRow:
    """One rung at one CRF. Times are of the processor, in ms a frame, at one thread."""

    rung: str
    settings: Mapping[str, Any]
    """What ``rfcore.codec.sender.ladder`` reads the rung from."""
    sender_ms: float
    receiver_ms: float
    sender_wall_ms: float
    """By the clock, as ``receiver_wall_ms``: other processes count."""
    receiver_wall_ms: float
    sender_stage_ms: Mapping[str, float]
    receiver_stage_ms: Mapping[str, float]
    bits_per_frame: float
    psnr_db: float
    ssim: float
    references_used: Mapping[str, int]
    """How many frames were predicted from what."""
    rate_percent: float
    """Bits at equal quality, more than the first rung's."""
    on_front: bool

    @property
    def crf(self) -> float:
        """Rate factor that the rung was measured at."""
        return float(self.settings["crf"])

    @property
    def other_settings(self) -> dict[str, Any]:
        """Everything but the CRF."""
        return {name: value for name, value in self.settings.items() if name != "crf"}


@dataclass(frozen=True)
class TrackingRow:
    """One effort of finding the pose in the field at one quality; without times where a picture of
    the drive was lost. Times are of the processor, in ms a frame, at one thread."""

    settings: Mapping[str, Any]
    """The kind of field and its quality, as in ``LadderRow``."""
    tracking: str
    """``rfcore.codec.sender.ladder.TrackingEffort``."""
    track_ms: float | None = None
    """Beyond the one render that is made in any case."""
    renders: float | None = None
    """A frame, mean."""
    rate_percent: float | None = None
    """Bits at equal quality, more than at the dataset's poses."""


INTRODUCTION = """# What accuracy costs in time

Generated from `lab/results/ladder.json` by `make figures`. A rung is everything a sender may decide
about a frame but its CRF; `cav-agent --deadline-ms 33 --ladder lab/results/ladder.json` picks the
best one that fits, and steps down and up while it drives.

* **Times** are milliseconds of processor time a frame with one thread, lower quartiles over the
  drive without its first frame: what one core needs when nothing disturbs it. The sender's hold
  conversion, render, choice of references, slice coder and closed loop; the receiver's render,
  references, splice and decoding. Renders are timed once per quality. Where other programs ran
  beside it, rungs that do the same work (with and without `no-light`) show how far a time is off.
* **Bits** are those of the whole message. **Rate** is bits at equal quality against the first rung
  of the first field (the mean over the qualities both reach): what a rung costs the link. A cheaper
  rung is not worse in quality at the same CRF, it needs more bits for it.
* **Front**: no other rung at this CRF takes less time without more bits at equal quality.
* Names: share of the splats drawn (or samples along a ray), `shN` harmonics of at most that degree,
  `half-size` rendered at half the width and height, `Nref` at most N references, `render-only` the
  paper's single one, `no-light` without looking for a change of light, the slice
  coder's effort, `track-once` and `track-half` less effort of finding the pose. Ladders from before
  that coder: `rough` with cheaper copies of the references for x264 to predict from, x264's preset.
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


def ladder_page(result: Result, runs: Mapping[str, Result]) -> str:
    """Return the page of a ladder and of training runs (by name), which are its offline side.

    Raises ``InvalidInput`` for a ladder without rows.
    """
    every = rows_of(LadderRow, result["rows"])
    rows = middle_rows(every)
    sections = [
        INTRODUCTION,
        heading(Path("ladder"), result).replace("## ladder", "## Where it was measured"),
        _fields(result),
        "![sender time against rate](figures/ladder_pareto.svg)",
        f"## The front at CRF {rows[0].crf:g}",
        _table(_front(rows)),
        "## Every rung",
        _table(sorted(rows, key=lambda row: (row.settings["kind"], row.rate_percent))),
        "## CRF",
        "The first rung at each CRF:",
        _table([row for row in every if row.other_settings == rows[0].other_settings]),
        "## Finding the pose",
        _tracking(rows_of(TrackingRow, result.get("tracking", ()))),
        "## The offline side",
        _offline(runs),
    ]
    return "\n\n".join(section.strip("\n") for section in sections) + "\n"


def middle_rows(rows: Sequence[LadderRow]) -> list[LadderRow]:
    """Return the rows at the middle CRF; raise ``InvalidInput`` if there is none."""
    if not rows:
        raise InvalidInput("result", "the ladder has no rows")
    crfs = sorted({row.crf for row in rows})
    return [row for row in rows if row.crf == crfs[len(crfs) // 2]]


def _front(rows: Sequence[LadderRow]) -> list[LadderRow]:
    return sorted((row for row in rows if row.on_front), key=lambda row: row.sender_ms)


def print_front(console: Console, result: Result) -> None:
    """Print the rungs at the middle CRF that no other beats, the quickest first."""
    columns = ("rung", "sender ms", "receiver ms", "kbit", "PSNR dB", "rate %")
    shown = [COLUMNS.index(name) for name in columns]
    front = [_cells(row) for row in _front(middle_rows(rows_of(LadderRow, result["rows"])))]
    cells = [[row[k] for k in shown] for row in front]
    print_table(console, "The front at the middle CRF", columns, cells)


def write_ladder_figure(result: Result, folder: Path) -> list[Path]:
    """Write ``ladder_pareto.svg`` and its numbers as CSV; return their paths.

    Raises ``InvalidInput`` for a ladder without rows.
    """
    from matplotlib import pyplot as plt

    from rfedge.report.charts import BLUE, GREY, LINES, STYLE, write_figure

    rows = middle_rows(rows_of(LadderRow, result["rows"]))
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(7.2, 3.6))
        kinds = dict.fromkeys(row.settings["kind"] for row in rows)
        for kind, colour in zip(kinds, (GREY, LINES[1]), strict=False):
            of_kind = [row for row in rows if row.settings["kind"] == kind]
            x, y = [r.sender_ms for r in of_kind], [r.rate_percent for r in of_kind]
            axes.scatter(x, y, s=14, color=colour, label=kind)
        x, y = [r.sender_ms for r in _front(rows)], [r.rate_percent for r in _front(rows)]
        axes.plot(x, y, color=BLUE, marker="o", markersize=4, linewidth=1.5, label="front")
        axes.set(
            xlabel="sender, ms of processor time a frame",
            ylabel="bits at equal quality, % more",
            xscale="log",
        )
        axes.legend(frameon=False, ncols=3, loc="lower left", bbox_to_anchor=(0, 1), fontsize=9)
    lines = [["rung", "sender_ms", "receiver_ms", "rate_percent", "kbit", "psnr_db", "on_front"]]
    for row in sorted(rows, key=lambda row: row.sender_ms):
        numbers = (row.sender_ms, row.receiver_ms, row.rate_percent)
        lines.append(
            [
                row.rung,
                *(f"{number:.2f}" for number in numbers),
                f"{row.bits_per_frame / 1e3:.2f}",
                f"{row.psnr_db:.3f}",
                str(int(row.on_front)),
            ]
        )
    return write_figure(folder / "ladder_pareto", figure, lines)


def _fields(result: Result) -> str:
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


def _table(rows: Sequence[LadderRow]) -> str:
    return table(COLUMNS, [_cells(row) for row in rows])


def _cells(row: LadderRow) -> list[str]:
    return [
        row.rung,
        "yes" if row.on_front else "",
        f"{row.sender_ms:.1f}",
        f"{row.receiver_ms:.1f}",
        f"{row.bits_per_frame / 1e3:.1f}",
        f"{row.psnr_db:.2f}",
        f"{row.ssim:.3f}",
        f"{row.rate_percent:+.1f}",
        *(f"{row.sender_stage_ms[name]:.1f}" for name, _ in STAGES),
    ]


def _tracking(rows: Sequence[TrackingRow]) -> str:
    """Return what finding the pose takes by quality and effort."""
    if not rows:
        return "Not measured here: `cav-agent --localise --deadline-ms` needs a ladder that has it."
    return (
        "What `cav-agent --localise` does on top of a rung, in milliseconds beyond the one render, "
        "and what the poses found cost in bits at equal quality against the dataset's. `full`: the "
        "field is drawn again where the first render's pose was off; `once`: drawn once; `half`: "
        "drawn once, and aligned from half the resolution on. Under a deadline each rung is taken "
        "with each effort, and the times are added. Where a picture of the drive was lost, the "
        "vehicle leaves the effort out.\n\n"
        + table(
            ("field", "tracking", "ms", "renders", "rate %"), [_tracking_cells(row) for row in rows]
        )
    )


def _tracking_cells(row: TrackingRow) -> list[str]:
    stored = row.settings
    quality = Quality(
        stored["detail"], stored["sh_degree"], stored["samples_per_ray"], stored["scale"]
    )
    cells = [f"{stored['kind']} {quality_name(quality)}", row.tracking]
    if row.track_ms is None or row.renders is None or row.rate_percent is None:
        return [*cells, "lost", "", ""]
    return [*cells, f"{row.track_ms:.1f}", f"{row.renders:.2f}", f"{row.rate_percent:+.1f}"]


def _offline(runs: Mapping[str, Result]) -> str:
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
    result = read_result(results / "ladder.json", "ladder")
    runs = {p.stem: read_result(p, "training") for p in sorted(results.glob("train/*.json"))}
    write_whole(docs / "ladder.md", ladder_page(result, runs))
    write_ladder_figure(result, docs / "figures")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
