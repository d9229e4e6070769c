"""Bits that another light costs, and which of them each way of adapting to it wins back.

A variant is how a drive is coded: ``off``, with the field as it is; ``matrix``, with the sender's
matrix of colours (``rfcore.codec.photometric``) wherever it chooses to send one; ``auto``, as
vehicles do it: with renders under the light of the frame before (``rfcore.native.warp``) wherever
that pays, else a matrix; and any field or colour layer that the case names. With b the bits at
33 dB, ``recovered_percent`` is 100 (b_off - b) / (b_off - b_noon), b_noon being those of the same
drive in the field's own light. A field that shows more than 33 dB before a bit is sent has no such
b: its bits at the coarsest point are more than enough, an upper bound, and what it recovers is at
least what that bound does. At 36 dB every curve has bits.

In the right light the sender adapts nothing: ``messages_differ`` compares whole messages with those
of ``off``, byte for byte and at every rate.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from dataclasses import field as with_factory
from functools import partial
from pathlib import Path
from statistics import median
from time import process_time_ns
from typing import Any

import numpy as np
from rich.console import Console

from rfcore.codec.h264.config import check_effort
from rfcore.codec.photometric import Photometric, adapt, solve
from rfcore.errors import InvalidInput
from rfcore.field import load_field
from rfcore.image import I420
from rfcore.native.warp import relight_i420
from rfedge.evaluate.cells import CellStore, program_version
from rfedge.evaluate.clips import STEADY, Drive, DriveName, read_drive
from rfedge.evaluate.field_coder import FieldCoder, render_clip
from rfedge.evaluate.performance import Performance, perform
from rfedge.evaluate.rate_curve import rate_curve
from rfedge.evaluate.rivals import x264_for_psnr
from rfedge.report.tables import heading, print_table, table
from rfedge.results import (
    Result,
    check_result_path,
    make_result,
    provenance,
    rows_of,
    write_result,
)

__all__ = [
    "AT_DB",
    "AdaptCase",
    "AdaptJob",
    "AdaptRow",
    "adapt_section",
    "drives_to_break_even",
    "kbit_at",
    "messages_differ",
    "most_kbit",
    "recovered_percent",
    "run_adapt",
    "second_vehicle_percent",
    "tool_ms",
]

AT_DB = 33.0
FINER_DB = 36.0
LEAST_LOSS = 0.1
"""Of the bits in the field's own light: shares of a smaller loss say nothing."""
FIRST = slice(0, 1)
POINTS = (18.0, 22.0, 26.0, 30.0, 34.0, 38.0, 42.0)
QUICK_FRAMES = 6
OWN_KEYS = ("field", "noon", "empty")
OFF, MATRIX, AUTO = "off", "matrix", "auto"
TOOLS: Mapping[str, tuple[Photometric | None, bool | None]] = {
    OFF: ((), False),
    MATRIX: (None, False),
    AUTO: (None, None),
}
"""Variants with the case's own field, and what the sender is told about the light: the numbers, and
whether to relight; None: where that pays."""


@dataclass(frozen=True)
class AdaptRow:
    """One drive coded in one way; None where a figure does not apply."""

    case: str
    drive: str
    frames: int
    variant: str
    kbit_33db: float | None
    """Kilobits a frame at a luma PSNR of 33 dB, the first frame apart."""
    lowest_psnr_db: float
    """Luma PSNR at the fewest bits: above 33 dB, ``kbit_33db`` is None."""
    x264_kbit_33db: float | None
    """Kilobits of x264 tuned for PSNR at 33 dB."""
    recovered_percent: float | None
    """Of what the drive costs more than in the field's own light, with the variant ``off``."""
    noon_bits_percent: float | None
    """Bits more than ``off`` takes in the field's own light; other fields are not taken there."""
    second_vehicle_percent: float | None
    """Bits above those of the street without what is new to the field, over those that ``off``
    takes above them; of fields that were learnt since."""
    side_bytes: int
    """Of the field or layer that the variant needs besides."""
    extra_ms: float | None
    """Processor time a frame of an end for the tool alone: relighting a render (``auto``), solving
    for and applying the matrix (``matrix``); medians of a run in which they take turns, whether
    the frame pays or not. None for fields, which cost nothing besides."""
    kbit_33db_at_most: float | None = None
    """Kilobits at the fewest bits, where those show more than 33 dB already."""
    kbit_36db: float | None = None
    recovered_36db_percent: float | None = None
    passes: int | None = None
    """From how many passes the variant's field was learnt."""
    identities: int | None = None
    """Of how many vehicles those were."""
    drives_to_break_even: float | None = None
    """Of this drive, until the bits saved at 33 dB are those of the field or layer."""
    messages_differ: int | None = None
    """Of a tool: messages that are not those of ``off``, of all frames at all rates."""
    noon_messages_differ: int | None = None
    """The same in the field's own light."""
    relit_frames: int | None = None
    """Frames under the light of the one before, or under one that was sent, at the rate nearest to
    33 dB."""
    switches: int | None = None
    """How often frames begin or cease to be relit there."""
    first_kbit_33db: float | None = None
    """Kilobits of the first frame where it has 33 dB itself."""


@dataclass(frozen=True)
class AdaptCase:
    """A drive in some light, the field of another one, and variants by name.

    ``noon``: the same drive in the field's light; ``empty``: without what the field has not seen;
    ``passes``: how many passes a variant's field was learnt from, ``identities``: of how many
    vehicles those were, where the case says so.
    """

    drive: DriveName
    field: Path
    noon: Path | None = None
    empty: Path | None = None
    variants: Mapping[str, Path] = with_factory(default_factory=dict)
    passes: Mapping[str, int] = with_factory(default_factory=dict)
    identities: Mapping[str, int] = with_factory(default_factory=dict)

    @staticmethod
    def parse(text: str) -> AdaptCase:
        """Read ``NAME@HZ=DRIVE,KEY[:PASSES[/VEHICLES]]=PATH...``.

        Raises ``InvalidInput`` for another form.
        """
        drive, *pairs = text.split(",")
        named: dict[str, Path] = {}
        passes: dict[str, int] = {}
        identities: dict[str, int] = {}
        for pair in pairs:
            found = re.fullmatch(r"([^:=]+)(?::([1-9]\d*)(?:/([1-9]\d*))?)?=(.+)", pair)
            if found is None or found[1] in named or found[1] in TOOLS:
                raise InvalidInput(
                    "cases", f"{pair!r} is not KEY=PATH or KEY:PASSES=PATH with a key of its own"
                )
            named[found[1]] = Path(found[4])
            if found[2] is not None:
                passes[found[1]] = int(found[2])
            if found[3] is not None:
                identities[found[1]] = _vehicles(pair, int(found[3]), int(found[2]))
        own, noon, empty = (named.pop(key, None) for key in OWN_KEYS)
        if own is None:
            raise InvalidInput("cases", f"{text!r} names no field=")
        unlearnt = sorted(set(passes) & set(OWN_KEYS))
        if unlearnt:
            raise InvalidInput("cases", f"{unlearnt[0]!r} is not learnt from passes: leave out :N")
        return AdaptCase(DriveName.parse(drive), own, noon, empty, named, passes, identities)

    @property
    def files(self) -> list[Path]:
        """Everything the case reads as one file."""
        return [self.field, *self.variants.values()]


def _vehicles(pair: str, vehicles: int, passes: int) -> int:
    """Return how many vehicles a field was learnt from; raise ``InvalidInput`` if it cannot be."""
    if vehicles > passes:
        raise InvalidInput("cases", f"{pair!r} has passes of more vehicles than passes")
    return vehicles


@dataclass(frozen=True)
class AdaptJob:
    """What to run; see ``rfedge-lab adapt --help``."""

    cases: Sequence[AdaptCase]
    effort: str
    preset: str
    out: Path
    cells: Path
    quick: bool = False

    def __post_init__(self) -> None:
        check_result_path(self.out)
        check_effort("effort", self.effort)
        if not self.cases:
            raise InvalidInput("cases", "there is none")

    def read(self, name: DriveName) -> Drive:
        """Return a drive's frames, the first few of them where it is to be quick."""
        return read_drive(name, QUICK_FRAMES if self.quick else None)


def run_adapt(job: AdaptJob, console: Console) -> dict[str, Any]:
    """Code what is not there yet, write ``job.out`` and print the rows.

    Raises ``DatasetError`` or ``FieldFormatError`` for inputs that cannot be read.
    """
    made = provenance([path for case in job.cases for path in case.files])
    store, rows = CellStore(job.cells), []
    for case in job.cases:
        for row in _Measured(job, case, store).rows():
            rows.append(row)
            console.print(f"{row.case} {row.variant}: {_kbit_text(row)}")
    result = make_result("adapt", made, {"quick": job.quick, "at_db": AT_DB, "rows": rows})
    write_result(job.out, result)
    print_table(console, "Another light", COLUMNS, [_cells(row) for row in rows])
    return result


def recovered_percent(
    off_kbit: float | None, noon_kbit: float | None, kbit: float | None
) -> float | None:
    """Return which share of the loss was won back; None where bits are, or the loss is below
    ``LEAST_LOSS``."""
    if off_kbit is None or noon_kbit is None or kbit is None:
        return None
    if off_kbit < (1 + LEAST_LOSS) * noon_kbit:
        return None
    return 100 * (off_kbit - kbit) / (off_kbit - noon_kbit)


def second_vehicle_percent(
    first_kbit: float | None, empty_kbit: float | None, kbit: float | None
) -> float | None:
    """Return which share of what is new a vehicle still pays for; None as above."""
    recovered = recovered_percent(first_kbit, empty_kbit, kbit)
    return None if recovered is None else 100 - recovered


@dataclass(frozen=True)
class _Measured:
    job: AdaptJob
    case: AdaptCase
    store: CellStore

    def rows(self) -> Iterator[AdaptRow]:
        """Yield a row for each variant."""
        case, drive = self.case, self.job.read(self.case.drive)
        x264_kbit = kbit_at(AT_DB, self._performed(drive, x264_for_psnr(self.job.preset)))
        plain = self._coded(drive, OFF, case.field)
        noon, empty = self._other("noon", case.noon), self._other("empty", case.empty)
        noon_plain = None if noon is None else self._coded(noon, OFF, case.field)
        noon_kbit, empty_off = _kbit_of(noon_plain), self._off_kbit(empty)
        extra_ms = self._tool_ms(drive)
        for variant in (*TOOLS, *case.variants):
            path = case.variants.get(variant)
            done = plain if variant == OFF else self._coded(drive, variant, path or case.field)
            noon_done = None
            if noon is not None and path is None:
                noon_done = self._coded(noon, variant, case.field)
            off_kbit, kbit, at_most = kbit_at(AT_DB, plain), kbit_at(AT_DB, done), most_kbit(done)
            enough = kbit if at_most is None else at_most
            side_bytes = 0 if path is None else path.stat().st_size
            chosen = done.nearest(AT_DB).notes["relit"]
            yield AdaptRow(
                case=case.drive.scene,
                drive=f"{case.drive.dataset.stem}@{case.drive.rate_hz:g}",
                frames=len(drive.frames),
                variant=variant,
                kbit_33db=kbit,
                lowest_psnr_db=min(clip.psnr_db() for clip in done.clips),
                x264_kbit_33db=x264_kbit,
                recovered_percent=recovered_percent(off_kbit, noon_kbit, enough),
                noon_bits_percent=_more_percent(noon_kbit, _kbit_of(noon_done)),
                second_vehicle_percent=(
                    None if path is None else second_vehicle_percent(off_kbit, empty_off, kbit)
                ),
                side_bytes=side_bytes,
                extra_ms=extra_ms.get(variant),
                kbit_33db_at_most=at_most,
                kbit_36db=kbit_at(FINER_DB, done),
                recovered_36db_percent=recovered_percent(
                    kbit_at(FINER_DB, plain),
                    _kbit_of(noon_plain, FINER_DB),
                    kbit_at(FINER_DB, done),
                ),
                passes=case.passes.get(variant),
                identities=case.identities.get(variant),
                drives_to_break_even=drives_to_break_even(
                    side_bytes, off_kbit, enough, len(drive.frames)
                ),
                messages_differ=messages_differ(plain, done) if path is None else None,
                noon_messages_differ=(
                    None
                    if noon_plain is None or noon_done is None
                    else messages_differ(noon_plain, noon_done)
                ),
                relit_frames=int(sum(map(float, chosen))),
                switches=int(np.count_nonzero(np.diff([float(relit) for relit in chosen]))),
                first_kbit_33db=kbit_at(AT_DB, done, FIRST),
            )

    def _tool_ms(self, drive: Drive) -> Mapping[str, float]:
        """Return the processor time a frame of each tool, measured once and kept."""
        key = {
            "scene": drive.name.scene,
            "frames": drive.digest,
            "field": load_field(self.case.field).field_id,
            "times": program_version(),
        }

        def make() -> list[dict[str, Any]]:
            rendered = render_clip(load_field(self.case.field), drive.cameras)
            return [tool_ms(drive.frames, rendered.renders)]

        return self.store.rows(key, make)[0]

    def _other(self, kind: str, dataset: Path | None) -> Drive | None:
        """Return the same drive in other circumstances, if the case names it."""
        if dataset is None:
            return None
        drive = self.case.drive
        return self.job.read(DriveName(f"{drive.scene}-{kind}", drive.rate_hz, dataset))

    def _off_kbit(self, drive: Drive | None) -> float | None:
        """Return what a drive takes with the case's own field."""
        if drive is None:
            return None
        return kbit_at(AT_DB, self._coded(drive, OFF, self.case.field))

    def _coded(self, drive: Drive, variant: str, path: Path) -> Performance:
        rendered = render_clip(load_field(path), drive.cameras)
        photometric, relight = TOOLS.get(variant, TOOLS[OFF])
        coder = FieldCoder(
            rendered,
            f"rfedge-{variant}-{self.job.effort}-{rendered.field_id[:12]}",
            program_version(),
            effort=self.job.effort,
            photometric=photometric,
            relight=relight,
            points=POINTS,
        )
        return self._performed(drive, coder)

    def _performed(self, drive: Drive, coder: Any) -> Performance:
        return perform(drive.clip(), coder, self.store)


def _kbit_of(done: Performance | None, psnr_db: float = AT_DB) -> float | None:
    return None if done is None else kbit_at(psnr_db, done)


def _more_percent(before: float | None, kbit: float | None) -> float | None:
    return None if before is None or kbit is None else 100 * (kbit / before - 1)


def most_kbit(done: Performance) -> float | None:
    """Return the kilobits a frame at the fewest bits; None where 33 dB can be had for fewer.

    Where those show more than 33 dB already, 33 dB takes at most as many.
    """
    coarsest = min(done.clips, key=lambda clip: clip.psnr_db())
    return 8e-3 * coarsest.bytes_per_frame() if coarsest.psnr_db() > AT_DB else None


def drives_to_break_even(
    side_bytes: int, off_kbit: float | None, kbit: float | None, frames: int
) -> float | None:
    """Return after how many drives of ``frames`` what was fetched is paid for; None if never."""
    if not side_bytes or off_kbit is None or kbit is None or kbit >= off_kbit:
        return None
    return 8e-3 * side_bytes / ((off_kbit - kbit) * frames)


def messages_differ(off: Performance, done: Performance) -> int:
    """Return how many messages of all points are not the same bytes."""
    pairs = zip(off.clips, done.clips, strict=True)
    return sum(
        one != other
        for plain, clip in pairs
        for one, other in zip(plain.notes["message"], clip.notes["message"], strict=True)
    )


def tool_ms(frames: Sequence[I420], renders: Sequence[I420]) -> dict[str, float]:
    """Return the median processor time a frame of each tool, which take turns frame by frame.

    Light is learnt from the frame before, as the camera saw it.
    """
    spent: dict[str, list[float]] = {OFF: [0.0], MATRIX: [], AUTO: []}
    for index in range(1, len(frames)):
        frame, render = frames[index], renders[index]
        seen, seen_render = frames[index - 1], renders[index - 1]
        spent[MATRIX].append(_cpu_ms(partial(_adapted, frame, render)))
        spent[AUTO].append(_cpu_ms(partial(relight_i420, seen, seen_render, render)))
    return {tool: median(ms) for tool, ms in spent.items() if ms}


def _adapted(frame: I420, render: I420) -> I420:
    return adapt(render, solve(frame, render))


def _cpu_ms(work: Callable[[], object]) -> float:
    began_ns = process_time_ns()
    work()
    return (process_time_ns() - began_ns) / 1e6


def kbit_at(psnr_db: float, done: Performance, frames: slice = STEADY) -> float | None:
    """Return the kilobits a frame of ``frames`` at their luma PSNR; None outside the curve."""
    reached_db = [clip.psnr_db(frames) for clip in done.clips]
    if not min(reached_db) <= psnr_db <= max(reached_db):
        return None
    return 8e-3 * rate_curve(done.clips, frames).bytes_at(psnr_db)


COLUMNS = (
    "case",
    "drive",
    "frames",
    "variant",
    "kbit at 33 dB",
    "lowest dB",
    "x264",
    "against x264 %",
    "recovered %",
    "bits at noon %",
    "second vehicle %",
    "side bytes",
    "extra ms",
)
LATER_COLUMNS: Mapping[str, Callable[[AdaptRow], object]] = {
    "kbit at 36 dB": lambda row: row.kbit_36db,
    "recovered at 36 dB %": lambda row: row.recovered_36db_percent,
    "passes": lambda row: row.passes,
    "vehicles": lambda row: row.identities,
    "drives to break even": lambda row: row.drives_to_break_even,
    "messages that differ": lambda row: row.messages_differ,
    "at noon": lambda row: row.noon_messages_differ,
    "relit frames": lambda row: row.relit_frames,
    "switches": lambda row: row.switches,
    "first kbit at 33 dB": lambda row: row.first_kbit_33db,
}
"""Left out of the page where no row has them, as in results of before."""


def adapt_section(path: Path, result: Result) -> str:
    """Return the table of the results page."""
    rows = rows_of(AdaptRow, result["rows"])
    later = {
        name: value
        for name, value in LATER_COLUMNS.items()
        if any(value(row) is not None for row in rows)
    }
    cells = [[*_cells(row), *(_later(value(row)) for value in later.values())] for row in rows]
    return "\n\n".join([heading(path, result), table((*COLUMNS, *later), cells), ""])


def _later(value: object) -> str:
    if value is None:
        return "n/a"
    return f"{value:.1f}" if isinstance(value, float) else str(value)


def _cells(row: AdaptRow) -> list[str]:
    bound = row.kbit_33db_at_most
    enough = row.kbit_33db if bound is None else bound
    against = _more_percent(row.x264_kbit_33db, enough)
    is_bound = bound is not None
    return [
        row.case,
        row.drive,
        str(row.frames),
        row.variant,
        _at("≤ ", is_bound, _kbit(enough)),
        f"{row.lowest_psnr_db:.1f}",
        _kbit(row.x264_kbit_33db),
        _at("≤ ", is_bound, _percent(against)),
        _at("≥ ", is_bound, _percent(row.recovered_percent)),
        _percent(row.noon_bits_percent),
        _percent(row.second_vehicle_percent),
        str(row.side_bytes),
        "n/a" if row.extra_ms is None else f"{row.extra_ms:+.1f}",
    ]


def _at(sign: str, is_bound: bool, text: str) -> str:
    return f"{sign}{text}" if is_bound and text != "n/a" else text


def _kbit_text(row: AdaptRow) -> str:
    if row.kbit_33db is not None:
        return f"{row.kbit_33db:.1f} kbit a frame"
    if row.kbit_33db_at_most is not None:
        most, from_db = row.kbit_33db_at_most, row.lowest_psnr_db
        return f"at most {most:.1f} kbit a frame: not at {AT_DB:g} dB, from {from_db:.1f} dB on"
    return f"not at {AT_DB:g} dB, from {row.lowest_psnr_db:.1f} dB on"


def _kbit(value: float | None) -> str:
    return "n/a" if value is None else f"{value:.1f}"


def _percent(value: float | None) -> str:
    return "n/a" if value is None else f"{value:+.1f}"
