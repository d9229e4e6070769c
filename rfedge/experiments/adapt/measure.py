"""Bits that another light costs, and which of them each way of adapting to it wins back.

A variant is how a drive is coded: ``off``, with the field as it is; ``matrix``, with the sender's
matrix of colours (``rfcore.codec.photometric``) wherever it chooses to send one; ``auto``, as
vehicles do it: with renders under the light of the frame before (``rfcore.native.warp``) wherever
that pays, else a matrix; and any field or colour layer that the case names. With b the bits at
33 dB, ``recovered_percent`` is 100 (b_off - b) / (b_off - b_noon), b_noon being those of the same
drive in the field's own light.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from dataclasses import field as with_factory
from pathlib import Path
from typing import Any

from rich.console import Console

from rfcore.codec.h264.config import check_effort
from rfcore.codec.photometric import Photometric
from rfcore.errors import InvalidInput
from rfcore.field import load_field
from rfedge.experiments.cells import CellStore, program_version
from rfedge.experiments.clips import Drive, DriveName, read_drive
from rfedge.experiments.field_coder import FieldCoder, render_clip
from rfedge.experiments.performance import Performance, perform
from rfedge.experiments.rivals import x264_for_psnr
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
    "kbit_at",
    "recovered_percent",
    "run_adapt",
    "second_vehicle_percent",
]

AT_DB = 33.0
POINTS = (18.0, 22.0, 26.0, 30.0, 34.0, 38.0, 42.0)
QUICK_FRAMES = 6
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
    extra_ms: float
    """Processor time a frame of the sender, more than ``off`` takes."""


@dataclass(frozen=True)
class AdaptCase:
    """A drive in some light, the field of another one, and variants by name.

    ``noon``: the same drive in the field's light; ``empty``: without what the field has not seen.
    """

    drive: DriveName
    field: Path
    noon: Path | None = None
    empty: Path | None = None
    variants: Mapping[str, Path] = with_factory(default_factory=dict)

    @staticmethod
    def parse(text: str) -> AdaptCase:
        """Read ``NAME@HZ=DRIVE,KEY=PATH...``; raise ``InvalidInput`` for text of another form."""
        drive, *pairs = text.split(",")
        named: dict[str, Path] = {}
        for pair in pairs:
            key, found, path = pair.partition("=")
            if not (key and found and path) or key in named or key in TOOLS:
                raise InvalidInput("cases", f"{pair!r} is not KEY=PATH with a key of its own")
            named[key] = Path(path)
        own, noon, empty = (named.pop(key, None) for key in ("field", "noon", "empty"))
        if own is None:
            raise InvalidInput("cases", f"{text!r} names no field=")
        return AdaptCase(DriveName.parse(drive), own, noon, empty, named)

    @property
    def files(self) -> list[Path]:
        """Everything the case reads as one file."""
        return [self.field, *self.variants.values()]


@dataclass(frozen=True)
class AdaptJob:
    """What to run; see ``rfedge eval adapt --help``."""

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
    """Return which share of the loss was won back; None where bits are, or without a loss."""
    if off_kbit is None or noon_kbit is None or kbit is None or noon_kbit >= off_kbit:
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
        x264 = self._performed(drive, x264_for_psnr(self.job.preset))
        plain = self._coded(drive, OFF, case.field)
        noon = self._other("noon", case.noon)
        noon_off, empty_off = self._off_kbit(noon), self._off_kbit(self._other("empty", case.empty))
        for variant in (*TOOLS, *case.variants):
            is_other = variant in case.variants
            path = case.variants.get(variant, case.field)
            done = plain if variant == OFF else self._coded(drive, variant, path)
            off_kbit, kbit = kbit_at(AT_DB, plain), kbit_at(AT_DB, done)
            second = second_vehicle_percent(off_kbit, empty_off, kbit) if is_other else None
            yield AdaptRow(
                case=case.drive.scene,
                drive=f"{case.drive.dataset.stem}@{case.drive.rate_hz:g}",
                frames=len(drive.frames),
                variant=variant,
                kbit_33db=kbit,
                lowest_psnr_db=min(clip.psnr_db() for clip in done.clips),
                x264_kbit_33db=kbit_at(AT_DB, x264),
                recovered_percent=recovered_percent(off_kbit, noon_off, kbit),
                noon_bits_percent=self._noon_percent(noon, noon_off, variant),
                second_vehicle_percent=second,
                side_bytes=path.stat().st_size if is_other else 0,
                extra_ms=done.cpu_ms_per_frame - plain.cpu_ms_per_frame,
            )

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

    def _noon_percent(
        self, noon: Drive | None, off_kbit: float | None, variant: str
    ) -> float | None:
        """Return how many more bits a tool takes in the field's own light.

        None for other fields: there the vehicle takes the one that fits.
        """
        if noon is None or off_kbit is None or variant not in TOOLS:
            return None
        kbit = kbit_at(AT_DB, self._coded(noon, variant, self.case.field))
        return None if kbit is None else 100 * (kbit / off_kbit - 1)

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


def kbit_at(psnr_db: float, done: Performance) -> float | None:
    """Return the kilobits a frame at a luma PSNR, the first frame apart; None outside the curve."""
    reached_db = [clip.psnr_db() for clip in done.clips]
    if not min(reached_db) <= psnr_db <= max(reached_db):
        return None
    return 8e-3 * done.steady.bytes_at(psnr_db)


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


def adapt_section(path: Path, result: Result) -> str:
    """Return the table of the results page."""
    rows = map(_cells, rows_of(AdaptRow, result["rows"]))
    return "\n\n".join([heading(path, result), table(COLUMNS, rows), ""])


def _cells(row: AdaptRow) -> list[str]:
    against = None
    if row.kbit_33db is not None and row.x264_kbit_33db is not None:
        against = 100 * (row.kbit_33db / row.x264_kbit_33db - 1)
    return [
        row.case,
        row.drive,
        str(row.frames),
        row.variant,
        _kbit(row.kbit_33db),
        f"{row.lowest_psnr_db:.1f}",
        _kbit(row.x264_kbit_33db),
        _percent(against),
        _percent(row.recovered_percent),
        _percent(row.noon_bits_percent),
        _percent(row.second_vehicle_percent),
        str(row.side_bytes),
        f"{row.extra_ms:+.1f}",
    ]


def _kbit_text(row: AdaptRow) -> str:
    if row.kbit_33db is None:
        return f"not at {AT_DB:g} dB, from {row.lowest_psnr_db:.1f} dB on"
    return f"{row.kbit_33db:.1f} kbit a frame"


def _kbit(value: float | None) -> str:
    return "n/a" if value is None else f"{value:.1f}"


def _percent(value: float | None) -> str:
    return "n/a" if value is None else f"{value:+.1f}"
