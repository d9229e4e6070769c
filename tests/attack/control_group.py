"""Limits on memory, processes and processors, as compose sets them, without docker (root)."""

from __future__ import annotations

import os
import time
from pathlib import Path

import yaml

GROUPS = Path("/sys/fs/cgroup")
SERVER = yaml.safe_load((Path(__file__).parents[2] / "docker-compose.yml").read_text())["x-rsu"]
"""A server of docker-compose.yml: its limits and its command."""
MEMORY_BYTES = int(SERVER["mem_limit"].removesuffix("g")) << 30
PIDS, CPUS = SERVER["pids_limit"], SERVER["cpus"]
CPU_PERIOD_US = 100_000
"""Within which a group may use ``CPUS`` of this long; Docker's own."""
AUTOGROUP_NICE = 10
AUTOGROUP = Path("/proc/self/autogroup")


def leave_the_processor() -> None:
    """Let this process, a session's leader, and what it starts have a processor while it is idle
    (SCHED_IDLE), also where the kernel shares it out by sessions (sched(7), "The autogroup
    feature")."""
    for thread in Path("/proc/self/task").iterdir():
        os.sched_setscheduler(int(thread.name), os.SCHED_IDLE, os.sched_param(0))
    if AUTOGROUP.exists():
        AUTOGROUP.write_text(str(AUTOGROUP_NICE))


class ControlGroup:
    """Limits on memory, processes and processors: of version 2 where that has them, else of 1."""

    def __init__(self, name: str, memory_bytes: int = MEMORY_BYTES, cpus: float = CPUS) -> None:
        two = GROUPS / "cgroup.controllers"
        self._is_2 = two.exists() and {"memory", "pids", "cpu"} <= set(two.read_text().split())
        kinds = ("",) if self._is_2 else ("memory", "pids", "cpu")
        self._folders = [GROUPS / kind / name for kind in kinds]
        for folder in self._folders:
            folder.mkdir()
        self.limit_memory(memory_bytes)
        of_pids = self._folders[0 if self._is_2 else 1]
        (of_pids / "pids.max").write_text(str(PIDS))
        self._limit_cpus(cpus)

    def _limit_cpus(self, cpus: float) -> None:
        quota_us = round(cpus * CPU_PERIOD_US)
        if self._is_2:
            (self._folders[0] / "cpu.max").write_text(f"{quota_us} {CPU_PERIOD_US}")
            return
        (self._folders[-1] / "cpu.cfs_period_us").write_text(str(CPU_PERIOD_US))
        (self._folders[-1] / "cpu.cfs_quota_us").write_text(str(quota_us))

    def limit_memory(self, limit_bytes: int) -> None:
        """Set how much memory its processes may have together."""
        name = "memory.max" if self._is_2 else "memory.limit_in_bytes"
        (self._folders[0] / name).write_text(str(limit_bytes))

    @property
    def within(self) -> tuple[str, ...]:
        """Return what runs a command in it."""
        put = "; ".join(f"echo $$ > {folder}/cgroup.procs" for folder in self._folders)
        return ("sh", "-c", f'{put}; exec "$@"', "sh")

    def enter(self) -> None:
        """Put this process into it; for ``preexec_fn``."""
        for folder in self._folders:
            (folder / "cgroup.procs").write_text(str(os.getpid()))

    def memory_bytes(self) -> int:
        """Return the memory of its processes now, without the kernel's cache of files."""
        name = "anon" if self._is_2 else "total_rss"
        stat = (self._folders[0] / "memory.stat").read_text().splitlines()
        return next(int(line.split()[1]) for line in stat if line.split()[0] == name)

    def kills(self) -> int:
        """Return how many of its processes the kernel has killed for memory."""
        file = self._folders[0] / ("memory.events" if self._is_2 else "memory.oom_control")
        pairs = (line.split() for line in file.read_text().splitlines())
        return next((int(count) for name, count in pairs if name == "oom_kill"), 0)

    def stopped_s(self) -> float:
        """Return for how long the kernel has stopped its processes on each processor, added up,
        because they had used up what they are granted of the period."""
        lines = (self._folders[-1] / "cpu.stat").read_text().splitlines()
        counts = {name: int(count) for name, count in (line.split() for line in lines)}
        return counts["throttled_usec"] / 1e6 if self._is_2 else counts["throttled_time"] / 1e9

    def close(self) -> None:
        """Remove it; its processes have ended."""
        for folder in self._folders:
            until_s = time.monotonic() + 10
            while True:
                try:
                    folder.rmdir()
                    break
                except OSError:
                    assert time.monotonic() < until_s, f"{folder} is not empty"
                    time.sleep(0.05)
