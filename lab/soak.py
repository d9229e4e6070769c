"""Check that nothing grows in a long run at half load: ``python -m lab.soak --minutes 30``.

Two prerecorded vehicles at 5 Hz put half the load on ``mec-server`` that it must hold on two cores.
Its memory must grow by less than 1 MB a minute (least squares over the counted part), the least
descriptors and processes it holds may not rise (what is leaked stays; a socket that lives for a
moment is none), and no vehicle may lose its stream. Pools start a thread when all theirs are busy
for once, and keep it: threads grow if they do from each quarter of the run to the next, or by more
than a pool may lack. Latency is not judged: others may use the machine.
"""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

from lab.report import Report
from rfcore.errors import InvalidInput, RfedgeError
from rfcore.program import parse_options, run_program
from rfedge.loadtest.drive import Sample
from rfedge.loadtest.plan import Load, Mode
from rfedge.loadtest.run import Run, TestBed, run_load
from rfedge.report.tables import Table, named_columns
from rfedge.results import Result, make_result, provenance, write_result
from rfedge.samples import sample_path

Amount = TypeVar("Amount", int, float)

MAX_SLOPE_MB = 1.0
"""Largest growth of memory, MB a minute."""
LEAST_SHARE = 0.5
"""Share of the frames that were due; with fewer reconstructed the server was not at half load."""

QUARTERS = 4
"""The least counts in the last quarter of the run are compared with those in the first."""
POOLED_THREADS = 3
"""May be started late: of asyncio's, gRPC's and the renderers' pools, one each."""


@dataclass(frozen=True)
class SoakSettings:
    """Let a server work for long, and see that nothing grows."""

    minutes: float = 30.0
    """Minutes of load after a warm-up."""
    vehicles: int = 2
    """Number of vehicles that send pictures."""
    hz: float = 5.0
    """Pictures per second of each."""
    warm_up: float = 60.0
    """Seconds before it counts: caches fill, allocators find their size."""
    field: Path = sample_path("fields/street.rff")
    """Field archive, the only one in its folder."""
    drive: Path = sample_path("street/transforms_drive_vehicles.json")
    """Drive whose pictures the vehicles send."""
    out: Path = Path("out/soak/soak.json")
    """File for the result; beside it, the processes' logs."""

    def __post_init__(self) -> None:
        if not 0 < self.minutes <= 24 * 60:
            raise InvalidInput("minutes", f"{self.minutes:g} is outside 0..1440")


@dataclass(frozen=True)
class SoakRow:
    """One soak. ``*_first`` and ``*_last`` are the least in the first and the last quarter."""

    minutes: float
    vehicles: int
    hz: float
    held: bool
    frames: int
    slope_mb_per_minute: float
    memory_mb_first: float
    descriptors_first: int
    threads_first: int
    processes_first: int
    memory_mb_last: float
    descriptors_last: int
    threads_last: int
    processes_last: int
    server_cores: float
    p50_ms: float | None
    p99_ms: float | None


def soak(settings: SoakSettings) -> dict[str, Any]:
    """Run, write the result, return it; raise ``RfedgeError`` if anything grew."""
    made = provenance([settings.field], command=_command())
    seconds = 60 * settings.minutes
    load = Load(Mode.FULL, settings.vehicles, settings.hz, seconds, settings.warm_up)
    folder = settings.out.parent
    bed = TestBed(settings.field, settings.drive, 2, Path("out/cache/loadtest"), folder / "work")
    run = run_load(load, bed)
    samples = run.usage["server"].samples
    problems = [*what_grew(samples), *_lost(run)]
    row = _row(settings, run, samples, held=not problems)
    result = make_result("soak", made, {"rows": [row]})
    write_result(settings.out, result)
    if problems:
        raise RfedgeError(f"soak: {'; '.join(problems)} (see {settings.out})")
    return result


def _parts(result: Result) -> Iterator[Table | str]:
    yield Table("", named_columns(each.name for each in fields(SoakRow)), result["rows"])


REPORT = Report(
    "soak",
    "A long run at half load",
    "Whether memory, descriptors and threads of a server grow while it works for long.",
    _parts,
)


def _command() -> str:
    return shlex.join(["python", "-m", "lab.soak", *sys.argv[1:]])


def what_grew(samples: Sequence[Sample]) -> list[str]:
    """Return what grew, in words; nothing if nothing did."""
    slope_mb = slope_per_minute(samples)
    problems = []
    if slope_mb >= MAX_SLOPE_MB:
        problems.append(f"memory grows {slope_mb:.2f} MB a minute, {MAX_SLOPE_MB:g} is too much")
    for name, count in COUNTED:
        least = _least(samples, count)
        late_pool = name == "threads" and least[-1] - least[0] <= POOLED_THREADS
        steadily = all(a < b for a, b in pairwise(least))
        if least[-1] > least[0] and (steadily or not late_pool):
            problems.append(f"{name} grew from {least[0]} to {least[-1]}")
    return problems


def slope_per_minute(samples: Sequence[Sample]) -> float:
    """Return the least-squares slope of memory in MB per minute."""
    if len(samples) < 2:
        return 0.0
    minutes = [(s.at_s - samples[0].at_s) / 60 for s in samples]
    mean_t = sum(minutes) / len(minutes)
    mean_mb = sum(s.rss_mb for s in samples) / len(samples)
    spread = sum((t - mean_t) ** 2 for t in minutes)
    pairs = zip(minutes, samples, strict=True)
    return sum((t - mean_t) * (s.rss_mb - mean_mb) for t, s in pairs) / spread if spread else 0.0


COUNTED: tuple[tuple[str, Callable[[Sample], int]], ...] = (
    ("descriptors", lambda sample: sample.descriptors),
    ("threads", lambda sample: sample.threads),
    ("processes", lambda sample: sample.children),
)


def _least(samples: Sequence[Sample], count: Callable[[Sample], Amount]) -> list[Amount]:
    """Return the least there was in each quarter; a short run has samples that count twice."""
    edges = [len(samples) * quarter // QUARTERS for quarter in range(QUARTERS + 1)]
    return [min(map(count, samples[begin : max(end, begin + 1)])) for begin, end in pairwise(edges)]


def _lost(run: Run) -> list[str]:
    """Return what became of frames and vehicles that should have been served, in words."""
    due = run.load.vehicles * run.load.hz * run.load.duration_s
    problems = []
    if len(run.latency_ms) < LEAST_SHARE * due:
        problems.append(
            f"{len(run.latency_ms)} of {due:.0f} frames were reconstructed, too few for half load"
        )
    if run.row.failed:
        problems.append(f"{run.row.failed} vehicles lost their streams")
    if run.row.nacked:
        problems.append(f"{run.row.nacked} frames were refused")
    return problems


def _row(settings: SoakSettings, run: Run, samples: Sequence[Sample], *, held: bool) -> SoakRow:
    counts = {name: _least(samples, count) for name, count in COUNTED}
    memory_mb = _least(samples, lambda sample: sample.rss_mb)
    return SoakRow(
        minutes=settings.minutes,
        vehicles=settings.vehicles,
        hz=settings.hz,
        held=held,
        frames=len(run.latency_ms),
        slope_mb_per_minute=slope_per_minute(samples),
        memory_mb_first=memory_mb[0],
        memory_mb_last=memory_mb[-1],
        **{f"{name}_first": least[0] for name, least in counts.items()},
        **{f"{name}_last": least[-1] for name, least in counts.items()},
        server_cores=run.row.server_cores,
        p50_ms=run.row.p50_ms,
        p99_ms=run.row.p99_ms,
    )


def main() -> None:
    """Soak as the command line says, and print the row."""
    settings: SoakSettings = parse_options(SoakSettings, "lab.soak")
    print(json.dumps(soak(settings)["rows"][0], indent=1))


if __name__ == "__main__":
    sys.exit(run_program("lab.soak", main))
