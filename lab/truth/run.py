"""Measures the cases, at this revision and at one before, and shows them beside each other."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from shutil import copy, copytree
from tempfile import TemporaryDirectory
from typing import Any

from rich.console import Console

import rfcore.native
from lab.report import Report
from lab.truth import EvalLiveTruth
from lab.truth.cameras import SENDER
from rfcore.errors import RfedgeError
from rfedge.report.tables import Column, Table, columns, print_tables, shown
from rfedge.results import Result, make_result, provenance, rows_of, write_result

PICTURES = (
    "pictures", "wrong_pictures", "left_out", "delay_ms", "least_delay_ms", "time_error_ms",
)  # fmt: skip
ERRORS = ("position_error_m", "height_error_m", "height_std_m", "heading_error_deg", "offset_s")
PACKAGES = ("cav_agent", "rfcore", "lab/__init__.py")


@dataclass(frozen=True)
class TruthRow:
    """A case: pictures handed on of a known stream, or the pose made of a known place.

    ``left_out``: pictures that were left out since they may be wrong. ``delay_ms``: from the last
    packet of a picture until the agent has it, the median and the least; ``time_error_ms``: of the
    time that is stated. ``height_std_m``: what the product itself states. ``refused``: what it
    said. Errors of a drive are medians, others the worst. ``before``: at the revision before.
    """

    case: str = field(metadata=shown("case"))
    pictures: int | None = field(default=None, metadata=shown("pictures"))
    wrong_pictures: int | None = field(default=None, metadata=shown("wrong"))
    left_out: int | None = field(default=None, metadata=shown("left out"))
    delay_ms: float | None = field(default=None, metadata=shown("delay ms", ".1f"))
    least_delay_ms: float | None = field(default=None, metadata=shown("least", ".1f"))
    time_error_ms: float | None = field(default=None, metadata=shown("time off ms", ".1f"))
    fixes: int | None = None
    position_error_m: float | None = field(default=None, metadata=shown("position off m", ".2f"))
    height_error_m: float | None = field(default=None, metadata=shown("height off m", ".2f"))
    height_std_m: float | None = field(default=None, metadata=shown("height stated to m", ".2f"))
    heading_error_deg: float | None = field(default=None, metadata=shown("heading off deg", ".2f"))
    offset_s: float | None = field(default=None, metadata=shown("offset found s", ".3f"))
    refused: str = field(default="", metadata=shown("said"))
    not_run: str = field(default="", metadata=shown("not run"))
    before: Mapping[str, Any] | None = None


def run_live_truth(job: EvalLiveTruth) -> dict[str, Any]:
    """Run every case, write the result and print it."""
    made, console = provenance(), Console()
    load = [os.getloadavg()[0]]
    rows = list(_measured(job, Path.cwd(), console))
    before: dict[str, Any] = {}
    if job.before is not None:
        with TemporaryDirectory() as folder:
            _check_out(job.before, Path(folder))
            for row in _measured(job, Path(folder), console):
                before[row.pop("case")] = row
    load.append(os.getloadavg()[0])
    told = [TruthRow(**row, before=before.get(row["case"])) for row in rows]
    content = {"before_revision": job.before, "load": load, "rows": told}
    result = make_result("live-truth", made, content)
    write_result(job.out, result)
    print_tables(truth_parts(result), console)
    return result


def truth_parts(result: Result) -> Iterator[Table | str]:
    """Yield cameras, then receivers, then what was before."""
    rows = rows_of(TruthRow, result["rows"])
    low, high = sorted(result["load"])
    yield (
        "A picture is wrong if it is none of those that were sent, bit for bit; one that shows two "
        "instants counts as wrong. A source gives none in the first half second, in which FFmpeg "
        "finds out what comes. A dash is nothing stated, or nothing to state. "
        f"The machine's load was {low:.1f} to {high:.1f} on {result['host']['cores']} cores"
        + (", so that delays are mostly of the load." if high > result["host"]["cores"] else ".")
    )
    cameras = [row for row in rows if row.pictures is not None]
    if cameras:
        yield Table("Cameras", columns(TruthRow, "case", *PICTURES, "refused"), cameras)
    poses = [row for row in rows if row.fixes is not None]
    if poses:
        yield Table("Receivers", columns(TruthRow, "case", *ERRORS, "refused"), poses)
    left = [row for row in rows if row.not_run]
    if left:
        yield Table("Not run", columns(TruthRow, "case", "not_run"), left)
    if result["before_revision"] is None:
        return
    yield f"The same cases at revision {result['before_revision']}:"
    for title, chosen, named in (
        ("Cameras, before", cameras, PICTURES),
        ("Receivers, before", poses, ERRORS),
    ):
        if chosen:
            told = columns(TruthRow, "case", *named, "refused", "not_run")
            yield Table(
                title, [told[0], *map(_of_before, told[1:], (*named, "refused", "not_run"))], chosen
            )


def _of_before(column: Column, name: str) -> Column:
    def value(row: TruthRow) -> Any:
        return (row.before or {}).get(name)

    return Column(column.heading, value, column.form, column.missing)


def _measured(job: EvalLiveTruth, folder: Path, console: Console) -> Iterator[dict[str, Any]]:
    """Run the cases in a process on the packages of a folder; yield their rows."""
    words = [sys.executable, "-m", "lab.truth.cases", *job.cases]
    if job.comma is not None:
        words += ["--comma", str(job.comma.absolute())]
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    with subprocess.Popen(
        words, cwd=folder, env=environment, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            row = json.loads(line)
            console.print(f"  {row['case']}: {row.get('not_run') or 'done'}")
            yield row
    if process.returncode:
        raise RfedgeError(f"{' '.join(words)}: exit status {process.returncode}")


def _check_out(revision: str, folder: Path) -> None:
    """Unpack a revision's product, with the cases and the compiled module of this one."""
    archive = folder / "packages.tar"
    command = ("git", "archive", "-o", str(archive), revision, *PACKAGES)
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RfedgeError(f"{' '.join(command)}: {done.stderr.strip()}")
    subprocess.run(("tar", "-xf", str(archive), "-C", str(folder)), check=True)
    copytree(Path(__file__).parent, folder / "lab" / "truth")
    (folder / "deploy" / "live").mkdir(parents=True)
    copy(SENDER, folder / "deploy" / "live")
    for module in (each for path in rfcore.native.__path__ for each in Path(path).glob("*.so")):
        copy(module, folder / "rfcore" / "native")


REPORT = Report(
    "live-truth",
    "Cameras and receivers as they are",
    "Which pictures a vehicle takes for its camera's, and where it takes itself to be, when "
    "packets are lost and receivers say less.",
    truth_parts,
)
