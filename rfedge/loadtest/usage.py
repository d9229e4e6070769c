"""Measure the CPU time, memory, descriptors and threads of processes during a load test.

A process is counted with its children, such as the server's decoders. The CPU time of its first
thread is counted apart, because the event loop runs on it, and while it runs no other thread of the
process can run Python.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

from rfcore.extras import needs

with needs("loadtest"):
    import psutil

__all__ = ["Sample", "Usage", "Watcher"]

EVERY_S = 0.5


@dataclass(frozen=True)
class Sample:
    """One process with its children at one moment; CPU time in seconds since its start."""

    at_s: float
    cpu_s: float
    loop_cpu_s: float
    rss_mb: float
    descriptors: int
    threads: int
    children: int

    def __add__(self, other: Sample) -> Sample:
        """Return the sum of two processes, at the first one's moment."""
        return Sample(
            self.at_s,
            self.cpu_s + other.cpu_s,
            self.loop_cpu_s + other.loop_cpu_s,
            self.rss_mb + other.rss_mb,
            self.descriptors + other.descriptors,
            self.threads + other.threads,
            self.children + other.children,
        )


@dataclass(frozen=True)
class Usage:
    """The samples of one process during the counted part."""

    samples: Sequence[Sample]

    @property
    def cores(self) -> float:
        """CPU seconds per second, with children."""
        return self._rate([sample.cpu_s for sample in self.samples])

    @property
    def loop_cores(self) -> float:
        """CPU seconds per second of the first thread."""
        return self._rate([sample.loop_cpu_s for sample in self.samples])

    @property
    def growth_mb(self) -> float:
        """Growth of memory over the whole time, from the means of its two halves."""
        rss_mb = [sample.rss_mb for sample in self.samples]
        half = len(rss_mb) // 2
        if not half:
            return 0.0
        return 2 * (sum(rss_mb[-half:]) - sum(rss_mb[:half])) / half

    @property
    def minutes(self) -> float:
        """Minutes from the first sample to the last."""
        return (self.samples[-1].at_s - self.samples[0].at_s) / 60 if self.samples else 0.0

    def _rate(self, values: Sequence[float]) -> float:
        seconds = 60 * self.minutes
        return (values[-1] - values[0]) / seconds if seconds else 0.0


class Watcher:
    """Samples the processes ``pids`` every half second, on a thread, from ``start`` to ``stop``."""

    def __init__(self, pids: Mapping[str, int]) -> None:
        self._processes = {name: psutil.Process(pid) for name, pid in pids.items()}
        self._samples: dict[str, list[Sample]] = {name: [] for name in pids}
        self._machine: tuple[float, float] = (0.0, 0.0)
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="watcher", daemon=True)

    def start(self) -> None:
        """Begin to sample."""
        self._machine_at_start = _machine_seconds()
        self._thread.start()

    def stop(self) -> Mapping[str, Usage]:
        """Stop, and return the samples of each process."""
        self._stopped.set()
        self._thread.join()
        self._machine_at_end = _machine_seconds()
        return {name: Usage(tuple(samples)) for name, samples in self._samples.items()}

    @property
    def machine_busy(self) -> float:
        """Share of the machine's CPU time that all processes used from start to stop."""
        busy_s, all_s = (
            end - start
            for start, end in zip(self._machine_at_start, self._machine_at_end, strict=True)
        )
        return busy_s / all_s if all_s else 0.0

    def _run(self) -> None:
        while True:
            for name, process in self._processes.items():
                with suppress(psutil.Error):  # it has ended; its samples so far count
                    self._samples[name].append(sample(process))
            if self._stopped.wait(EVERY_S):
                return


def sample(process: psutil.Process) -> Sample:
    """Return what a process uses now; raise ``psutil.Error`` if it is gone."""
    family = [process, *process.children(recursive=True)]
    loop = next(thread for thread in process.threads() if thread.id == process.pid)
    cpu_s, rss_mb, descriptors, threads = 0.0, 0.0, 0, 0
    for member in family:
        with suppress(psutil.NoSuchProcess):
            times = member.cpu_times()
            cpu_s += times.user + times.system
            rss_mb += member.memory_info().rss / 1e6
            descriptors += member.num_fds()
            threads += member.num_threads()
    return Sample(
        at_s=time.monotonic(),
        cpu_s=cpu_s,
        loop_cpu_s=loop.user_time + loop.system_time,
        rss_mb=rss_mb,
        descriptors=descriptors,
        threads=threads,
        children=len(family) - 1,
    )


def _machine_seconds() -> tuple[float, float]:
    """Return the busy time and the whole time of all cores since boot, s."""
    times = psutil.cpu_times()
    idle_s = times.idle + times.iowait
    whole_s = sum(times) - times.guest - times.guest_nice
    return whole_s - idle_s, whole_s
