"""The rows of a ladder, the tables that show them, and the figure of times against rates."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rfcore.codec.sender.ladder import quality_name
from rfcore.errors import InvalidInput
from rfcore.field.quality import Quality
from rfedge.report.tables import Column, Table, columns, shown
from rfedge.results import Result, rows_of

__all__ = [
    "LadderRow",
    "TrackingRow",
    "front_of",
    "front_table",
    "ladder_parts",
    "middle_rows",
    "write_ladder_figure",
]


@dataclass(frozen=True)
class LadderRow:
    """One rung at one CRF. Times are of the processor, in ms a frame, at one thread."""

    rung: str = field(metadata=shown("rung"))
    settings: Mapping[str, Any]
    """What ``rfcore.codec.sender.ladder`` reads the rung from."""
    sender_ms: float = field(metadata=shown("sender ms", ".1f"))
    receiver_ms: float = field(metadata=shown("receiver ms", ".1f"))
    sender_wall_ms: float
    """Time by the clock, as ``receiver_wall_ms``: other processes count."""
    receiver_wall_ms: float
    sender_stage_ms: Mapping[str, float]
    receiver_stage_ms: Mapping[str, float]
    bits_per_frame: float
    psnr_db: float = field(metadata=shown("PSNR dB", ".2f"))
    ssim: float = field(metadata=shown("SSIM", ".3f"))
    references_used: Mapping[str, int]
    """Number of frames by what they were predicted from."""
    rate_percent: float = field(metadata=shown("rate %", "+.1f"))
    """Bits at equal quality above the first rung's."""
    on_front: bool

    @property
    def crf(self) -> float:
        """Rate factor that the rung was measured at."""
        return float(self.settings["crf"])

    @property
    def other_settings(self) -> dict[str, Any]:
        """All settings but the CRF."""
        return {name: value for name, value in self.settings.items() if name != "crf"}


@dataclass(frozen=True)
class TrackingRow:
    """One effort of finding the pose in the field at one quality; without times if a picture of
    the drive was lost. Times are of the processor, in ms a frame, at one thread."""

    settings: Mapping[str, Any]
    """The kind of field and its quality, as in ``LadderRow``."""
    tracking: str = field(metadata=shown("tracking"))
    """``rfcore.codec.sender.ladder.TrackingEffort``."""
    track_ms: float | None = field(default=None, metadata=shown("ms", ".1f", "lost"))
    """Time beyond the one render that is made in any case."""
    renders: float | None = field(default=None, metadata=shown("renders", ".2f", ""))
    """Mean number of renders a frame."""
    rate_percent: float | None = field(default=None, metadata=shown("rate %", "+.1f", ""))
    """Bits at equal quality above those at the dataset's poses."""


KBIT = Column("kbit", lambda row: row.bits_per_frame / 1e3, ".1f")
STAGES = ("convert", "render", "references", "encode", "closed_loop")
FIGURES = ("rung", "sender_ms", "receiver_ms", KBIT, "psnr_db", "rate_percent")
WORDS = """\
* **Times** are milliseconds of processor time a frame with one thread, lower quartiles over
  the drive without its first frame: what one core needs when nothing disturbs it. The sender's hold
  conversion, render, choice of references, slice coder and closed loop; the receiver's render,
  references, splice and decoding. Renders are timed once per quality.
* **Bits** are those of the whole message. **Rate** is bits at equal quality against the first rung
  of the first field, the mean over the qualities both reach: what a rung costs the link.
* **Front**: no other rung at this CRF takes less time without more bits at equal quality.
* Names: share of the splats drawn (or samples along a ray), `shN` harmonics of at most that degree,
  `half-size` rendered at half the width and height, `Nref` at most N references, `render-only` the
  paper's single one, `no-light` without looking for a change of light, the slice coder's effort,
  `track-once` and `track-half` less effort of finding the pose."""
TRACKING = """\
What `cav-agent --localise` does on top of a rung, in milliseconds beyond the one render,
and what the poses found cost in bits at equal quality against the dataset's. `full`: the field is
drawn again if the first render's pose was off; `once`: drawn once; `half`: drawn once, and aligned
from half the resolution on. Under a deadline each rung is taken with each effort, and the times are
added. The vehicle leaves out an effort that lost a picture of the drive."""


def front_table(result: Result) -> Iterator[Table | str]:
    """Yield the rungs at the middle CRF that no other beats, the quickest first."""
    rows = middle_rows(rows_of(LadderRow, result["rows"]))
    yield Table(f"The front at CRF {rows[0].crf:g}", columns(LadderRow, *FIGURES), front_of(rows))


def ladder_parts(result: Result) -> Iterator[Table | str]:
    """Yield all of a ladder at the middle CRF; the file has the others."""
    every = rows_of(LadderRow, result["rows"])
    rows = middle_rows(every)
    yield _fields(result)
    yield WORDS
    yield from front_table(result)
    ordered = sorted(rows, key=lambda row: (row.settings["kind"], row.rate_percent))
    yield Table("Every rung", columns(LadderRow, *FIGURES, "ssim"), ordered)
    stages = [_stage(name) for name in STAGES]
    yield Table("Milliseconds of the sender's stages", columns(LadderRow, "rung", *stages), ordered)
    first = [row for row in every if row.other_settings == rows[0].other_settings]
    yield Table("The first rung at each CRF", columns(LadderRow, *FIGURES), first)
    tracked = rows_of(TrackingRow, result.get("tracking", ()))
    if tracked:
        yield TRACKING
        quality = Column("field", _quality_text)
        yield Table("Finding the pose", [quality, *columns(TrackingRow)], tracked)


def _stage(name: str) -> Column:
    return Column(name.replace("_", " "), lambda row: row.sender_stage_ms[name], ".1f")


def _quality_text(row: TrackingRow) -> str:
    stored = row.settings
    names = ("detail", "sh_degree", "samples_per_ray", "scale")
    return f"{stored['kind']} {quality_name(Quality(*(stored[name] for name in names)))}"


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


def middle_rows(rows: Sequence[LadderRow]) -> list[LadderRow]:
    """Return the rows at the middle CRF; raise ``InvalidInput`` if there is none."""
    if not rows:
        raise InvalidInput("result", "the ladder has no rows")
    crfs = sorted({row.crf for row in rows})
    return [row for row in rows if row.crf == crfs[len(crfs) // 2]]


def front_of(rows: Sequence[LadderRow]) -> list[LadderRow]:
    """Return the rows on the front, the quickest first."""
    return sorted((row for row in rows if row.on_front), key=lambda row: row.sender_ms)


def write_ladder_figure(result: Result, folder: Path, name: str) -> list[Path]:
    """Write the sender's time against the rate as SVG, and its numbers as CSV; return the paths.

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
        x, y = [r.sender_ms for r in front_of(rows)], [r.rate_percent for r in front_of(rows)]
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
    return write_figure(folder / name, figure, lines)
