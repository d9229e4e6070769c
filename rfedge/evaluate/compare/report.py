"""The rows of a comparison's result, and its section of the results page.

Bytes count the whole message of a frame, header included; savings and BD-rates are of all frames
but the first. ``scene`` and ``hz`` name a drive in every kind of row.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from rich.console import Console

from rfcore.errors import InvalidInput
from rfedge.report.tables import heading, pivot, print_table, table
from rfedge.results import Result, rows_of

__all__ = [
    "BEST",
    "BEST_OF_ANY_CPU",
    "HEADLINE_ANCHOR",
    "BitShareRow",
    "BreakEvenRow",
    "CompareRow",
    "CurveRow",
    "ForegroundRow",
    "SsimRow",
    "compare_section",
    "harder_sentence",
    "headline",
    "of_first_method",
    "of_first_window",
    "print_compared",
    "without_field",
]

BEST = "best-comparable"
"""Named as a family: the strongest rival that takes no more processor time than ours, of sender
and receiver together."""
BEST_OF_ANY_CPU = "best-of-any-cpu"
"""Named as a family: the strongest of all rivals."""
BESTS = {BEST: " (best comparable)", BEST_OF_ANY_CPU: " (best of any CPU)"}


@dataclass(frozen=True)
class CompareRow:
    """One method against one rival over one window of quality. ``cpu_ms`` is the sender's, a frame;
    ``both_ends_ms`` of sender and receiver: median, least and most of interleaved rounds."""

    scene: str
    hz: float
    method: str
    rival: str
    """The family of settings, such as ``x264-lowdelay``."""
    rival_setting: str
    """The setting that stands for its family."""
    window_db: Sequence[float]
    """Lowest and highest luma PSNR."""
    bd_rate_percent: float
    """Negative where the method needs fewer bytes."""
    ci95: Sequence[float]
    """Interval of the BD-rate from blocks of frames drawn with replacement."""
    points: int
    saving_percent_at_db: Mapping[str, float]
    """A quality that a curve does not reach has no saving."""
    first_frame_bytes: int
    rival_first_frame_bytes: int
    ssim: float
    rival_ssim: float
    psnr_deviation_db: float
    rival_psnr_deviation_db: float
    cpu_ms: float
    rival_cpu_ms: float
    both_ends_ms: Sequence[float]
    rival_both_ends_ms: Sequence[float]
    field_psnr_db: float | None
    """Of the field's own renders against the camera."""


@dataclass(frozen=True)
class SsimRow:
    """One method against one rival that is tuned for SSIM, over a window of mean SSIM."""

    scene: str
    hz: float
    method: str
    rival: str
    rival_setting: str
    window_ssim: Sequence[float]
    bd_rate_percent: float


@dataclass(frozen=True)
class BreakEvenRow:
    """What the field's own bytes leave of the saving when a drive is driven again and again."""

    scene: str
    hz: float
    method: str
    rival: str
    at_db: float
    frames_per_pass: int
    field_bytes: int
    saved_bytes_per_pass: float
    passes_to_break_even: int | None
    """None: never."""
    saving_percent_after: Mapping[str, float]
    """By the number of passes."""


@dataclass(frozen=True)
class BitShareRow:
    """How much of the picture, and of the bytes, one kind of macroblock takes at one CRF."""

    scene: str
    hz: float
    method: str
    crf: float
    shows: str
    area_percent: float
    slice_percent: float
    bytes_per_frame: float


@dataclass(frozen=True)
class ForegroundRow:
    """Ours, the whole picture, against a rival that sends the foreground alone."""

    scene: str
    hz: float
    mask: str
    foreground_percent: float
    window_db: Sequence[float] | None
    bd_rate_percent: float | None
    """None, as ``window_db``: the curves share less than a decibel."""
    whole_picture_ceiling_db: float
    ours: Mapping[str, Sequence[float]]
    rfdvc_style: Mapping[str, Sequence[float]]


Row = TypeVar("Row", bound=CompareRow | SsimRow | BreakEvenRow | BitShareRow)


@dataclass(frozen=True)
class CurveRow:
    """The curve of one coder, from its lowest quality to its highest."""

    scene: str
    hz: float
    family: str
    """Empty for ours."""
    setting: str
    cpu_ms: float
    both_ends_ms: float
    point: Sequence[float]
    psnr_db: Sequence[float]
    bytes_per_frame: Sequence[float]
    ssim: Sequence[float]


HEADLINE_ANCHOR = "x264-our-tools-medium"
SECOND_PASSES, UPPER_BOUNDS = ("kitti-loop", "kitti-loop-localised"), ("kitti-city",)
"""Real drives through a street that a drive before has mapped; those whose map has pictures of the
same drive, which no headline counts."""
HEADLINE_COLUMNS = (
    "drive",
    "against x264 medium with our tools (95 %)",
    "against the best of all rivals",
    "our coder without the field",
    "ms a frame at both ends: ours / that x264",
    "the field, after how many passes it is paid for, and what it saves an hour of one camera",
)
PRINTED = ("scene", "Hz", "method", "rival", "window dB", "BD-rate %", "95 %", "CPU ms")
SAVING_AT_DB = ("31", "33", "35")
DETAIL_COLUMNS = (
    "drive",
    "saving at 31 / 33 / 35 dB, %",
    "SSIM",
    "deviation dB",
    "first frame kB",
    "sender ms",
    "both ends ms",
    "the rival's",
    "field dB",
)
BREAK_EVEN_COLUMNS = (
    "drive",
    "saved kB a pass",
    "field MB",
    "passes to break even",
    "saving after 1 / 10 / 100 passes, %",
)


def without_field(method: str) -> str:
    """Return a method's name without the digest of the field it ends in."""
    return method.rsplit("-", 1)[0]


def compare_section(path: Path, result: Result) -> str:
    """Return the tables of a comparison, a line a drive; what it did not measure is left out.

    Of methods and windows the first is shown against every rival, the others against one; the
    file has all rows.
    """
    compared = rows_of(CompareRow, result["rows"])
    parts = [heading(path, result), *_compared_tables(path, compared)]
    by_ssim = rows_of(SsimRow, result.get("ssim", ()))
    if by_ssim:
        parts += ["By SSIM (window), rivals tuned for it where they can be:"]
        parts += [_by_drive(by_ssim, lambda row: row.rival_setting, _ssim_cell)]
    break_even = of_first_method(rows_of(BreakEvenRow, result.get("break_even", ())))
    if break_even:
        parts += ["What the field's own bytes leave:"]
        lines = ([name, *_break_even_cells(row)] for name, row in _named(break_even))
        parts += [table(BREAK_EVEN_COLUMNS, lines)]
    bits = rows_of(BitShareRow, result.get("bits", ()))
    if bits:
        parts += ["Where the bits go, near 33.5 dB (bytes a frame; share of the macroblocks):"]
        parts += [_by_drive(bits, lambda row: row.shows, _bits_cell)]
    parts += map(_foreground_line, rows_of(ForegroundRow, result.get("foreground", ())))
    return "\n\n".join([*parts, ""])


def _compared_tables(path: Path, compared: Sequence[CompareRow]) -> list[str]:
    if not compared:
        return ["No curves share a window."]
    anchor = _anchor(compared)
    first = of_first_window(compared)
    of_all_methods = [row for row in first if row.rival == anchor]
    of_all_windows = [row for row in of_first_method(compared) if row.rival == anchor]
    detailed = of_first_method(of_all_methods)
    method = without_field(compared[0].method)
    return [
        f"BD-rates in % ({path.name} has every row with its interval): `{method}` over "
        f"{_window(compared[0])} dB, against",
        _by_drive(of_first_method(first), lambda row: row.rival, _bd_rate_cell),
        f"Against {anchor}, with what a frame takes of a processor (median, least, most):",
        table(DETAIL_COLUMNS, ([name, *_detail_cells(row)] for name, row in _named(detailed))),
        f"Against {anchor} by window, dB (95 %):",
        _by_drive(of_all_windows, _window, _interval_cell),
        f"Against {anchor} over {_window(compared[0])} dB by method (95 %):",
        _by_drive(of_all_methods, lambda row: without_field(row.method), _interval_cell),
    ]


def _anchor(compared: Sequence[CompareRow]) -> str:
    """Return the headline's rival, or the first of a comparison without it."""
    rivals = [row.rival for row in compared]
    return HEADLINE_ANCHOR if HEADLINE_ANCHOR in rivals else rivals[0]


def of_first_window(rows: Sequence[CompareRow]) -> list[CompareRow]:
    """Return the rows of the window that was asked about first."""
    return [row for row in rows if row.window_db == rows[0].window_db]


def of_first_method(rows: Sequence[Row]) -> list[Row]:
    """Return the rows of the method that stands first, in whatever field."""
    return [row for row in rows if without_field(row.method) == without_field(rows[0].method)]


def _by_drive(rows: Sequence[Row], column: Callable[[Row], str], text: Callable[[Row], str]) -> str:
    """Return a table with a line for each drive and a column for each value of ``column``."""
    return pivot("drive", ((name, column(row), text(row)) for name, row in _named(rows)))


def _named(rows: Sequence[Row]) -> list[tuple[str, Row]]:
    """Return each row with its drive's name, and the field's where a drive has several."""
    fields: dict[tuple[str, float], set[str]] = {}
    for row in rows:
        fields.setdefault((row.scene, row.hz), set()).add(_field(row.method))
    several = {drive for drive, digests in fields.items() if len(digests) > 1}
    named = []
    for row in rows:
        which = f", field {_field(row.method)}" if (row.scene, row.hz) in several else ""
        named.append((f"{row.scene}, {row.hz:g} Hz{which}", row))
    return named


def _field(method: str) -> str:
    """Return the digest of the field that a method's name ends in."""
    return method.rsplit("-", 1)[-1]


def _window(row: CompareRow) -> str:
    return "{:g}..{:g}".format(*row.window_db)


def _bd_rate_cell(row: CompareRow) -> str:
    """Return a BD-rate, and of the best of several rivals who it is."""
    who = f" ({row.rival_setting})" if row.rival in BESTS else ""
    return f"{row.bd_rate_percent:+.1f}{who}"


def _interval_cell(row: CompareRow) -> str:
    low, high = row.ci95
    return f"{row.bd_rate_percent:+.1f} ({low:.1f}..{high:.1f})"


def _detail_cells(row: CompareRow) -> list[str]:
    at_db = row.saving_percent_at_db
    first_kb = (row.first_frame_bytes / 1000, row.rival_first_frame_bytes / 1000)
    return [
        " / ".join(f"{at_db[db]:.0f}" if db in at_db else "-" for db in SAVING_AT_DB),
        f"{row.ssim:.3f} / {row.rival_ssim:.3f}",
        f"{row.psnr_deviation_db:.2f} / {row.rival_psnr_deviation_db:.2f}",
        "{:.1f} / {:.1f}".format(*first_kb),
        f"{row.cpu_ms:.0f} / {row.rival_cpu_ms:.0f}",
        _spread(row.both_ends_ms),
        _spread(row.rival_both_ends_ms),
        "-" if row.field_psnr_db is None else f"{row.field_psnr_db:.2f}",
    ]


def _ssim_cell(row: SsimRow) -> str:
    low, high = row.window_ssim
    return f"{row.bd_rate_percent:+.1f} ({low:g}..{high:g})"


def _bits_cell(row: BitShareRow) -> str:
    return f"{row.bytes_per_frame:.0f} ({row.area_percent:.0f} %)"


def headline(result: Result) -> str:
    """Return a sentence, and a line per drive over the first window: ours against x264 with the
    same tools at preset medium and against the strongest rival of all; our coder without the
    field; times; what the field's own bytes are, how many passes over the street save as many, and
    what an hour of such traffic saves.

    Raises ``InvalidInput`` for a comparison that lacks one of them.
    """
    compared = rows_of(CompareRow, result["rows"])
    first = of_first_window(compared)
    drives = dict.fromkeys((row.scene, row.hz) for row in first)
    paid = rows_of(BreakEvenRow, result.get("break_even", ()))
    cells = [[*_headline_cells(first, *drive), _field_cell(paid, *drive)] for drive in drives]
    lines = table(HEADLINE_COLUMNS, cells)
    return f"{_headline_sentence([_compared(first, *drive) for drive in drives])}\n\n{lines}"


def harder_sentence(result: Result) -> str:
    """Return what ours saves on each of several drives against the headline's rival, most first.

    Raises ``InvalidInput`` for a comparison that lacks one.
    """
    compared = rows_of(CompareRow, result["rows"])
    first = of_first_window(compared)
    drives = dict.fromkeys((row.scene, row.hz) for row in first)
    fair = sorted((_compared(first, *drive) for drive in drives), key=lambda r: r.bd_rate_percent)
    told = [f"{row.scene} at {row.hz:g} Hz {row.bd_rate_percent:+.0f} %" for row in fair]
    return f"Harder drives against the same x264 (`docs/results.md`): {', '.join(told)}."


def _headline_sentence(fair: Sequence[CompareRow]) -> str:
    """Return what all drives tell together but those that are an upper bound."""
    fair = [row for row in fair if row.scene not in UPPER_BOUNDS]
    if not fair:
        raise InvalidInput("rows", f"no drive but upper bounds: {', '.join(UPPER_BOUNDS)}")
    groups = {
        "drives through synthetic streets": [x for x in fair if x.scene not in SECOND_PASSES],
        "a real street's second pass": [x for x in fair if x.scene in SECOND_PASSES],
    }
    told = [f"{_saved(rows)} on {what}" for what, rows in groups.items() if rows]
    ours = _from_to([row.both_ends_ms[0] for row in fair])
    theirs = _from_to([row.rival_both_ends_ms[0] for row in fair])
    return (
        f"Fewer bits than x264 medium with the same tools at equal PSNR: {', '.join(told)}; "
        f"for {ours} ms of processor a frame at both ends, where that x264 takes {theirs}."
    )


def _saved(rows: Sequence[CompareRow]) -> str:
    """Return the least and the most that is saved, and how far the intervals reach."""
    saved = _from_to([-row.bd_rate_percent for row in rows])
    reach = _from_to([-each for row in rows for each in row.ci95])
    return f"**{saved} %** (95 %: {reach} %)"


def _from_to(values: Sequence[float]) -> str:
    ends = (f"{min(values):.0f}", f"{max(values):.0f}")
    return " to ".join(dict.fromkeys(ends))


def _compared(
    rows: Sequence[CompareRow],
    scene: str,
    hz: float,
    method: str = "rfedge",
    rival: str = HEADLINE_ANCHOR,
) -> CompareRow:
    for each in rows:
        named = _without_effort(each.method)
        if (each.scene, each.hz, named, each.rival) == (scene, hz, method, rival):
            return each
    raise InvalidInput("rows", f"{scene}@{hz:g} lacks {method} against {rival}")


def _without_effort(method: str) -> str:
    return without_field(method).rsplit("-", 1)[0]


def _field_cell(rows: Sequence[BreakEvenRow], scene: str, hz: float) -> str:
    for row in rows:
        if (row.scene, row.hz, _without_effort(row.method)) == (scene, hz, "rfedge"):
            passes, seconds = row.passes_to_break_even, row.frames_per_pass / hz
            paid = "never" if passes is None else f"{passes} of {seconds:.1f} s"
            saved_mb_per_h = 3600 / 1e6 * row.saved_bytes_per_pass / seconds
            return f"{row.field_bytes / 1e6:.1f} MB, {paid}, {saved_mb_per_h:.0f} MB"
    raise InvalidInput("break_even", f"{scene}@{hz:g} lacks rfedge")


def _headline_cells(rows: Sequence[CompareRow], scene: str, hz: float) -> list[str]:
    fair, best = (
        _compared(rows, scene, hz, rival=each) for each in (HEADLINE_ANCHOR, BEST_OF_ANY_CPU)
    )
    ablated = _compared(rows, scene, hz, "rfedge-without-field")
    low, high = fair.ci95
    return [
        f"{scene}, {hz:g} Hz",
        f"{fair.bd_rate_percent:+.1f} % ({low:.1f}..{high:.1f})",
        f"{best.bd_rate_percent:+.1f} % ({best.rival_setting})",
        f"{ablated.bd_rate_percent:+.1f} %",
        f"{fair.both_ends_ms[0]:.0f} / {fair.rival_both_ends_ms[0]:.0f}",
    ]


def print_compared(console: Console, rows: Sequence[CompareRow]) -> None:
    """Print the BD-rates, each with the setting that stands for its family."""
    print_table(console, "Ours against rivals", PRINTED, [_printed_cells(row) for row in rows])


def _printed_cells(row: CompareRow) -> list[str]:
    low, high = row.ci95
    return [
        row.scene,
        f"{row.hz:g}",
        without_field(row.method),
        row.rival_setting + BESTS.get(row.rival, ""),
        _window(row),
        f"{row.bd_rate_percent:.1f}",
        f"{low:.1f}..{high:.1f}",
        f"{row.both_ends_ms[0]:.0f} / {row.rival_both_ends_ms[0]:.0f}",
    ]


def _spread(both_ends_ms: Sequence[float]) -> str:
    return "{:.0f} ({:.0f}..{:.0f})".format(*both_ends_ms)


def _break_even_cells(row: BreakEvenRow) -> list[str]:
    passes = row.passes_to_break_even
    return [
        f"{row.saved_bytes_per_pass / 1000:.1f}",
        f"{row.field_bytes / 1e6:.2f}",
        "never" if passes is None else str(passes),
        " / ".join(f"{saving:.0f}" for saving in row.saving_percent_after.values()),
    ]


def _foreground_line(row: ForegroundRow) -> str:
    if row.bd_rate_percent is None or row.window_db is None:
        against = "they share no window of a decibel"
    else:
        low, high = row.window_db
        against = (
            f"ours, the whole picture, has a BD-rate of {row.bd_rate_percent:+.0f} % at equal "
            f"quality of the foreground ({low:.1f}..{high:.1f} dB)"
        )
    return (
        f"Foreground only, RFDVC-style, {row.scene} at {row.hz:g} Hz "
        f"({row.foreground_percent:.0f} % of the pixels; {row.mask}): the whole picture "
        f"never passes {row.whole_picture_ceiling_db:.2f} dB; {against}."
    )
