"""The rows of a comparison's result, and the tables that show them.

Bytes count the whole message of a frame, header included; savings and BD-rates are of all frames
but the first. ``scene`` and ``hz`` name a drive in every kind of row. A method's name ends in the
digest of the field that it predicts from.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeVar

from rfedge.evaluate.rate_curve import LPIPS, SSIM
from rfedge.report.tables import Column, Table, columns, shown
from rfedge.results import Result, rows_of

BEST = "best-comparable"
"""The family of the strongest rival that takes no more processor time than ours at both ends."""
BEST_OF_ANY_CPU = "best-of-any-cpu"
"""The family of the strongest of all rivals."""
HEADLINE_ANCHOR = "x264-our-tools-medium"
"""The rival that differs from our coder by the field alone, at a preset of its own time."""
SAVING_AT_DB = ("31", "33", "35")


@dataclass(frozen=True)
class CompareRow:
    """One method against one rival over one window of quality. ``cpu_ms`` is the sender's, a frame;
    ``both_ends_ms`` sender's and receiver's: median, least and most of interleaved rounds."""

    scene: str
    hz: float
    method: str
    rival: str
    """The family of settings, such as ``x264-lowdelay``."""
    rival_setting: str
    """The setting that stands for its family."""
    window_db: Sequence[float] = field(metadata=shown("window dB", "{:g}..{:g}"))
    """Lowest and highest luma PSNR."""
    bd_rate_percent: float = field(metadata=shown("BD-rate %", "+.1f"))
    """Negative if the method needs fewer bytes."""
    ci95: Sequence[float] | None = field(metadata=shown("95 %", "{:.1f}..{:.1f}"))
    """Interval of the BD-rate from blocks of frames drawn with replacement; None of a quick run."""
    points: int
    """Operating points of the method's curve."""
    saving_percent_at_db: Mapping[str, float]
    """Saving by luma PSNR; a quality that a curve does not reach is left out."""
    first_frame_bytes: int
    """Bytes of the first frame at the point nearest the middle of the window, as ``ssim``,
    ``psnr_deviation_db`` and the rival's."""
    rival_first_frame_bytes: int
    ssim: float
    """Mean over the frames."""
    rival_ssim: float
    psnr_deviation_db: float
    """Standard deviation of the frames' luma PSNR."""
    rival_psnr_deviation_db: float
    cpu_ms: float
    """Processor time of the sender, a frame: median of interleaved rounds."""
    rival_cpu_ms: float
    both_ends_ms: Sequence[float] = field(metadata=shown("both ends ms", "{:.0f} ({:.0f}..{:.0f})"))
    """Processor time of sender and receiver, a frame: median, least and most of the rounds."""
    rival_both_ends_ms: Sequence[float] = field(
        metadata=shown("the rival's", "{:.0f} ({:.0f}..{:.0f})")
    )
    field_psnr_db: float | None = field(metadata=shown("field dB", ".2f"))
    """Quality of the field's own renders against the camera."""


AT_QUALITIES = Column(
    "bits at 31 / 33 / 35 dB, %",
    lambda row: " / ".join(
        f"{-row.saving_percent_at_db[db]:+.0f}" if db in row.saving_percent_at_db else "-"
        for db in SAVING_AT_DB
    ),
)
BOTH_SSIM = Column("SSIM", lambda row: (row.ssim, row.rival_ssim), "{:.3f} / {:.3f}")
FIRST_FRAME = Column(
    "first frame kB",
    lambda row: (row.first_frame_bytes / 1e3, row.rival_first_frame_bytes / 1e3),
    "{:.1f} / {:.1f}",
)
DEVIATION = Column(
    "deviation dB",
    lambda row: (row.psnr_deviation_db, row.rival_psnr_deviation_db),
    "{:.2f} / {:.2f}",
)
SENDER = Column("sender ms", lambda row: (row.cpu_ms, row.rival_cpu_ms), "{:.0f} / {:.0f}")
BOTH_ENDS = Column(
    "ms at both ends",
    lambda row: (row.both_ends_ms[0], row.rival_both_ends_ms[0]),
    "{:.0f} / {:.0f}",
)


@dataclass(frozen=True)
class QualityRow:
    """One method against one rival over the window of another ``Quality`` than the PSNR."""

    scene: str
    hz: float
    method: str
    rival: str
    """The family of settings."""
    rival_setting: str = field(metadata=shown("rival"))
    window: Sequence[float] = field(metadata=shown("window", "{:g}..{:g}"))
    bd_rate_percent: float = field(metadata=shown("BD-rate %", "+.1f"))


@dataclass(frozen=True)
class BreakEvenRow:
    """The saving that the field's own bytes leave when a drive is driven again and again."""

    scene: str
    hz: float
    method: str
    rival: str = field(metadata=shown("against"))
    """The setting that the field is paid for against."""
    at_db: float = field(metadata=shown("at dB", "g"))
    """Luma PSNR that bytes are compared at: 33 dB, or the lowest above it that both curves have."""
    frames_per_pass: int
    """Frames of the drive, the first among them."""
    field_bytes: int
    """Size of the field's archive, which is sent once."""
    saved_bytes_per_pass: float
    """Bytes that ours takes less than the rival for the whole drive."""
    passes_to_break_even: int | None = field(
        metadata=shown("passes to break even", "d", missing="never")
    )
    saving_percent_after: Mapping[str, float]
    """Saving by the number of passes."""


@dataclass(frozen=True)
class BitShareRow:
    """The share of the picture and of the bytes of one kind of macroblock at one CRF."""

    scene: str
    hz: float
    method: str
    crf: float
    """The CRF of our coder at which frames were split."""
    shows: str = field(metadata=shown("macroblocks"))
    area_percent: float = field(metadata=shown("of the picture, %", ".0f"))
    slice_percent: float = field(metadata=shown("of the bytes, %", ".0f"))
    bytes_per_frame: float = field(metadata=shown("bytes a frame", ".0f"))


@dataclass(frozen=True)
class ForegroundRow:
    """Ours, the whole picture, against a rival that sends the foreground alone."""

    scene: str
    hz: float
    mask: str
    """How the foreground was found."""
    foreground_percent: float
    """Share of the pixels, mean over the frames."""
    window_db: Sequence[float] | None
    """PSNR of the foreground's pixels that both curves have."""
    bd_rate_percent: float | None
    """None, as ``window_db``, if the curves share less than a decibel."""
    whole_picture_ceiling_db: float
    """Best luma PSNR of whole pictures, render behind the foreground, that the rival reaches."""
    ours: Mapping[str, Sequence[float]]
    """Curve of the foreground: bytes a frame over PSNR."""
    rfdvc_style: Mapping[str, Sequence[float]]
    """The same of the rival, which sends the foreground and shows the render behind it."""


@dataclass(frozen=True)
class CurveRow:
    """The curve of one coder, from its lowest quality to its highest."""

    scene: str
    hz: float
    family: str
    """Family of the rival; empty for ours."""
    setting: str
    """Name of the coder with its settings."""
    cpu_ms: float
    """Processor time of the sender, a frame."""
    both_ends_ms: float
    """Processor time of sender and receiver, a frame."""
    point: Sequence[float]
    """Operating points (CRF, or what the codec takes), in the order of the columns below."""
    psnr_db: Sequence[float]
    """PSNR of the luma's mean squared error over all frames but the first, as all columns below."""
    bytes_per_frame: Sequence[float]
    """Mean over the frames."""
    ssim: Sequence[float]
    """Mean over the frames."""
    lpips: Sequence[float] | None = None
    """Mean over the frames; with ``--lpips-weights`` only."""


BY_QUALITY = {SSIM: "By SSIM, against rivals tuned for it", LPIPS: f"By {LPIPS.title}"}
"""Headings of the qualities beside the PSNR whose rows a result may have, by their names."""
Row = TypeVar("Row", bound=CompareRow | QualityRow | BreakEvenRow | BitShareRow)


def compare_parts(result: Result) -> Iterator[Table | str]:
    """Yield the tables of a comparison: a row a rival for each drive, then what else was measured,
    and at last a sentence a drive.

    Of methods and windows the first is shown against every rival, the others against one; the
    result has all rows. In every table less than zero is fewer bits than the rival's.
    """
    compared = rows_of(CompareRow, result["rows"])
    yield from _compared_tables(compared)
    break_even = of_first_method(rows_of(BreakEvenRow, result.get("break_even", ())))
    if break_even:
        yield Table("What the field's own bytes leave of the saving", _BREAK_EVEN, break_even)
    for quality, heading in BY_QUALITY.items():
        by_quality = rows_of(QualityRow, result.get(quality.name, ()))
        if by_quality:
            yield Table(heading, [DRIVE, *columns(QualityRow)], by_quality)
    bits = rows_of(BitShareRow, result.get("bits", ()))
    if bits:
        yield Table("Where the bits go, near 33.5 dB", [DRIVE, *columns(BitShareRow)], bits)
    yield from map(_foreground_line, rows_of(ForegroundRow, result.get("foreground", ())))
    first = of_first_window(compared) if compared else []
    for rows in _by_drive(of_first_method(first)).values():
        yield _summary(rows, break_even)
    own = [row for row in first if is_own(row.method) and row.rival == _anchor(compared)]
    for row in own:
        yield f"{_drive(row)}: {row.method} takes {_fewer(row.bd_rate_percent)} than {_than(row)}."


def _summary(rows: Sequence[CompareRow], break_even: Sequence[BreakEvenRow]) -> str:
    """Return what a drive saved, in words: ``rows`` are those of one method and field."""
    one = rows[0]
    anchor = next(row for row in rows if row.rival == _anchor(rows))
    best = next((row for row in rows if row.rival == BEST_OF_ANY_CPU), anchor)
    also = ""
    if best.rival_setting != anchor.rival_setting:
        also = f", and {_fewer(best.bd_rate_percent)} than the strongest, {best.rival_setting}"
    text = f"{_drive(one)}: {_fewer(anchor.bd_rate_percent)} than {_than(anchor)}{also}."
    for paid in break_even:
        if (paid.scene, paid.hz, paid.method) == (one.scene, one.hz, one.method):
            passes = paid.passes_to_break_even
            after = "never" if passes is None else f"after {passes:,} such drives"
            text += (
                f" The field has {paid.field_bytes / 1e6:.1f} MB, which are paid for {after} "
                f"(against {paid.rival})."
            )
    return text


def _than(row: CompareRow) -> str:
    return f"{row.rival_setting} at equal quality ({{:g}}..{{:g}} dB)".format(*row.window_db)


def _fewer(bits_percent: float) -> str:
    return f"{abs(bits_percent):.0f} % {'fewer' if bits_percent < 0 else 'more'} bits"


def _compared_tables(compared: Sequence[CompareRow]) -> Iterator[Table | str]:
    if not compared:
        yield "No curves share a window."
        return
    first = of_first_window(compared)
    window = "{:g}..{:g}".format(*compared[0].window_db)
    ours = without_field(compared[0].method)
    told = ("bd_rate_percent", "ci95")
    for name, rows in _by_drive(of_first_method(first)).items():
        rival = Column("rival", partial(_starred, rows))
        against = columns(CompareRow, rival, *told, BOTH_ENDS, AT_QUALITIES, BOTH_SSIM, FIRST_FRAME)
        once = {row.rival_setting: row for row in rows}
        yield Table(f"{name}: {ours} over {window} dB. {STARS}", against, list(once.values()))
    family = _anchor(compared)
    methods = [row for row in first if row.rival == family]
    anchor = methods[0].rival_setting
    yield Table(
        f"By method, against {anchor} over {window} dB",
        columns(CompareRow, DRIVE, METHOD, *told, SENDER, BOTH_ENDS, DEVIATION),
        methods,
    )
    windows = [row for row in of_first_method(compared) if row.rival == family]
    yield Table(
        f"By window of luma PSNR, {ours} against {anchor}",
        columns(CompareRow, DRIVE, "window_db", *told),
        windows,
    )
    yield Table(
        "Processor time a frame: median, least and most",
        columns(CompareRow, DRIVE, "both_ends_ms", "rival_both_ends_ms", "field_psnr_db"),
        of_first_method(methods),
    )


STARS = (
    "Below zero: fewer bits. 28 / 4: ours / the rival's. "
    "*: strongest that takes no more time than ours; **: strongest of all."
)


def _starred(rows: Iterable[CompareRow], shown: CompareRow) -> str:
    """Return the name of a row's setting, marked if it is the strongest of ``rows``."""
    setting = shown.rival_setting
    families = {row.rival for row in rows if row.rival_setting == setting}
    stars = "**" if BEST_OF_ANY_CPU in families else "*" if BEST in families else ""
    return f"{setting} {stars}".rstrip()


def _anchor(compared: Sequence[CompareRow]) -> str:
    """Return the headline's rival, or the first with our tools, or of a comparison without it the
    first of all."""
    rivals = [row.rival for row in compared]
    with_our_tools = [rival for rival in rivals if rival.startswith("x264-our-tools")]
    return HEADLINE_ANCHOR if HEADLINE_ANCHOR in rivals else (with_our_tools or rivals)[0]


def without_field(method: str) -> str:
    """Return a method's name without the digest of its field, its effort once; a codec of
    ``--method`` has neither."""
    if is_own(method):
        return method
    name = method.rsplit("-", 1)[0]
    without_effort, _, effort = name.rpartition("-")
    return without_effort if without_effort.endswith(f"-{effort}") else name


def is_own(method: str) -> bool:
    """Return whether a method is a codec of ``--method``: its name lacks the digest of a field."""
    return re.search(r"-[0-9a-f]{12}$", method) is None


def of_first_window(rows: Sequence[CompareRow]) -> list[CompareRow]:
    """Return the rows of the window that was asked about first."""
    return [row for row in rows if row.window_db == rows[0].window_db]


def of_first_method(rows: Sequence[Row]) -> list[Row]:
    """Return the rows of the method that stands first, whatever its field."""
    return [row for row in rows if without_field(row.method) == without_field(rows[0].method)]


def _by_drive(rows: Iterable[CompareRow]) -> dict[str, list[CompareRow]]:
    """Return rows by drive, and by field if a drive was rendered with several."""
    found: dict[str, list[CompareRow]] = {}
    for row in rows:
        found.setdefault(f"{_drive(row)}, field {_field(row)}", []).append(row)
    drives = [name.partition(", field ")[0] for name in found]
    return {
        name if drives.count(drive) > 1 else drive: of_drive
        for drive, (name, of_drive) in zip(drives, found.items(), strict=True)
    }


def _drive(row: Any) -> str:
    return f"{row.scene}, {row.hz:g} Hz"


def _field(row: Any) -> str:
    return str(row.method.rsplit("-", 1)[-1])


DRIVE = Column("drive", _drive)
METHOD = Column("method", lambda row: without_field(row.method))
_BREAK_EVEN = [
    DRIVE,
    Column("field", _field),
    *columns(BreakEvenRow, "rival", "at_db"),
    Column("saved kB a pass", lambda row: row.saved_bytes_per_pass / 1e3, ".1f"),
    Column("field MB", lambda row: row.field_bytes / 1e6, ".2f"),
    *columns(BreakEvenRow, "passes_to_break_even"),
    Column(
        "bits with the field, after 1 / 10 / 100 passes, %",
        lambda row: " / ".join(f"{-saving:+.0f}" for saving in row.saving_percent_after.values()),
    ),
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
        f"Foreground only, in the style of RFDVC, {_drive(row)} ({row.foreground_percent:.0f} % of "
        f"the pixels; {row.mask}): the whole picture never passes "
        f"{row.whole_picture_ceiling_db:.2f} dB; {against}."
    )
