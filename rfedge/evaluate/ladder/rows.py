"""The rows of a ladder, and the table of those that no other beats."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from rfcore.errors import InvalidInput
from rfedge.report.tables import Column, Table, columns, shown
from rfedge.results import Result, rows_of


@dataclass(frozen=True)
class LadderRow:
    """One rung at one CRF. Times are of the processor, in ms a frame, at one thread."""

    rung: str = field(metadata=shown("rung"))
    settings: Mapping[str, Any]
    """The rung as ``rfcore.codec.sender.ladder`` reads it."""
    sender_ms: float = field(metadata=shown("sender ms", ".1f"))
    receiver_ms: float = field(metadata=shown("receiver ms", ".1f"))
    sender_wall_ms: float
    """Time by the clock, as ``receiver_wall_ms``: other processes count."""
    receiver_wall_ms: float
    sender_stage_ms: Mapping[str, float]
    """Time of each stage of the sender, by its name."""
    receiver_stage_ms: Mapping[str, float]
    """Time of each stage of the receiver, by its name."""
    bits_per_frame: float
    """Mean size of a frame's message."""
    psnr_db: float = field(metadata=shown("PSNR dB", ".2f"))
    ssim: float = field(metadata=shown("SSIM", ".3f"))
    references_used: Mapping[str, int]
    """Number of frames by what they were predicted from."""
    rate_percent: float = field(metadata=shown("rate %", "+.1f"))
    """Bits at equal quality above the first rung's."""
    on_front: bool
    """Whether no other rung is as quick with fewer bits."""

    @property
    def crf(self) -> float:
        """Rate factor that the rung was measured at."""
        return float(self.settings["crf"])

    @property
    def other_settings(self) -> dict[str, Any]:
        """All settings but the CRF."""
        return {name: value for name, value in self.settings.items() if name != "crf"}


@dataclass(frozen=True)
class TrackingRow:
    """One effort of finding the pose in the field at one quality; without times if a picture of
    the drive was lost. Times are of the processor, in ms a frame, at one thread."""

    settings: Mapping[str, Any]
    """The kind of field and its quality, as in ``LadderRow``."""
    tracking: str = field(metadata=shown("tracking"))
    """``rfcore.codec.sender.ladder.TrackingEffort``."""
    track_ms: float | None = field(default=None, metadata=shown("ms", ".1f", "lost"))
    """Time beyond the one render that is made in any case."""
    renders: float | None = field(default=None, metadata=shown("renders", ".2f", ""))
    """Mean number of renders a frame."""
    rate_percent: float | None = field(default=None, metadata=shown("rate %", "+.1f", ""))
    """Bits at equal quality above those at the dataset's poses."""


KBIT = Column("kbit", lambda row: row.bits_per_frame / 1e3, ".1f")
FIGURES = ("rung", "sender_ms", "receiver_ms", KBIT, "psnr_db", "rate_percent")


def front_table(result: Result) -> Iterator[Table | str]:
    """Yield the rungs at the middle CRF that no other beats, the quickest first."""
    rows = middle_rows(rows_of(LadderRow, result["rows"]))
    yield Table(f"The front at CRF {rows[0].crf:g}", columns(LadderRow, *FIGURES), front_of(rows))


def middle_rows(rows: Sequence[LadderRow]) -> list[LadderRow]:
    """Return the rows at the middle CRF; raise ``InvalidInput`` if there is none."""
    if not rows:
        raise InvalidInput("result", "the ladder has no rows")
    crfs = sorted({row.crf for row in rows})
    return [row for row in rows if row.crf == crfs[len(crfs) // 2]]


def front_of(rows: Sequence[LadderRow]) -> list[LadderRow]:
    """Return the rows on the front, the quickest first."""
    return sorted((row for row in rows if row.on_front), key=lambda row: row.sender_ms)
