"""Live vehicles: ``cav-agent`` processes that read, render, encode and send in real time.

A picture counts from its capture; an agent whose event loop is late captures late, which the canned
fleet would not.
"""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

from rfcore.errors import RfedgeError
from rfedge.loadtest.brought import Brought, VehicleReport
from rfedge.loadtest.plan import Load
from rfedge.loadtest.usage import Usage, Watcher

__all__ = ["drive_live", "vehicle_report"]

START_S = 60.0
STOP_S = 20.0
POLL_S = 0.1


def drive_live(
    load: Load,
    addresses: Sequence[str],
    pids: Mapping[str, int],
    work: Path,
    agent: Sequence[str],
) -> Brought:
    """Drive agents to ``addresses``; raise ``RfedgeError`` if one ends early."""
    reports = [work / f"agent{i}.jsonl" for i in range(load.vehicles)]
    for report in reports:
        report.unlink(missing_ok=True)
    with ExitStack() as running:
        agents = [
            _start(running, work, i, [*agent, *_of(load, i, address, reports[i])])
            for i, address in enumerate(addresses)
        ]
        _await_first_pictures(agents, reports, work)
        time.sleep(load.warm_up_s)
        since_ns = time.time_ns()
        names = {f"vehicle{i}": process.pid for i, process in enumerate(agents)}
        watcher = Watcher({**pids, **names})
        watcher.start()
        time.sleep(load.duration_s)
        usage = watcher.stop()
        until_ns = time.time_ns()
        for process in agents:
            process.terminate()
        for i, process in enumerate(agents):
            if process.wait(STOP_S) != 0:
                raise RfedgeError(f"vehicle {i} failed; see {work / f'agent{i}.log'}")
    vehicles = [vehicle_report(report, since_ns, until_ns) for report in reports]
    together = _together([usage[name] for name in names])
    kept = {name: usage[name] for name in pids}
    return Brought(vehicles, 0.0, {**kept, "vehicles": together}, watcher.machine_busy, load.hz)


def vehicle_report(report: Path, since_ns: int, until_ns: int) -> VehicleReport:
    """Return the pictures captured between two moments (Unix time) from an agent's report."""
    lines = [json.loads(line) for line in report.read_text().splitlines()]
    counted = [line for line in lines if since_ns <= line["capture_time_ns"] < until_ns]
    acked = [line["latency_ms"] for line in counted if line["result"] == "acked"]
    return VehicleReport(len(counted), acked)


def _of(load: Load, number: int, address: str, report: Path) -> Sequence[str]:
    return [
        *("--server", address, "--vehicle", f"live-{number}"),
        *("--rate", str(load.hz), "--report", str(report)),
    ]


def _start(
    running: ExitStack, work: Path, number: int, command: Sequence[str]
) -> subprocess.Popen[bytes]:
    with (work / f"agent{number}.log").open("wb") as log:
        process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
    running.callback(process.wait)
    running.callback(process.kill)
    return process


def _await_first_pictures(
    agents: Sequence[subprocess.Popen[bytes]], reports: Sequence[Path], work: Path
) -> None:
    deadline_s = time.monotonic() + START_S
    while not all(report.exists() and report.stat().st_size for report in reports):
        ended = [i for i, process in enumerate(agents) if process.poll() is not None]
        if ended or time.monotonic() > deadline_s:
            raise RfedgeError(f"vehicles {ended or 'that started too late'}: see {work}/agent*.log")
        time.sleep(POLL_S)


def _together(usages: Sequence[Usage]) -> Usage:
    """Return the vehicles as one: what they use, summed look by look."""
    looks = zip(*(usage.samples for usage in usages), strict=False)
    return Usage([sum(look[1:], look[0]) for look in looks])
