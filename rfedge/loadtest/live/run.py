"""The parts of the live experiment one after the other, and their result."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from rich.console import Console

from rfcore.errors import InvalidInput
from rfedge.loadtest.live.report import AgeRow, IngestRow, SourceRow, print_live
from rfedge.loadtest.live.showing import TwinBed, measure_age, measure_ingest
from rfedge.loadtest.live.sources import LiveCamera, measure_source
from rfedge.results import check_result_path, make_result, provenance, write_result

__all__ = ["LiveJob", "run_live"]

MOST_SECONDS = 86_400.0


@dataclass(frozen=True)
class LiveJob:
    """What is measured: see ``EvalLive``."""

    cameras: tuple[int, ...]
    hz: float
    seconds: float
    rounds: int
    consumers: int
    sources: tuple[str, ...]
    source_seconds: float
    kill_every_s: float
    field: Path
    drive: Path
    work: Path
    out: Path

    def __post_init__(self) -> None:
        check_result_path(self.out)
        if any(not 1 <= count <= 64 for count in self.cameras):
            raise InvalidInput("cameras", f"{self.cameras} are not all within 1..64")
        for name in ("hz", "seconds", "source_seconds", "kill_every_s"):
            if not 0 < getattr(self, name) <= MOST_SECONDS:
                raise InvalidInput(name, f"{getattr(self, name):g} is outside 0..{MOST_SECONDS:g}")
        if not 0 <= self.consumers <= 50:
            raise InvalidInput("consumers", f"{self.consumers} is outside 0..50")
        for kind in self.sources:
            self.camera(kind)

    def camera(self, kind: str) -> LiveCamera:
        """Return a live camera of this job."""
        folder = self.work / kind
        return LiveCamera(kind, folder, self.source_seconds, self.kill_every_s)


def run_live(job: LiveJob, console: Console) -> None:
    """Measure every part that was asked for, print it, and write the result."""
    bed = TwinBed(job.field, job.drive, job.work, job.hz, job.seconds)
    ages: list[AgeRow] = []
    for count in job.cameras:
        ages.append(measure_age(bed, count))
        print_live(console, ages[-1:])
    ingest: list[IngestRow] = []
    if job.rounds:
        ingest.append(measure_ingest(bed, job.rounds, job.consumers))
        print_live(console, ingest)
    sources: list[SourceRow] = []
    for kind in job.sources:
        sources.append(measure_source(job.camera(kind), job.drive, job.field, job.work))
        print_live(console, sources[-1:])
    content = {"settings": asdict(job), "ages": ages, "ingest": ingest, "sources": sources}
    write_result(job.out, make_result("live", provenance([job.field, job.drive]), content))
