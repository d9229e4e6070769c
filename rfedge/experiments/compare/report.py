"""The rows of a comparison's result, and its section of the results page.

Bytes count the whole message of a frame, header included; savings and BD-rates are of all frames
but the first. ``scene`` and ``hz`` name a drive in every kind of row.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from rfcore.errors import InvalidInput
from rfedge.report.tables import heading, print_table, table
from rfedge.results import Result, rows_of

__all__ = [
    "BEST",
    "BEST_OF_ANY_CPU",
    "BitShareRow",
    "BreakEvenRow",
    "CompareRow",
    "CurveRow",
    "ForegroundRow",
    "SsimRow",
    "compare_section",
    "headline",
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
    "CPU ms: sender",
    "both ends",
    "rival's",
    "both ends",
    "field dB",
)
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
    "the field, and after how many passes it is paid for",
)
PRINTED = ("scene", "Hz", "method", "rival", "window dB", "BD-rate %", "95 %", "CPU ms")
SSIM_COLUMNS = (
    "scene",
    "Hz",
    "method",
    "rival, tuned for SSIM where it can be",
    "SSIM",
    "BD-rate %",
)
SAVING_AT_DB = ("31", "33", "35")
BREAK_EVEN_COLUMNS = (
    "scene",
    "Hz",
    "method",
    "saved kB a pass",
    "field MB",
    "passes to break even",
    "saving after 1 / 10 / 100 passes, %",
)


def without_field(method: str) -> str:
    """Return a method's name without the digest of the field it ends in."""
    return method.rsplit("-", 1)[0]


def compare_section(path: Path, result: Result) -> str:
    """Return the tables of a comparison; those that it did not measure are left out."""
    compared = [_compare_cells(row) for row in rows_of(CompareRow, result["rows"])]
    parts = [heading(path, result), table(COMPARE_COLUMNS, compared)]
    by_ssim = rows_of(SsimRow, result.get("ssim", ()))
    if by_ssim:
        parts += ["By SSIM:", table(SSIM_COLUMNS, map(_ssim_cells, by_ssim))]
    break_even = rows_of(BreakEvenRow, result.get("break_even", ()))
    if break_even:
        parts += ["What the field's own bytes leave:"]
        parts += [table(BREAK_EVEN_COLUMNS, map(_break_even_cells, break_even))]
    bits = rows_of(BitShareRow, result.get("bits", ()))
    if bits:
        parts += ["Where the bits go, near 33.5 dB (bytes a frame; share of the macroblocks):"]
        parts += [_bits_table(bits)]
    parts += map(_foreground_line, rows_of(ForegroundRow, result.get("foreground", ())))
    return "\n\n".join([*parts, ""])


def headline(result: Result) -> str:
    """Return a sentence, and a line per drive over the first window: ours against x264 with the
    same tools at preset medium and against the strongest rival of all; our coder without the
    field; times; what the field's own bytes are, and how many passes over the street save as many.

    Raises ``InvalidInput`` for a comparison that lacks one of them.
    """
    compared = rows_of(CompareRow, result["rows"])
    window = compared[0].window_db if compared else ()
    first = [row for row in compared if row.window_db == window]
    drives = dict.fromkeys((row.scene, row.hz) for row in first)
    paid = rows_of(BreakEvenRow, result.get("break_even", ()))
    cells = [[*_headline_cells(first, *drive), _field_cell(paid, *drive)] for drive in drives]
    lines = table(HEADLINE_COLUMNS, cells)
    return f"{_headline_sentence([_compared(first, *drive) for drive in drives])}\n\n{lines}"


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
            return f"{row.field_bytes / 1e6:.1f} MB, {paid}"
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
        "{:g}..{:g}".format(*row.window_db),
        f"{row.bd_rate_percent:.1f}",
        f"{low:.1f}..{high:.1f}",
        f"{row.both_ends_ms[0]:.0f} / {row.rival_both_ends_ms[0]:.0f}",
    ]


def _spread(both_ends_ms: Sequence[float]) -> str:
    return "{:.0f} ({:.0f}..{:.0f})".format(*both_ends_ms)


def _ssim_cells(row: SsimRow) -> list[str]:
    low, high = row.window_ssim
    method = without_field(row.method)
    window = f"{low:g}..{high:g}"
    return [
        row.scene,
        f"{row.hz:g}",
        method,
        row.rival_setting,
        window,
        f"{row.bd_rate_percent:.1f}",
    ]


def _compare_cells(row: CompareRow) -> list[str]:
    low, high = row.ci95
    at_db = row.saving_percent_at_db
    savings = " / ".join(f"{at_db[db]:.0f}" if db in at_db else "-" for db in SAVING_AT_DB)
    return [
        row.scene,
        f"{row.hz:g}",
        without_field(row.method),
        f"{row.rival} ({row.rival_setting})",
        "{:g}..{:g}".format(*row.window_db),
        f"{row.bd_rate_percent:.1f}",
        f"{low:.1f}..{high:.1f}",
        savings,
        f"{row.ssim:.3f}",
        f"{row.rival_ssim:.3f}",
        f"{row.psnr_deviation_db:.2f}",
        f"{row.rival_psnr_deviation_db:.2f}",
        f"{row.first_frame_bytes / 1000:.1f}",
        f"{row.rival_first_frame_bytes / 1000:.1f}",
        f"{row.cpu_ms:.0f}",
        _spread(row.both_ends_ms),
        f"{row.rival_cpu_ms:.0f}",
        _spread(row.rival_both_ends_ms),
        "-" if row.field_psnr_db is None else f"{row.field_psnr_db:.2f}",
    ]


def _break_even_cells(row: BreakEvenRow) -> list[str]:
    passes = row.passes_to_break_even
    return [
        row.scene,
        f"{row.hz:g}",
        without_field(row.method),
        f"{row.saved_bytes_per_pass / 1000:.1f}",
        f"{row.field_bytes / 1e6:.2f}",
        "never" if passes is None else str(passes),
        " / ".join(f"{saving:.0f}" for saving in row.saving_percent_after.values()),
    ]


def _bits_table(rows: Sequence[BitShareRow]) -> str:
    kinds = list(dict.fromkeys(row.shows for row in rows))
    drives = list(dict.fromkeys((row.scene, row.hz) for row in rows))
    lines = []
    for scene, hz in drives:
        those = {row.shows: row for row in rows if (row.scene, row.hz) == (scene, hz)}
        cells = [
            f"{those[kind].bytes_per_frame:.0f} ({those[kind].area_percent:.0f} %)"
            for kind in kinds
        ]
        lines.append([scene, f"{hz:g}", *cells])
    return table(("scene", "Hz", *kinds), lines)


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
