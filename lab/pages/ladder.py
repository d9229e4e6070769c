"""The page of the recorded ladder, and the ladder that ships with ``cav-agent``.

The one that ships has the rungs, their times and their rates::

    python -m lab.pages.ladder > cav_agent/ladder.json
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from rfcore.codec.sender.ladder import quality_name
from rfcore.field.quality import Quality
from rfedge.evaluate.ladder.rows import (
    FIGURES,
    LadderRow,
    TrackingRow,
    front_of,
    front_table,
    middle_rows,
)
from rfedge.report.tables import Column, Table, columns
from rfedge.results import Result, read_result, rows_of

RECORDED = Path(__file__).parents[1] / "results/ladder.json"
MADE = ("kind", "command", "revision", "host", "threads", "size_px", "fields")
SHIPPED_RUNG = ("settings", "sender_ms", "receiver_ms", "rate_percent")
SHIPPED_TRACKING = ("settings", "tracking", "track_ms", "rate_percent")
STAGES = ("convert", "render", "references", "encode", "closed_loop")
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


def shipped_ladder(result: Result) -> str:
    """Return the content of the file that ships: how it was made, and a line for each rung."""
    head = {key: result[key] for key in MADE}
    rows, tracking = (
        _lines(result["rows"], SHIPPED_RUNG),
        _lines(result["tracking"], SHIPPED_TRACKING),
    )
    text = json.dumps(head, indent=1).removesuffix("\n}")
    return f'{text},\n "rows": [\n{rows}\n ],\n "tracking": [\n{tracking}\n ]\n}}\n'


def _lines(rows: Iterable[Mapping[str, Any]], keys: tuple[str, ...]) -> str:
    kept = ({key: row[key] for key in keys if key in row} for row in rows)
    return ",\n".join(f"  {json.dumps(row)}" for row in kept)


if __name__ == "__main__":
    print(shipped_ladder(read_result(RECORDED, "ladder")), end="")
