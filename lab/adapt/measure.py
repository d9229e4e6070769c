"""Measures the bits that another light costs, and how many each way of adapting wins back.

A *variant* is how a drive is coded: ``off``, with the field as it is; ``matrix``, with the sender's
matrix of colours (``rfcore.codec.photometric``) wherever it chooses to send one; ``auto``, as
vehicles do it: with renders under the light of the frame before (``rfcore.native.warp``) wherever
that pays, else a matrix; and any field or colour layer that the case names. With b the bits at
33 dB, ``recovered_percent`` is 100 (b_off - b) / (b_off - b_noon), where b_noon are those of the
same drive in the field's own light. A field that shows more than 33 dB before a bit is sent has no
such b: its bits at the coarsest point are an upper bound, and the share that it recovers is a lower
bound. At 36 dB every curve has bits.

In the right light the sender adapts nothing: ``messages_differ`` compares whole messages with those
of ``off``, byte for byte and at every rate.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from statistics import median
from time import process_time_ns
from typing import Any

import numpy as np
from rich.console import Console

from lab.adapt import EvalAdapt
from lab.report import Report, bars
from rfcore.codec.photometric import Photometric, adapt, solve
from rfcore.errors import InvalidInput
from rfcore.field import load_field
from rfcore.image import I420
from rfcore.native.warp import relight_i420
from rfedge.evaluate.clips import QUICK, STEADY, Drive, DriveName, read_drive
from rfedge.evaluate.field_coder import FieldCoder, render_clip
from rfedge.evaluate.performance import Performance, perform
from rfedge.evaluate.rate_curve import rate_curve
from rfedge.evaluate.rivals import x264_for_psnr
from rfedge.evaluate.runner import Run, program_version
from rfedge.report.tables import Column, Table, columns, shown
from rfedge.results import Result, rows_of

AT_DB = 33.0
FINER_DB = 36.0
LEAST_LOSS = 0.1
"""Smallest loss, as a share of the bits in the field's own light, that shares are taken of."""
FIRST = slice(0, 1)
POINTS = (18.0, 22.0, 26.0, 30.0, 34.0, 38.0, 42.0)
OWN_KEYS = ("field", "noon", "empty")
OFF, MATRIX, AUTO = "off", "matrix", "auto"
TOOLS: Mapping[str, tuple[Photometric | None, bool | None]] = {
    OFF: ((), False),
    MATRIX: (None, False),
    AUTO: (None, None),
}
"""Variants with the case's own field. Each has what the sender is told about the light: the numbers
of the matrix, and whether to relight; None leaves it to the sender."""


def _bounded_percent(value: float | None, row: AdaptRow, sign: str) -> str | None:
    """Return a percentage; where 33 dB has only a bound, with the sign that says so."""
    if value is None:
        return None
    return f"{sign if row.kbit_33db_at_most is not None else ''}{value:+.1f}"


@dataclass(frozen=True)
class AdaptRow:
    """One drive coded in one way; None where a figure does not apply."""

    case: str = field(metadata=shown("case"))
    drive: str = field(metadata=shown("drive"))
    frames: int = field(metadata=shown("frames"))
    variant: str = field(metadata=shown("variant"))
    kbit_33db: float | None
    """Kilobits a frame at a luma PSNR of 33 dB, without the first frame."""
    lowest_psnr_db: float = field(metadata=shown("lowest dB", ".1f"))
    """Luma PSNR at the fewest bits: above 33 dB, ``kbit_33db`` is None."""
    x264_kbit_33db: float | None = field(metadata=shown("x264 kbit at 33 dB", ".1f"))
    """Kilobits of x264 tuned for PSNR at 33 dB."""
    recovered_percent: float | None
    """Share won back of what ``off`` costs more than in the field's own light."""
    noon_bits_percent: float | None = field(metadata=shown("more bits at noon, %", "+.1f"))
    """Bits above those of ``off`` in the field's own light; only of tools."""
    second_vehicle_percent: float | None = field(metadata=shown("second vehicle %", "+.1f"))
    """Bits above those of the street without what is new to the field, over those that ``off``
    takes above them; of fields that were learnt since."""
    side_bytes: int = field(metadata=shown("side bytes"))
    """Size of the field or layer that the variant needs besides."""
    extra_ms: float | None = field(metadata=shown("extra ms", "+.1f"))
    """Processor time a frame that one end takes for the tool alone, whether the frame pays or not;
    a median of runs in which the tools take turns. Fields take none."""
    kbit_33db_at_most: float | None = None
    """Kilobits at the fewest bits, where those show more than 33 dB already."""
    kbit_36db: float | None = field(default=None, metadata=shown("kbit at 36 dB", ".1f"))
    recovered_36db_percent: float | None = field(
        default=None, metadata=shown("recovered at 36 dB, %", ".1f")
    )
    passes: int | None = field(default=None, metadata=shown("passes"))
    """Number of passes that the variant's field was learnt from."""
    identities: int | None = field(default=None, metadata=shown("vehicles"))
    """Number of vehicles that drove them."""
    drives_to_break_even: float | None = field(
        default=None, metadata=shown("drives to break even", ".1f")
    )
    """Number of drives like this one after which the bits saved at 33 dB are those of the field."""
    messages_differ: int | None = field(default=None, metadata=shown("messages that differ"))
    """Messages of a tool that are not those of ``off``, of all frames at all rates."""
    noon_messages_differ: int | None = field(default=None, metadata=shown("differ at noon"))
    """The same in the field's own light."""
    relit_frames: int | None = field(default=None, metadata=shown("relit frames"))
    """Frames under the light of the one before, or under one that was sent, at the rate nearest to
    33 dB."""
    switches: int | None = field(default=None, metadata=shown("switches"))
    """Number of times that frames begin or cease to be relit there."""
    first_kbit_33db: float | None = field(
        default=None, metadata=shown("first frame, kbit at 33 dB", ".1f")
    )
    """Kilobits of the first frame where it has 33 dB itself."""

    @property
    def enough_kbit(self) -> float | None:
        """Kilobits a frame that are enough for 33 dB."""
        return self.kbit_33db if self.kbit_33db_at_most is None else self.kbit_33db_at_most

    @property
    def kbit_text(self) -> str | None:
        """The same with what it is against x264, and whether it is a bound."""
        if self.enough_kbit is None:
            return None
        sign = "" if self.kbit_33db_at_most is None else "≤ "
        percent = _more_percent(self.x264_kbit_33db, self.enough_kbit)
        against = "" if percent is None else f" ({percent:+.1f} %)"
        return f"{sign}{self.enough_kbit:.1f}{against}"


@dataclass(frozen=True)
class AdaptCase:
    """A drive in some light, the field of another one, and variants by name.

    ``noon`` is the same drive in the field's light, ``empty`` the one without what the field has
    not seen. ``passes`` says from how many passes a variant's field was learnt, ``identities`` how
    many vehicles drove them, where the case says so.
    """

    drive: DriveName
    own: Path
    noon: Path | None = None
    empty: Path | None = None
    variants: Mapping[str, Path] = field(default_factory=dict)
    passes: Mapping[str, int] = field(default_factory=dict)
    identities: Mapping[str, int] = field(default_factory=dict)

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
        return [self.own, *self.variants.values()]


def _vehicles(pair: str, vehicles: int, passes: int) -> int:
    """Return how many vehicles a field was learnt from; raise ``InvalidInput`` if it cannot be."""
    if vehicles > passes:
        raise InvalidInput("cases", f"{pair!r} has passes of more vehicles than passes")
    return vehicles


def run_adapt(job: EvalAdapt, console: Console) -> dict[str, Any]:
    """Code what is not there yet, write the result and print its rows.

    Raises ``DatasetError`` or ``FieldFormatError`` for inputs that cannot be read.
    """
    cases = [AdaptCase.parse(text) for text in job.cases]
    run = Run.begin("adapt", job, [path for case in cases for path in case.files], console)
    rows = []
    for case in cases:
        for row in _CaseMeasuring(job, case, run).rows():
            rows.append(row)
            run.tell(f"{row.case} {row.variant}: {_kbit_line(row)}")
    return run.finish({"at_db": AT_DB, "rows": rows}, _parts)


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
class _CaseMeasuring:
    """The inputs that all variants of one case share."""

    job: EvalAdapt
    case: AdaptCase
    run: Run

    def rows(self) -> Iterator[AdaptRow]:
        """Yield a row for each variant."""
        case, drive = self.case, self._read(self.case.drive)
        x264_kbit = kbit_at(AT_DB, self._performed(drive, x264_for_psnr(self.job.preset)))
        plain = self._coded(drive, OFF, case.own)
        noon, empty = self._other("noon", case.noon), self._other("empty", case.empty)
        noon_plain = None if noon is None else self._coded(noon, OFF, case.own)
        noon_kbit, empty_off = _kbit_of(noon_plain, AT_DB), self._off_kbit(empty)
        extra_ms = self._tool_ms(drive)
        for variant in (*TOOLS, *case.variants):
            path = case.variants.get(variant)
            done = plain if variant == OFF else self._coded(drive, variant, path or case.own)
            noon_done = None
            if noon is not None and path is None:
                noon_done = self._coded(noon, variant, case.own)
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
                noon_bits_percent=_more_percent(noon_kbit, _kbit_of(noon_done, AT_DB)),
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
                    side_bytes, off_kbit, enough, drive.clip().drive_frames
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

    def _read(self, name: DriveName) -> Drive:
        return read_drive(name, QUICK if self.job.quick else None)

    def _tool_ms(self, drive: Drive) -> Mapping[str, float]:
        """Return the processor time a frame of each tool, measured once and kept."""
        key = {
            "scene": drive.name.scene,
            "frames": drive.digest,
            "field": load_field(self.case.own).field_id,
            "times": program_version("lab/adapt"),
        }

        def make() -> list[dict[str, Any]]:
            rendered = render_clip(load_field(self.case.own), drive.cameras)
            return [tool_ms(drive.frames, rendered.renders)]

        return self.run.store.rows(key, make)[0]

    def _other(self, kind: str, dataset: Path | None) -> Drive | None:
        """Return the same drive in other circumstances, if the case names it."""
        if dataset is None:
            return None
        drive = self.case.drive
        return self._read(DriveName(f"{drive.scene}-{kind}", drive.rate_hz, dataset))

    def _off_kbit(self, drive: Drive | None) -> float | None:
        """Return what a drive takes with the case's own field."""
        if drive is None:
            return None
        return kbit_at(AT_DB, self._coded(drive, OFF, self.case.own))

    def _coded(self, drive: Drive, variant: str, path: Path) -> Performance:
        rendered = render_clip(load_field(path), drive.cameras)
        photometric, relight = TOOLS.get(variant, TOOLS[OFF])
        coder = FieldCoder(
            rendered,
            f"rfedge-{variant}-{self.job.effort}-{rendered.field_id[:12]}",
            program_version("lab/adapt"),
            effort=self.job.effort,
            photometric=photometric,
            relight=relight,
            points=POINTS,
        )
        return self._performed(drive, coder)

    def _performed(self, drive: Drive, coder: Any) -> Performance:
        return perform(drive.clip(), coder, self.run.store)


def _kbit_of(done: Performance | None, psnr_db: float) -> float | None:
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


def _parts(result: Result) -> Iterator[Table | str]:
    rows = rows_of(AdaptRow, result["rows"])
    same = ("case", "variant")
    kbit = Column("kbit a frame at 33 dB (against x264)", lambda row: row.kbit_text)
    recovered = Column(
        "recovered %", lambda row: _bounded_percent(row.recovered_percent, row, "≥ ")
    )
    bits = (kbit, recovered, "kbit_36db", "recovered_36db_percent", "second_vehicle_percent")
    yield Table("Bits", columns(AdaptRow, *same, *bits), rows)
    takes = ("side_bytes", "passes", "identities", "drives_to_break_even", "extra_ms")
    yield Table("What the variants take", columns(AdaptRow, *same, *takes), rows)
    sent = ("messages_differ", "noon_messages_differ", "noon_bits_percent")
    relit = ("relit_frames", "switches")
    yield Table("What is sent", columns(AdaptRow, *same, *sent, *relit), rows)
    drive = ("drive", "frames", "lowest_psnr_db", "x264_kbit_33db", "first_kbit_33db")
    yield Table("The drives", columns(AdaptRow, *same, *drive), rows)


def _bars(result: Result) -> Iterator[tuple[str, float]]:
    for row in rows_of(AdaptRow, result["rows"]):
        if row.enough_kbit is not None:
            yield f"{row.case} {row.variant}", row.enough_kbit


REPORT = Report(
    "adapt",
    "Another light",
    "What a drive costs in another light than the field's, and how much of that each way of "
    "adapting to it wins back.",
    _parts,
    bars("kbit a frame at 33 dB", _bars),
)


def _kbit_line(row: AdaptRow) -> str:
    if row.kbit_33db is not None:
        return f"{row.kbit_33db:.1f} kbit a frame"
    if row.kbit_33db_at_most is not None:
        most, from_db = row.kbit_33db_at_most, row.lowest_psnr_db
        return f"at most {most:.1f} kbit a frame: not at {AT_DB:g} dB, from {from_db:.1f} dB on"
    return f"not at {AT_DB:g} dB, from {row.lowest_psnr_db:.1f} dB on"
