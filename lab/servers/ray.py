"""Tiles trained on Ray against tiles trained one after another: bytes, a killed worker, overhead.

Each run is a process of ``rfedge train``, whose lines say which tile and which worker they are of.
Start-up, until Ray has been reached, does not count; whatever a worker does first, does.
"""

from __future__ import annotations

import hashlib
import heapq
import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from lab.servers import EvalScale
from lab.servers.cases import Case, Measured, RayTiles, ScaleRow
from rfcore.errors import InvalidInput, RfedgeError
from rfedge.datasets.convert import LIST_NAME, read_tiles
from rfedge.processes import command_of

OVERHEAD_PERCENT = 5.0
FEWEST_TILES = 3
KILL_PERCENT = 50
"""A worker is killed once it has told of so much of its tile."""
CHECKPOINTS = 10
"""Number of checkpoints in the training of a tile."""
PROGRESS = re.compile(r"(\S+), process (\d+): +(\d+)%")
RESUMED = re.compile(r"(\S+), process (\d+): going on after iteration ([\d,]+)")
ENDED = re.compile(r"(\S+), process \d+: ended after ([0-9.]+) s")
REACHED = re.compile(r"Ray at \S+: (\d+) cores")


@dataclass(frozen=True)
class TileRun:
    """The output of a run of ``rfedge train``."""

    lines: tuple[str, ...]
    times_s: tuple[float, ...]
    """Time of each line on the monotonic clock."""
    killed: int
    """Workers that were killed on the way."""

    @property
    def cores(self) -> int:
        """Cores of the Ray; raises ``RfedgeError`` for a run without one."""
        return int(self._reached()[1])

    @property
    def work_s(self) -> tuple[float, ...]:
        """Seconds of each tile in its worker, in the order they ended."""
        return tuple(float(found[2]) for found in map(ENDED.match, self.lines) if found)

    @property
    def seconds(self) -> float:
        """Seconds from the moment Ray was reached to the end of the last tile."""
        last = max(i for i, line in enumerate(self.lines) if ENDED.match(line))
        return self.times_s[last] - self.times_s[self.lines.index(self._reached().string)]

    def workers_of(self, tile: str) -> set[int]:
        """Return the processes that worked on a tile."""
        found = [each for each in map(PROGRESS.match, self.lines) if each and each[1] == tile]
        return {int(each[2]) for each in found}

    def resumed_after(self, tile: str) -> tuple[int, ...]:
        """Return the iterations of the checkpoints from which work on a tile went on."""
        found = [each for each in map(RESUMED.match, self.lines) if each and each[1] == tile]
        return tuple(int(each[3].replace(",", "")) for each in found)

    def _reached(self) -> re.Match[str]:
        for line in self.lines:
            found = REACHED.match(line)
            if found:
                return found
        raise RfedgeError("the run says of no Ray that it was reached")


def train_tiles(
    tiles: Path, out: Path, options: Sequence[str], ray: str | None, kill_at: str | None = None
) -> TileRun:
    """Train every tile in a process; kill the first worker of tile ``kill_at`` on the way.

    Raises ``RfedgeError`` with the last line of a run that failed.
    """
    command = [*command_of("rfedge"), "train", str(tiles), "--out", str(out), *options]
    if ray is not None:
        command += ["--ray", ray]
    lines, times_s, killed = [], [], 0
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            lines.append(line.rstrip("\n"))
            times_s.append(time.monotonic())
            at = PROGRESS.match(line)
            if at and at[1] == kill_at and not killed and int(at[3]) >= KILL_PERCENT:
                os.kill(int(at[2]), signal.SIGKILL)
                killed = 1
    if process.returncode != 0:
        raise RfedgeError(f"training ended with {process.returncode}: " + "\n".join(lines[-5:]))
    return TileRun(tuple(lines), tuple(times_s), killed)


def overhead_percent(seconds: float, work_s: Sequence[float], workers: int) -> float:
    """Return by how much a run took longer than workers who take the next job at once.

    ``work_s`` are the jobs' own times; each goes, in this order, to the worker that is free first.
    Raises ``InvalidInput`` without work or workers.
    """
    if not work_s or workers < 1:
        raise InvalidInput("work", f"{len(work_s)} jobs on {workers} workers have no overhead")
    free_s = [0.0] * workers
    for job_s in work_s:
        heapq.heappush(free_s, heapq.heappop(free_s) + job_s)
    return 100 * (seconds / max(free_s) - 1)


def require_resumed(run: TileRun, tile: str) -> None:
    """Raise ``RfedgeError`` unless a worker of ``tile`` was killed and another one went on.

    From a checkpoint: a tile that was begun anew would have the same bytes.
    """
    workers, iterations = run.workers_of(tile), run.resumed_after(tile)
    if run.killed != 1 or len(workers) != 2 or len(iterations) != 1 or iterations[0] < 1:
        raise RfedgeError(
            f"{run.killed} workers of {tile} were killed at {KILL_PERCENT} %, {len(workers)} told "
            f"of progress, going on after iterations {list(iterations)}; it takes 1, 2 and one "
            "checkpoint: take more iterations"
        )


def ray_case(tiles: Path, iterations: int) -> Case:
    """Return the case of the tiles in a folder that ``rfedge dataset split`` made.

    Raises ``InvalidInput`` for a folder with fewer than ``FEWEST_TILES``, and for fewer iterations
    than ``CHECKPOINTS``.
    """
    listed = read_tiles(tiles)
    if listed is None:
        raise InvalidInput(
            "ray_tiles", f"{tiles} has no tiles.json: `rfedge dataset split` makes it"
        )
    if len(listed) < FEWEST_TILES:
        raise InvalidInput(
            "ray_tiles",
            f"{tiles} has {len(listed)} tiles, the case takes {FEWEST_TILES}; split with a smaller "
            "--length",
        )
    if iterations < CHECKPOINTS:
        raise InvalidInput("ray_iterations", f"{iterations} must be at least {CHECKPOINTS}")
    digest = hashlib.sha256((tiles / LIST_NAME).read_bytes()).hexdigest()
    return partial(_measure, tiles, listed[0].name, RayTiles(len(listed), digest, iterations))


def _measure(tiles: Path, first: str, trained: RayTiles, job: EvalScale) -> Measured:
    folder = job.work / "ray"
    shutil.rmtree(folder, ignore_errors=True)
    every = str(trained.iterations // CHECKPOINTS)
    options = ["--iterations", str(trained.iterations), "--threads", "1"]
    options += ["--checkpoint-every", every]
    train_tiles(tiles, folder / "alone", options, None)
    on_ray = train_tiles(tiles, folder / "on-ray", options, "local")
    killed = train_tiles(tiles, folder / "killed", options, "local", first)
    require_resumed(killed, first)
    alone = _fields(folder / "alone")
    added = overhead_percent(on_ray.seconds, on_ray.work_s, on_ray.cores)
    at_most = ScaleRow.at_most
    rows = [
        at_most("Ray: tiles with other bytes", 0, _differing(alone, _fields(folder / "on-ray"))),
        at_most(
            "Ray, a worker killed: tiles with other bytes",
            0,
            _differing(alone, _fields(folder / "killed")),
        ),
        at_most("Ray: longer than its jobs, % (start-up apart)", OVERHEAD_PERCENT, added),
    ]
    return Measured(rows, ray=(trained,))


def _fields(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob("*.rff")}


def _differing(here: dict[str, bytes], there: dict[str, bytes]) -> int:
    return sum(here.get(name) != there.get(name) for name in here.keys() | there.keys())
