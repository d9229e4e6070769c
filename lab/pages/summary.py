"""The opening of the index: what was saved, in a sentence, five figures and one table."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from lab.pages.savings import (
    HIGH,
    WINDOWS,
    DriveSavings,
    percent,
    savings_of,
    span,
    times,
    write_bars,
)
from rfcore.errors import InvalidInput
from rfedge.evaluate.compare.rows import BEST_OF_ANY_CPU, HEADLINE_ANCHOR, CompareRow
from rfedge.report.tables import Table, text_table
from rfedge.results import Result

DRIVES = ("sample-empty", "sample-vehicles", "kitti-loop")
"""The drives of headlines: their fields are from other pictures than theirs."""
SAMPLE_SIZE = "640x360"
"""Size of the drives in ``samples/street``, whose names do not say it."""
SIZED = re.compile(r"(sample-(?:empty|vehicles))(?:-(\d+x\d+))?")
WEAKEST = 3
"""Drives of ``HARDER`` in the table: those that save least against the strongest rival."""
X264, STRONGEST = "x264 with our tools", "strongest rival"
FIGURES = {
    "first-drives": "Bits by drive, 32 to 35 dB",
    "first-sizes": "Bits by picture size, each size with a field of its own",
    "first-quality": "Bits by quality",
    "first-time": "Processor time of both ends",
    "first-losses": "Where least is saved, or more is spent",
}
"""Captions of the figures by the names of their files."""
LEGEND = """\
Bits are those of rfedge in percent more than the rival's at equal luma PSNR (BD-rate): below zero
is a saving. *x264* has every tool that our slices have, and no other, at preset medium; *strongest*
is the best of all rivals however slow, named in brackets. *ms* is processor time of sender and
receiver a frame: ours / that x264 / the strongest, on a shared machine: compare them within a row
alone. *MB* is the field, sent once; *drives until paid* says after how many such drives it is. The
last rows of the table are drives that save least: [where it loses](losses.md)."""

FILES = ("compare", "compare-harder", "compare-noise", "compare-size")
"""Comparisons with the fields that are meant to be used; ``compare-small`` tries smaller ones."""

HARDER = ("compare-harder", "compare-noise")

Named = Mapping[str, Result]
"""Comparisons by the names of their files."""


def comparisons(named: Iterable[tuple[str, Result]]) -> Named:
    """Return those of ``FILES``; raise ``InvalidInput`` without the first two."""
    found = {name: result for name, result in named if name in FILES}
    for name in FILES[:2]:
        if name not in found:
            raise InvalidInput("results", f"lab/results/{name}.json is missing: record it anew")
    return found


def summary_parts(compared: Named) -> Iterator[str | Table]:
    """Yield the sentence, the five figures and the table of ``comparisons``."""
    yield f"**{finding(compared)}**"
    for name, caption in FIGURES.items():
        yield f"![{caption}](figures/{name}.svg)"
    heads = (
        "drive",
        "x264, 32..35 dB",
        "x264, 35..38 dB",
        "strongest, 32..35 dB",
        "strongest, 35..38 dB",
        "ms",
        "MB",
        "drives until paid",
    )
    drives = [*main_drives(compared), *larger_sizes(compared), *weakest(compared)[:WEAKEST]]
    yield text_table(heads, [_line(each) for each in drives])
    yield LEGEND
    without = [f"`{name}`" for name, result in compared.items() if not _has_libaom(result)]
    if without:
        yield f"Recorded without libaom, which may be stronger: {', '.join(without)}."


def finding(compared: Named) -> str:
    """Return what was saved on the main drives, at what cost, and the worst case, in a sentence."""
    main = main_drives(compared)
    worst = weakest(compared)[0]
    saved = [
        span(-row.bd_rate_percent for row in rows) for rows in zip(*map(_both, main), strict=True)
    ]
    ratio = span((each.time_ratio for each in main), " times")
    change = worst.best.bd_rate_percent
    return (
        f"rfedge sends {saved[0]} fewer bits than x264 with the same tools and {saved[1]} fewer "
        f"than the strongest rival, at equal PSNR, for {ratio} that x264's processor time; at "
        f"worst, on {worst.name}, {abs(change):.0f} % {'more' if change > 0 else 'fewer'} than the "
        "strongest rival."
    )


def _both(drive: DriveSavings) -> tuple[CompareRow, CompareRow]:
    return drive.anchor, drive.best


def _has_libaom(result: Result) -> bool:
    return any(row["rival_setting"].startswith("libaom") for row in result["rows"])


def main_drives(compared: Named) -> list[DriveSavings]:
    """Return the drives of headlines; raise ``InvalidInput`` if all are missing."""
    found = [each for each in savings_of(compared["compare"]) if each.scene in DRIVES]
    if not found:
        raise InvalidInput("rows", f"compare has none of {', '.join(DRIVES)}")
    return found


def larger_sizes(compared: Named) -> list[DriveSavings]:
    """Return the drives whose names end in a size, each with the field that stands first."""
    if "compare-size" not in compared:
        return []
    drives = savings_of(compared["compare-size"])
    return [each for each in drives if (m := SIZED.fullmatch(each.scene)) and m[2]]


def weakest(compared: Named) -> list[DriveSavings]:
    """Return the drives of ``HARDER``, the least saving against the strongest first."""
    harder = [each for name in HARDER if name in compared for each in savings_of(compared[name])]
    return sorted(harder, key=lambda each: -each.best.bd_rate_percent)


def _line(drive: DriveSavings) -> Sequence[str]:
    passes = None if drive.paid is None else drive.paid.passes_to_break_even
    return (
        drive.name,
        percent(drive.anchor),
        percent(drive.against(HEADLINE_ANCHOR, HIGH)),
        percent(drive.best, named=True),
        percent(drive.against(BEST_OF_ANY_CPU, HIGH), named=True),
        times(drive),
        "-" if drive.paid is None else f"{drive.paid.field_bytes / 1e6:.1f}",
        "-" if drive.paid is None else "never" if passes is None else f"{passes:,}",
    )


def write_summary_figures(compared: Named, folder: Path) -> list[Path]:
    """Draw the five figures with their numbers; return the files."""
    main, harder = main_drives(compared), weakest(compared)
    every = savings_of(compared["compare"])
    bits = "bits of ours, % more than the rival's"
    sized = [each for each in main if SIZED.fullmatch(each.scene)] + larger_sizes(compared)
    by_size = {_street_and_size(each): _bits(each) for each in sized}
    shown = [*main, *larger_sizes(compared)]
    return [
        *write_bars(folder / "first-drives", bits, {each.name: _bits(each) for each in every}),
        *write_bars(folder / "first-sizes", bits, dict(sorted(by_size.items(), key=_size_order))),
        *_write_quality(folder / "first-quality", main),
        *write_bars(
            folder / "first-time",
            "processor time of both ends, ms a frame",
            {each.name: _ms(each) for each in shown},
            is_log=True,
        ),
        *write_bars(folder / "first-losses", bits, {each.name: _bits(each) for each in harder}),
    ]


def _bits(drive: DriveSavings) -> Mapping[str, float]:
    return {X264: drive.anchor.bd_rate_percent, STRONGEST: drive.best.bd_rate_percent}


def _ms(drive: DriveSavings) -> Mapping[str, float]:
    return {
        "ours": drive.anchor.both_ends_ms[0],
        STRONGEST: drive.best.rival_both_ends_ms[0],
        X264: drive.anchor.rival_both_ends_ms[0],
    }


def _street_and_size(drive: DriveSavings) -> str:
    found = SIZED.fullmatch(drive.scene)
    assert found is not None
    return f"{found[1]}, {found[2] or SAMPLE_SIZE}"


def _size_order(named: tuple[str, object]) -> tuple[str, int]:
    street, _, size = named[0].partition(", ")
    return street, int(size.partition("x")[0])


def _write_quality(stem: Path, drives: Sequence[DriveSavings]) -> list[Path]:
    """Draw bits over the windows that every drive has, a line a drive and rival."""
    from matplotlib import pyplot as plt

    from rfedge.report.charts import LINES, MARKERS, STYLE, write_figure

    lines = [["drive", "rival", "low_db", "high_db", "bd_rate_percent"]]
    with plt.rc_context({**STYLE, "axes.grid.axis": "both"}):
        figure, axes = plt.subplots(figsize=(7.2, 3.4))
        for drive, colour, marker in zip(drives, LINES, MARKERS, strict=False):
            for rival, name, style in (
                (HEADLINE_ANCHOR, X264, "-"),
                (BEST_OF_ANY_CPU, STRONGEST, ":"),
            ):
                rows = [(w, row) for w in WINDOWS if (row := drive.against(rival, w)) is not None]
                x = [sum(window) / 2 for window, _ in rows]
                y = [row.bd_rate_percent for _, row in rows]
                axes.plot(x, y, style, color=colour, marker=marker, markersize=4)
                axes.lines[-1].set_label(f"{drive.scene}: {name}")
                lines += [
                    [drive.name, name, *map("{:g}".format, w), f"{row.bd_rate_percent:.6g}"]
                    for w, row in rows
                ]
        middles = [sum(window) / 2 for window in WINDOWS]
        axes.set_xticks(middles, ["{:g} to {:g}".format(*window) for window in WINDOWS])
        axes.set(xlabel="luma PSNR, dB", ylabel="bits of ours,\n% more than the rival's")
        axes.legend(frameon=False, ncols=2, loc="lower left", bbox_to_anchor=(0, 1), fontsize=8)
    return write_figure(stem, figure, lines)
