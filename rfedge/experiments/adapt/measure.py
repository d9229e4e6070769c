"""Bits that another light costs, and which of them each way of adapting to it wins back.

A variant is how a drive is coded: ``off``, with the field as it is; ``matrix``, with the sender's
matrix of colours (``rfcore.codec.photometric``) wherever it chooses to send one; and any field or
colour layer that the case names. With b the bits at 33 dB, ``recovered_percent`` is
100 (b_off - b) / (b_off - b_noon), b_noon being those of the same drive in the field's own light.
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
    "recovered_percent",
    "run_adapt",
]

AT_DB = 33.0
POINTS = (18.0, 22.0, 26.0, 30.0, 34.0, 38.0, 42.0)
QUICK_FRAMES = 6
OFF, MATRIX = "off", "matrix"
TOOLS: Mapping[str, Photometric | None] = {OFF: (), MATRIX: None}
"""Variants with the case's own field, and what the sender is told about the light."""


@dataclass(frozen=True)
class AdaptRow:
    """One drive coded in one way; None where a figure does not apply."""

    case: str
    drive: str
    frames: int
    variant: str
    kbit_33db: float
    """Kilobits a frame at a luma PSNR of 33 dB, the first frame apart."""
    x264_kbit_33db: float
    """The same of x264 tuned for PSNR."""
    recovered_percent: float | None
    """Of what the drive costs more than in the field's own light, with the variant ``off``."""
    noon_bits_percent: float | None
    """Bits more than ``off`` takes in the field's own light; other fields are not taken there."""
    second_vehicle_percent: float | None
    """A second vehicle's bytes a frame over the first one's, above those of the empty street."""
    side_bytes: int
    """Of the field or layer that the variant needs besides."""
    extra_ms: float
    """Processor time a frame of the sender, more than ``off`` takes."""


@dataclass(frozen=True)
class AdaptCase:
    """A drive in some light, the field of another one, and variants by name."""

    drive: DriveName
    field: Path
    noon: Path | None = None
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
        if "field" not in named:
            raise InvalidInput("cases", f"{text!r} names no field=")
        own, noon = named.pop("field"), named.pop("noon", None)
        return AdaptCase(DriveName.parse(drive), own, noon, named)

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

    Raises ``InvalidInput`` where no point of a coder reaches 33 dB, ``DatasetError`` or
    ``FieldFormatError`` for inputs that cannot be read.
    """
    made = provenance([path for case in job.cases for path in case.files])
    store, rows = CellStore(job.cells), []
    for case in job.cases:
        for row in _Measured(job, case, store).rows():
            rows.append(row)
            console.print(f"{row.case} {row.variant}: {row.kbit_33db:.1f} kbit a frame")
    result = make_result("adapt", made, {"quick": job.quick, "at_db": AT_DB, "rows": rows})
    write_result(job.out, result)
    print_table(console, "Another light", COLUMNS, [_cells(row) for row in rows])
    return result


def recovered_percent(off_kbit: float, noon_kbit: float | None, kbit: float) -> float | None:
    """Return which share of the loss was won back; None without a noon or without a loss."""
    if noon_kbit is None or noon_kbit >= off_kbit:
        return None
    return 100 * (off_kbit - kbit) / (off_kbit - noon_kbit)


@dataclass(frozen=True)
class _Measured:
    job: AdaptJob
    case: AdaptCase
    store: CellStore

    def rows(self) -> Iterator[AdaptRow]:
        """Yield a row for each variant."""
        case = self.case
        drive = self.job.read(case.drive)
        noon = self._noon()
        x264 = self._performed(drive, x264_for_psnr(self.job.preset))
        plain = self._coded(drive, OFF, case.field)
        noon_off = None if noon is None else self._kbit(self._coded(noon, OFF, case.field))
        for variant in (OFF, MATRIX, *case.variants):
            path = case.variants.get(variant, case.field)
            done = plain if variant == OFF else self._coded(drive, variant, path)
            kbit = self._kbit(done)
            yield AdaptRow(
                case=case.drive.scene,
                drive=f"{case.drive.dataset.stem}@{case.drive.rate_hz:g}",
                frames=len(drive.frames),
                variant=variant,
                kbit_33db=kbit,
                x264_kbit_33db=self._kbit(x264),
                recovered_percent=recovered_percent(self._kbit(plain), noon_off, kbit),
                noon_bits_percent=self._noon_percent(noon, noon_off, variant),
                second_vehicle_percent=None,
                side_bytes=path.stat().st_size if variant in case.variants else 0,
                extra_ms=done.cpu_ms_per_frame - plain.cpu_ms_per_frame,
            )

    def _noon(self) -> Drive | None:
        if self.case.noon is None:
            return None
        name = DriveName(f"{self.case.drive.scene}-noon", self.case.drive.rate_hz, self.case.noon)
        return self.job.read(name)

    def _noon_percent(
        self, noon: Drive | None, off_kbit: float | None, variant: str
    ) -> float | None:
        """Return how many more bits a tool takes in the field's own light.

        None for other fields: there the vehicle takes the one that fits.
        """
        if noon is None or off_kbit is None or variant not in TOOLS:
            return None
        return 100 * (self._kbit(self._coded(noon, variant, self.case.field)) / off_kbit - 1)

    def _coded(self, drive: Drive, variant: str, path: Path) -> Performance:
        rendered = render_clip(load_field(path), drive.cameras)
        coder = FieldCoder(
            rendered,
            f"rfedge-{variant}-{self.job.effort}-{rendered.field_id[:12]}",
            program_version(),
            effort=self.job.effort,
            photometric=TOOLS.get(variant, ()),
            points=POINTS,
        )
        return self._performed(drive, coder)

    def _performed(self, drive: Drive, coder: Any) -> Performance:
        return perform(drive.clip(), coder, self.store)

    def _kbit(self, done: Performance) -> float:
        """Return the kilobits a frame at 33 dB, the first frame apart.

        A field that shows more before a bit is sent is taken at its lowest quality.
        """
        curve = done.steady
        return 8e-3 * curve.bytes_at(max(AT_DB, float(curve.psnr_db[0])))


COLUMNS = (
    "case",
    "drive",
    "frames",
    "variant",
    "kbit at 33 dB",
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
    against = 100 * (row.kbit_33db / row.x264_kbit_33db - 1)
    return [
        row.case,
        row.drive,
        str(row.frames),
        row.variant,
        f"{row.kbit_33db:.1f}",
        f"{row.x264_kbit_33db:.1f}",
        f"{against:+.1f}",
        _percent(row.recovered_percent),
        _percent(row.noon_bits_percent),
        _percent(row.second_vehicle_percent),
        str(row.side_bytes),
        f"{row.extra_ms:+.1f}",
    ]


def _percent(value: float | None) -> str:
    return "n/a" if value is None else f"{value:+.1f}"
