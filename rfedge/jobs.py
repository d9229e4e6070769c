"""Lists of jobs that make files: one after another in this process, or at the same time on Ray.

A job is named, can be pickled, and depends on nothing but what it was made from, threads included:
its files have the same bytes wherever it runs. A job whose files are there, made from the same, is
skipped; the file ``FIRST_OUTPUT.job`` beside them says from what. (One that does not say what it is
made from is done each time, and looks itself for what is there.) What it writes is whole or not
there at all (``rfcore.files``), so a job whose process was killed is begun again, and goes on where
it left a checkpoint. One that fails does not stop the others.

On Ray all machines must have this version of rfedge and see the same folders at the same paths.
"""

from __future__ import annotations

import io
import os
import socket
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from time import monotonic
from typing import Any

from rich.console import Console

from rfcore.errors import InvalidInput, RfedgeError
from rfcore.extras import needs
from rfcore.files import write_whole
from rfcore.wire.address import Address

__all__ = ["Job", "Tell", "console_of", "run_jobs"]

Tell = Callable[[str], None]
"""Takes a line about how a job goes."""
LOCAL = "local"
RETRIES = 3
"""How often a job is begun again whose process was killed."""
POLL_S = 0.2
REACHED_WITHIN_S = 10.0
OBJECT_STORE_BYTES = 100 << 20
"""Of a Ray started here: jobs hand over files, not objects."""
LINE_COLUMNS = 200


@dataclass(frozen=True)
class Job:
    """Files to make, and the work that makes them."""

    name: str
    work: Callable[[Tell], None]
    """Makes the files; a function of a module, or a partial of one, since it is pickled."""
    outputs: tuple[Path, ...]
    made_from: str | None
    """All that the files' bytes depend on, in one line; None: it is done each time."""
    cores: int
    memory_bytes: int

    def __post_init__(self) -> None:
        if not self.outputs and self.made_from is not None:
            raise InvalidInput("outputs", f"job {self.name} makes no file")
        if self.cores < 1:
            raise InvalidInput("cores", f"{self.cores} of job {self.name} must be at least 1")

    @property
    def is_done(self) -> bool:
        """Whether the files are there, made from the same."""
        if self.made_from is None:
            return False
        if not all(path.exists() for path in (self._marker, *self.outputs)):
            return False
        return self._marker.read_text(encoding="utf-8") == self._mark

    @property
    def _marker(self) -> Path:
        return self.outputs[0].with_name(f"{self.outputs[0].name}.job")

    @property
    def _mark(self) -> str:
        return f"{self.made_from}\n"

    def run(self, tell: Tell) -> str | None:
        """Make the files; return None, or what went wrong."""
        try:
            if self.made_from is not None:
                self._marker.unlink(missing_ok=True)
            self.work(tell)
            missing = [str(path) for path in self.outputs if not path.exists()]
            if missing:
                return f"did not write {', '.join(missing)}"
            if self.made_from is not None:
                write_whole(self._marker, self._mark)
        except (RfedgeError, OSError) as error:
            return str(error)
        except Exception as error:
            tell(traceback.format_exc())
            return f"{type(error).__name__}: {error}"
        return None


def run_jobs(jobs: Sequence[Job], tell: Tell, ray_address: str | None = None) -> int:
    """Do the jobs that are not done yet; return how many were done before.

    Without ``ray_address`` here, one after another; with it on the Ray at that address, ``local``
    starting one with this machine's cores. Every line of every job goes to ``tell``, with the job's
    name and its process. Raises ``InvalidInput`` for two jobs of one name, ``RfedgeError`` at the
    end naming the jobs that failed and why, ``BackendUnavailable`` without Ray.
    """
    names = [job.name for job in jobs]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InvalidInput("jobs", f"more than one is named {', '.join(twice)}")
    waiting = [job for job in jobs if not job.is_done]
    for job in jobs:
        if job not in waiting:
            tell(f"{job.name}: done before")
    ended = _run_here(waiting, tell) if ray_address is None else _on_ray(waiting, tell, ray_address)
    failed = []
    for job, problem in ended:
        tell(f"{job.name}: {'done' if problem is None else f'failed: {problem}'}")
        if problem is not None:
            failed.append(f"{job.name}: {problem}")
    if failed:
        of = f"{len(failed)} of {len(jobs)} jobs failed"
        raise RfedgeError("\n  ".join([f"{of}; the same command does them again:", *failed]))
    return len(jobs) - len(waiting)


def _run_here(jobs: Sequence[Job], tell: Tell) -> Iterator[tuple[Job, str | None]]:
    for job in jobs:
        yield job, _run_telling(job, tell)


def _run_telling(job: Job, tell: Tell) -> str | None:
    """Run a job whose lines say whose they are."""
    process = os.getpid()

    def tell_of_job(text: str) -> None:
        for line in text.splitlines():
            tell(f"{job.name}, process {process}: {line.strip()}")

    begun_s = monotonic()
    problem = job.run(tell_of_job)
    tell_of_job(f"ended after {monotonic() - begun_s:.2f} s")
    return problem


class _Lines:
    """Holds the lines of all workers until they are taken: an actor of Ray."""

    def __init__(self) -> None:
        self._lines: list[str] = []

    def add(self, line: str) -> None:
        self._lines.append(line)

    def have_arrived(self) -> bool:
        """Be called last: the calls of one caller are taken in their order."""
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
    """Say why a job would wait for ever, or None where a machine is large enough for it."""
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
    """A text stream whose whole lines are told."""

    def __init__(self, tell: Tell) -> None:
        super().__init__()
        self._tell, self._begun = tell, ""

    def write(self, text: str) -> int:
        *whole, self._begun = (self._begun + text).split("\n")
        for line in whole:
            self._tell(line)
        return len(text)


def console_of(tell: Tell) -> Console:
    """Return a console without colours whose lines are told."""
    return Console(file=_Telling(tell), width=LINE_COLUMNS, force_terminal=False, soft_wrap=True)
