"""Jobs that run one after another, in local processes or on Ray, and what they leave on disk.

A finished piece of work is a ``Cell``: a JSON file that holds the key of everything its result
depends on, and the result. Files appear whole or not at all (``rfcore.files``), so a run that was
stopped goes on where it was.

A ``Job`` is named, can be pickled, and depends on nothing but what it was made from, threads
included: its files have the same bytes wherever it runs. A cell beside its first output says what
the outputs were made from; a job whose outputs are there, made from the same, is skipped. A job
that does not say what it is made from is done each time, and looks itself for cells that are there.
A job whose process was killed is begun again, and goes on where it left a checkpoint. A job that
fails does not stop the others.

On Ray all machines must have this version of rfedge and see the same folders at the same paths.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import socket
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from time import monotonic
from typing import Any

from rich.console import Console

from rfcore.errors import InvalidData, InvalidInput, RfedgeError
from rfcore.extras import needs
from rfcore.files import write_whole
from rfcore.wire.address import Address

Tell = Callable[[str], None]
"""Takes a line about how a job goes."""
CellKey = Mapping[str, str | float | int | None]
Rows = list[dict[str, Any]]
LOCAL = "local"
RETRIES = 3
"""A job whose process was killed is begun again at most so often."""
MOST_PROCESSES = 256
POLL_S = 0.2
REACHED_WITHIN_S = 10.0
OBJECT_STORE_BYTES = 100 << 20
"""Memory for objects of a Ray that is started here: jobs hand over files, not objects."""
LINE_COLUMNS = 200


@dataclass(frozen=True)
class Cell:
    """A file that holds a result with the key of all that it depends on."""

    path: Path
    key: CellKey

    @property
    def is_kept(self) -> bool:
        """Whether the file is there and was made from this key."""
        try:
            self.result()
        except (OSError, InvalidData):
            return False
        return True

    def result(self) -> Any:
        """Return the result; raise ``InvalidData`` naming a file that is damaged."""
        try:
            stored = json.loads(self.path.read_text(encoding="utf-8"))
            if stored["key"] != dict(self.key):
                raise ValueError("it was made for another key")
            return stored["result"]
        except (ValueError, KeyError, TypeError) as error:
            raise self.damaged(error) from error

    def keep(self, result: object) -> None:
        """Write the file, and the folder that it belongs in."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        content = json.dumps({"key": dict(self.key), "result": result}, indent=1)
        write_whole(self.path, content + "\n")

    def forget(self) -> None:
        """Remove the file if there is one."""
        self.path.unlink(missing_ok=True)

    def damaged(self, why: object) -> InvalidData:
        """Return the error for a file that cannot be used."""
        return InvalidData(f"{self.path}: not a finished cell ({why}); delete it to redo it")


@dataclass(frozen=True)
class CellStore:
    """A folder of cells, each in a file named by the digest of its key."""

    folder: Path

    def cell(self, key: CellKey) -> Cell:
        """Return the cell of ``key``, whether it is there or not."""
        canonical = json.dumps(dict(key), sort_keys=True, allow_nan=False)
        name = hashlib.sha256(canonical.encode()).hexdigest()[:32]
        return Cell(self.folder / f"{name}.json", key)

    def has(self, key: CellKey) -> bool:
        """Return whether the cell of ``key`` is there already."""
        return self.cell(key).path.exists()

    def rows(self, key: CellKey, make: Callable[[], Rows]) -> Rows:
        """Return the rows of ``key``, from the folder or made by ``make`` and then kept.

        Raises ``InvalidData`` naming the file if the cell is damaged.
        """
        cell = self.cell(key)
        if not cell.path.exists():
            rows = make()
            cell.keep(rows)
            return rows
        stored = cell.result()
        if not isinstance(stored, list):
            raise cell.damaged("it holds no rows")
        return stored


@dataclass(frozen=True)
class Job:
    """Files to make, and the work that makes them."""

    name: str
    work: Callable[[Tell], None]
    """Makes the files; a function of a module, or a partial of one, since it is pickled."""
    outputs: tuple[Path, ...] = ()
    made_from: str | None = None
    """All that the files' bytes depend on, in one line; None: it is done each time."""
    cores: int = 1
    memory_bytes: int = 2_000_000_000

    def __post_init__(self) -> None:
        if not self.outputs and self.made_from is not None:
            raise InvalidInput("outputs", f"job {self.name} makes no file")
        if self.cores < 1:
            raise InvalidInput("cores", f"{self.cores} of job {self.name} must be at least 1")

    @property
    def is_done(self) -> bool:
        """Whether the files are there, made from the same."""
        marker = self._marker
        return marker is not None and marker.is_kept and all(map(Path.exists, self.outputs))

    @property
    def _marker(self) -> Cell | None:
        """The cell that says what the outputs were made from."""
        if self.made_from is None:
            return None
        first = self.outputs[0]
        return Cell(first.with_name(f"{first.name}.job"), {"made from": self.made_from})

    def run(self, tell: Tell) -> str | None:
        """Make the files; return None, or what went wrong."""
        marker = self._marker
        try:
            if marker is not None:
                marker.forget()
            self.work(tell)
            missing = [str(path) for path in self.outputs if not path.exists()]
            if missing:
                return f"did not write {', '.join(missing)}"
            if marker is not None:
                marker.keep(None)
        except (RfedgeError, OSError) as error:
            return str(error)
        except Exception as error:
            tell(traceback.format_exc())
            return f"{type(error).__name__}: {error}"
        return None


def check_processes(processes: int) -> None:
    """Raise ``InvalidInput`` for a number of processes that ``run_jobs`` does not start."""
    if not 1 <= processes <= MOST_PROCESSES:
        raise InvalidInput("processes", f"{processes} is outside 1..{MOST_PROCESSES}")


def run_jobs(
    jobs: Sequence[Job], tell: Tell, ray_address: str | None = None, processes: int = 1
) -> int:
    """Do the jobs that are not done yet; return how many were done before.

    They run here one after another, or ``processes`` of them at a time in processes of their own;
    with ``ray_address`` on the Ray at that address, ``local`` starting one with this machine's
    cores. Every line of every job goes to ``tell`` with the job's name and its process; local
    processes print theirs. Raises ``InvalidInput`` for two jobs of one name, ``RfedgeError`` at the
    end naming the jobs that failed and why, ``BackendUnavailable`` without Ray.
    """
    check_processes(processes)
    names = [job.name for job in jobs]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InvalidInput("jobs", f"more than one is named {', '.join(twice)}")
    waiting = [job for job in jobs if not job.is_done]
    for job in jobs:
        if job not in waiting:
            tell(f"{job.name}: done before")
    if ray_address is not None:
        ended = _on_ray(waiting, tell, ray_address)
    elif processes > 1:
        ended = _in_processes(waiting, processes)
    else:
        ended = ((job, _run_telling(job, tell)) for job in waiting)
    failed = []
    for job, problem in ended:
        tell(f"{job.name}: {'done' if problem is None else f'failed: {problem}'}")
        if problem is not None:
            failed.append(f"{job.name}: {problem}")
    if failed:
        of = f"{len(failed)} of {len(jobs)} jobs failed"
        raise RfedgeError("\n  ".join([f"{of}; the same command does them again:", *failed]))
    return len(jobs) - len(waiting)


def _in_processes(jobs: Sequence[Job], processes: int) -> Iterator[tuple[Job, str | None]]:
    """Run jobs in processes of this machine; yield each when it has ended."""
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        running = {pool.submit(_run_printing, job): job for job in jobs}
        for ended in as_completed(running):
            try:
                yield running[ended], ended.result()
            except BrokenProcessPool as error:
                yield running[ended], f"its process was killed: {error}"


def _run_printing(job: Job) -> str | None:
    return _run_telling(job, partial(print, flush=True))


def _run_telling(job: Job, tell: Tell) -> str | None:
    """Run a job; put its name and its process before each of its lines."""
    process = os.getpid()

    def tell_of_job(text: str) -> None:
        for line in text.splitlines():
            tell(f"{job.name}, process {process}: {line.strip()}")

    begun_s = monotonic()
    problem = job.run(tell_of_job)
    tell_of_job(f"ended after {monotonic() - begun_s:.2f} s")
    return problem


class _Lines:
    """An actor of Ray that holds the lines of all workers until they are taken."""

    def __init__(self) -> None:
        self._lines: list[str] = []
        self._begun: Counter[str] = Counter()

    def begin(self, name: str) -> int:
        """Count that a job begins, and return how often it did: Ray itself does not count the
        tasks that its memory monitor kills."""
        self._begun[name] += 1
        return self._begun[name]

    def add(self, line: str) -> None:
        self._lines.append(line)

    def have_arrived(self) -> bool:
        """Return once the caller's earlier calls were taken: Ray keeps their order."""
        return True

    def take(self) -> list[str]:
        taken, self._lines = self._lines, []
        return taken


def _on_ray(jobs: Sequence[Job], tell: Tell, address: str) -> Iterator[tuple[Job, str | None]]:
    """Run all jobs as tasks; yield each when it has ended, after its lines were told."""
    if not jobs:
        return
    with _connected(address) as ray:
        machines = [machine["Resources"] for machine in ray.nodes() if machine["Alive"]]
        tell(_reached(address, machines))
        lines = ray.remote(num_cpus=0)(_Lines).remote()
        run = ray.remote(max_retries=RETRIES)(_run_on_worker)
        running = {}
        for job in jobs:
            problem = _too_large(job, machines)
            if problem is not None:
                yield job, problem
                continue
            placed = run.options(num_cpus=job.cores, memory=job.memory_bytes, name=job.name)
            running[placed.remote(job, lines)] = job
        while running:
            ended, _ = ray.wait(list(running), timeout=POLL_S)
            for line in ray.get(lines.take.remote()):
                tell(line)
            for task in ended:
                yield running.pop(task), _outcome(ray, task)


def _reached(address: str, machines: Sequence[dict[str, float]]) -> str:
    cores, memory = (sum(each.get(name, 0) for each in machines) for name in ("CPU", "memory"))
    return (
        f"Ray at {address}: {cores:.0f} cores, {memory / 2**30:.1f} GiB on {len(machines)} machines"
    )


def _run_on_worker(job: Job, lines: Any) -> str | None:
    if _ray().get(lines.begin.remote(job.name)) > RETRIES + 1:
        return f"begun {RETRIES + 1} times, each time killed; give it more memory"
    # Waits for nothing while the job works: Ray lends the cores of a task that waits to others.
    problem = _run_telling(job, lambda line: lines.add.remote(line))
    _ray().get(lines.have_arrived.remote())
    return problem


def _outcome(ray: Any, task: Any) -> str | None:
    try:
        problem: str | None = ray.get(task)
    except ray.exceptions.RayError as error:
        return f"begun {RETRIES + 1} times at most, then given up: {error}"
    return problem


def _too_large(job: Job, machines: Sequence[dict[str, float]]) -> str | None:
    """Return why a job would wait for ever, or None if some machine is large enough for it."""
    for machine in machines:
        if job.cores <= machine.get("CPU", 0) and job.memory_bytes <= machine.get("memory", 0):
            return None
    cores = max(machine.get("CPU", 0) for machine in machines)
    memory = max(machine.get("memory", 0) for machine in machines)
    return (
        f"needs {job.cores} cores and {job.memory_bytes / 2**30:.1f} GiB on one machine, the "
        f"largest of this Ray have {cores:.0f} and {memory / 2**30:.1f} GiB; take fewer --threads "
        "or less memory"
    )


def _ray() -> Any:
    with needs("ray"):
        return import_module("ray")


def _check_reachable(address: str) -> None:
    """Raise ``RfedgeError`` where nobody listens: Ray itself would go on trying for minutes.

    ``local`` and ``auto`` name no machine.
    """
    if ":" not in address:
        return
    place = Address.parse("ray", address.removeprefix("ray://"))
    try:
        socket.create_connection((place.host, place.port), REACHED_WITHIN_S).close()
    except OSError as error:
        raise RfedgeError(
            f"no Ray at {address}: {error.strerror or error}; give the HOST:PORT that `ray start "
            f"--head` says, or {LOCAL}"
        ) from error


@contextmanager
def _connected(address: str) -> Iterator[Any]:
    """Connect to a Ray, or start one here; raise ``RfedgeError`` if there is none."""
    _check_reachable(address)
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    ray = _ray()
    settings: dict[str, Any] = {"address": address}
    if address == LOCAL:
        settings |= {
            "num_cpus": len(os.sched_getaffinity(0)),
            "object_store_memory": OBJECT_STORE_BYTES,
            "include_dashboard": False,
        }
    try:
        ray.init(**settings, log_to_driver=False, logging_level="ERROR")
    except (ConnectionError, ValueError, RuntimeError, ray.exceptions.RayError) as error:
        raise RfedgeError(f"no Ray at {address}: {error}") from error
    try:
        yield ray
    finally:
        ray.shutdown()


class _Telling(io.StringIO):
    """A text stream that passes each whole line to ``tell``."""

    def __init__(self, tell: Tell) -> None:
        super().__init__()
        self._tell, self._begun = tell, ""

    def write(self, text: str) -> int:
        *whole, self._begun = (self._begun + text).split("\n")
        for line in whole:
            self._tell(line)
        return len(text)


def console_of(tell: Tell) -> Console:
    """Return a console without colours that passes its lines to ``tell``."""
    return Console(file=_Telling(tell), width=LINE_COLUMNS, force_terminal=False, soft_wrap=True)
