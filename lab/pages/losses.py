"""The page of losses: where rfedge sends more bits, takes longer or waits, and why.

All figures are of result files; a reason is a sentence below its heading.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from statistics import median

from lab.pages.savings import (
    FIRST,
    HIGH,
    DriveSavings,
    percent,
    savings_of,
    signed_span,
    span,
    times,
)
from lab.pages.summary import Named, comparisons, main_drives, weakest
from rfedge.evaluate.compare.rows import BEST_OF_ANY_CPU, HEADLINE_ANCHOR
from rfedge.evaluate.never_worse.measure import NeverWorseRow
from rfedge.report.tables import Table, text_table
from rfedge.results import Result, rows_of

NOISE = re.compile(r"(.*) noise ([\d.]+)")
RIVALS_OF_SIZES = (HEADLINE_ANCHOR, "svtav1-lowdelay", "libaom-good-6", "libaom-good-3")
PASSES = ("1", "10", "100")
AGAINST = ("against x264 with our tools", "against the strongest")
Recorded = Mapping[str, Sequence[tuple[str, Result]]]
"""Results by kind, each with its file's name."""


def losses_parts(results: Recorded) -> Iterator[str | Table]:
    """Yield the page's sentence and picture, then each loss with its reason and figures.

    Raises ``InvalidInput`` without ``compare`` and ``compare-harder``.
    """
    compared = comparisons(results["compare"])
    drives = [each for name in compared for each in savings_of(compared[name])]
    yield f"**{finding(compared)}**"
    yield "![Where least is saved, or more is spent](figures/first-losses.svg)"
    yield (
        "Bits are those of rfedge in percent more than the rival's at equal luma PSNR, 32 to 35 dB "
        "unless a column says otherwise: above zero is a loss. *Strongest*: the best of all rivals "
        "that ran, however slow. What else flatters us is in "
        "[Evaluation](../../docs/explanation/evaluation.md#attack-these-numbers)."
    )
    yield from _rain(weakest(compared))
    yield from _noise(drives)
    yield from _high_quality(main_drives(compared))
    yield from _short_passes(main_drives(compared), results)
    yield from _wrong_field(drives, results)
    yield from _sizes(compared)
    yield from _time(drives)
    yield from _classes(results)


def finding(compared: Named) -> str:
    """Return on how many drives the strongest rival sends fewer bits, and which is worst."""
    harder = weakest(compared)
    lost = [each for each in harder if each.best.bd_rate_percent > 0]
    worst = harder[0]
    high = [
        row.bd_rate_percent
        for name in compared
        for each in savings_of(compared[name])
        if (row := each.against(BEST_OF_ANY_CPU, HIGH)) is not None
    ]
    change = worst.best.bd_rate_percent
    told = (
        f"Of {len(harder)} harder drives the strongest rival wins {len(lost)} at 32 to 35 dB, "
        f"{worst.name} with {change:+.0f} %"
        if lost
        else f"On none of {len(harder)} harder drives does the strongest rival send fewer bits at "
        f"32 to 35 dB; least is saved on {worst.name}, {-change:.0f} %"
    )
    wins = sum(value > 0 for value in high)
    return f"{told}; at 35 to 38 dB it wins {wins} of all {len(high)}."


def _rain(harder: Sequence[DriveSavings]) -> Iterator[str | Table]:
    wet = [each for each in harder if "rain" in each.scene and each.best.bd_rate_percent > 0]
    if not wet:
        return
    yield "## Rain"
    bare = [row.bd_rate_percent for each in wet if (row := each.without_field) is not None]
    also = f" Without the field our coder takes {signed_span(bare)} there." if bare else ""
    yield (
        "The field was made on a dry noon: haze and streaks are most of the picture, and no render "
        f"predicts them.{also}"
    )
    lines = [(each.name, *_against(each), percent(each.without_field), times(each)) for each in wet]
    heads = ("drive", *AGAINST, "our coder without the field, against that x264", MS)
    yield text_table(heads, lines)


def _noise(drives: Sequence[DriveSavings]) -> Iterator[str | Table]:
    noisy = {(found[1], each.hz): None for each in drives if (found := NOISE.fullmatch(each.scene))}
    lines = []
    for each in drives:
        found = NOISE.fullmatch(each.scene)
        scene, level = (found[1], found[2]) if found else (each.scene, "0")
        if (scene, each.hz) in noisy:
            lines.append((scene, level, *_against(each)))
    if lines:
        yield "## Noise"
        yield (
            "Noise of a sensor is in no field and in no earlier picture, so every coder has to "
            "send it, and less of the bits is what the field knows."
        )
        heads = ("drive", "noise, levels", *AGAINST)
        yield text_table(heads, sorted(dict.fromkeys(lines)))


def _high_quality(drives: Sequence[DriveSavings]) -> Iterator[str | Table]:
    shown = [each for each in drives if each.against(HEADLINE_ANCHOR, HIGH) is not None]
    if not shown:
        return
    yield "## High quality"
    renders_db = [db for each in shown if (db := each.anchor.field_psnr_db) is not None]
    of_renders = f" ({span(renders_db, ' dB')})" if renders_db else ""
    yield (
        f"A field saves most near the quality of its own renders{of_renders}; what a picture has "
        "beyond that, a residual has to carry."
    )
    lines = [
        (
            each.name,
            *_against(each),
            percent(each.against(HEADLINE_ANCHOR, HIGH)),
            percent(each.against(BEST_OF_ANY_CPU, HIGH), named=True),
        )
        for each in shown
    ]
    names = [
        f"{who}, {low:g}..{high:g} dB"
        for low, high in (FIRST, HIGH)
        for who in ("x264", "strongest")
    ]
    yield text_table(("drive", *names), lines)


def _short_passes(drives: Sequence[DriveSavings], results: Recorded) -> Iterator[str | Table]:
    paid = [(each.name, each.paid) for each in drives if each.paid is not None]
    if not paid:
        return
    yield "## Short passes, and the field's bytes"
    yield (
        "The field is sent once and does not count in the bits above; a vehicle that passes once "
        "never earns it back, and saves nothing until the field is there."
    )
    lines = [
        (
            name,
            f"{even.field_bytes / 1e6:.1f}",
            f"{even.frames_per_pass}",
            *(f"{-even.saving_percent_after[passes]:+,.0f} %" for passes in PASSES),
            "never" if even.passes_to_break_even is None else f"{even.passes_to_break_even:,}",
        )
        for name, even in paid
    ]
    after = [f"bits with the field, {passes} drives" for passes in PASSES]
    yield text_table(("drive", "field MB", "frames a drive", *after, "drives until paid"), lines)
    fetched = fetched_s(results.get("cold-start", ()))
    if fetched:
        waits = [(link, f"{median(seconds):.1f}") for link, seconds in fetched.items()]
        heads = ("link", "s until the whole field is there")
        yield text_table(heads, waits, "A cold start ([all of it](cold-start.md))")


def fetched_s(named: Iterable[tuple[str, Result]]) -> dict[str, list[float]]:
    """Return the seconds of cold starts until the field was whole, by link; now, not before."""
    found: dict[tuple[str, int], float] = {}
    for _, result in named:
        for row in result["rows"]:
            is_now = row["code"] != "before" and row["cache"] == "empty"
            if is_now and row.get("fetched_s") is not None:
                found[(row["profile"], row["run"])] = row["fetched_s"]
    by_link: dict[str, list[float]] = {}
    for (link, _), seconds in found.items():
        by_link.setdefault(link, []).append(seconds)
    return by_link


def _wrong_field(drives: Sequence[DriveSavings], results: Recorded) -> Iterator[str | Table]:
    bare = [row.bd_rate_percent for d in drives if (row := d.without_field) is not None]
    rows = [
        row
        for _, result in results.get("never-worse", ())
        for row in rows_of(NeverWorseRow, result["rows"])
        if row.control != "right"
    ]
    if not (bare or rows):
        return
    yield "## A wrong field, or none"
    also = f": {signed_span(bare)} of bits against x264 with the same tools" if bare else ""
    yield (
        "A field of another street predicts nothing, so that earlier pictures are all that is left "
        f"to our coder{also}; both ends render all the same."
    )
    by_control: dict[tuple[str, str, str], list[NeverWorseRow]] = {}
    for wrong in rows:
        key = (wrong.control, f"{wrong.scene}, {wrong.hz:g} Hz", wrong.preset)
        by_control.setdefault(key, []).append(wrong)
    lines = [
        (
            *key,
            *(
                signed_span(values)
                for values in (
                    [100 * (row.bytes / row.rival_bytes - 1) for row in of],
                    [row.excess_percent_psnr_tuned for row in of],
                )
            ),
        )
        for key, of in by_control.items()
    ]
    if lines:
        heads = (
            "field",
            "drive",
            "x264's preset",
            "whole frame against x264",
            "without the head, against x264 tuned for PSNR",
        )
        yield text_table(heads, lines, "Bytes of a frame ([all of it](never-worse.md))")


def _sizes(compared: Named) -> Iterator[str | Table]:
    drives = [
        (each, name)
        for name, result in compared.items()
        for each in savings_of(result)
        if any(rival.startswith("libaom") for rival, _ in each.rows)
    ]
    if not drives:
        return
    yield "## Larger pictures, against libaom"
    yield (
        "A field misses fine detail, of which a larger picture has more, and libaom has tools of "
        "AV1 that an H.264 slice lacks."
    )
    lines = [
        (
            each.name,
            *(percent(each.against(rival)) for rival in RIVALS_OF_SIZES),
            percent(each.against(BEST_OF_ANY_CPU, HIGH), named=True),
            times(each),
        )
        for each, _ in drives
    ]
    names = [f"against {rival}" for rival in RIVALS_OF_SIZES]
    yield text_table(("drive", *names, "strongest, 35..38 dB", MS), lines)


def _time(drives: Sequence[DriveSavings]) -> Iterator[str | Table]:
    shares = [each.time_ratio for each in drives]
    yield "## Processor time"
    yield (
        "Both ends render the field for every frame before they code or decode it, so that both "
        f"together take {span(shares, ' times', '.1f')} the time of x264 with the same tools."
    )
    most = sorted(drives, key=lambda each: each.time_ratio, reverse=True)
    shown = {each.name: each for each in most}.values()
    lines = [(each.name, times(each), f"{each.time_ratio:.1f}") for each in shown]
    yield text_table(("drive", MS, "times x264's"), lines)


def _classes(results: Recorded) -> Iterator[str | Table]:
    lines = []
    for _, result in results.get("classes", ()):
        equal = [row for row in result["rows"] if row["equal"] == "quality"]
        quality = {(r["scene"], r["method"], r["class"]): r["psnr_db"] for r in equal}
        for (scene, method, of_class), ours_db in quality.items():
            rival_db = quality.get((scene, HEADLINE_ANCHOR, of_class))
            if (
                method == "rfedge"
                and rival_db is not None
                and ours_db < rival_db
                and of_class != "all"
            ):
                lines.append(
                    (
                        scene,
                        of_class,
                        f"{ours_db:.1f}",
                        f"{rival_db:.1f}",
                        f"{ours_db - rival_db:+.1f}",
                    )
                )
    if lines:
        yield "## What the field does not know"
        yield (
            "At equal mean quality the part of a picture that the field knows is better than "
            "x264's, so that the rest is worse."
        )
        heads = ("drive", "class", "ours, dB", "x264 with our tools, dB", "difference, dB")
        yield text_table(heads, lines, "PSNR of classes at equal quality ([all of it](classes.md))")


MS = "ms at both ends: ours / that x264 / the strongest"


def _against(drive: DriveSavings) -> tuple[str, str]:
    return percent(drive.anchor), percent(drive.best, named=True)
