"""Run the vehicles of a load test, and measure what all its processes use.

Prerecorded vehicles are one process, the fleet. Live vehicles are ``cav-agent`` processes that
read, render, encode and send in real time. Their latency counts from the capture of a picture: an
agent whose event loop is late captures late, whereas the fleet counts from when a picture was due.

``measured`` turns the measurements of a run into the input of ``verdict``.

``Watcher`` counts a process with its children, such as the server's decoders. The CPU time of its
first thread is counted apart, because the event loop runs on it, and while it runs no other thread
of the process can run Python.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rfcore.errors import RfedgeError
from rfcore.extras import needs
from rfedge.loadtest.fleet import CONNECT_S, DRAIN_S, SETTLE_S, FleetSpec
from rfedge.loadtest.plan import SETTLING_S, Load, Measured, Resources, VehicleReport, Vehicles

with needs("loadtest"):
    import psutil


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

    def after(self, seconds: float) -> Usage:
        """Return the samples taken at least ``seconds`` after the first."""
        samples = self.samples
        return Usage([each for each in samples if each.at_s - samples[0].at_s >= seconds])

    @property
    def growth_mb(self) -> float | None:
        """Growth of memory over the whole time, from the means of its two halves; None of fewer
        than two samples."""
        rss_mb = [sample.rss_mb for sample in self.samples]
        half = len(rss_mb) // 2
        if not half:
            return None
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


@dataclass(frozen=True)
class RunMeasurements:
    """Reports of the vehicles, and use of the processes over the measured part."""

    vehicles: Sequence[VehicleReport]
    generator_lag_ms: float
    """99th percentile of how late the fleet's event loop was."""
    usage: Mapping[str, Usage]
    machine_busy: float
    hz: float

    @property
    def others_cores(self) -> float:
        """Cores used by processes that are not part of the test."""
        ours = sum(usage.cores for usage in self.usage.values())
        return max(0.0, self.machine_busy * (psutil.cpu_count() or 1) - ours)

    def fields(self) -> dict[str, Any]:
        """Return the fields of ``LoadRow`` about vehicles and resources."""
        cores = {name: usage.cores for name, usage in self.usage.items()}
        return {
            "refused": sum(bool(vehicle.refused) for vehicle in self.vehicles),
            "failed": sum(bool(vehicle.failed) for vehicle in self.vehicles),
            "reduced": sum(0 < vehicle.granted_hz < self.hz for vehicle in self.vehicles),
            "nacked": sum(vehicle.nacked for vehicle in self.vehicles),
            "server_cores": cores["server"],
            "server_loop_cores": self.usage["server"].loop_cores,
            "vehicles_cores": cores.get("vehicles", 0.0),
            "links_cores": cores.get("links", 0.0),
            "others_cores": self.others_cores,
            "generator_lag_ms": self.generator_lag_ms,
        }


def measured(load: Load, run: RunMeasurements, link_busy: float, workers: int) -> Measured:
    """Return the measurements to judge: of the admitted vehicles, and how busy everything was."""
    admitted = [vehicle for vehicle in run.vehicles if not vehicle.refused]
    server = run.usage["server"]
    prerecorded = load.kind is Vehicles.PRERECORDED
    generators = ["vehicles", "links"] if prerecorded else ["links"]
    generator = max((run.usage[n].loop_cores for n in generators if n in run.usage), default=0)
    resources = Resources(
        server_loop=server.loop_cores,
        workers=(server.cores - server.loop_cores) / min(workers, psutil.cpu_count() or 1),
        link=link_busy,
        generator=generator,
        machine=run.machine_busy,
        test=run.machine_busy - run.others_cores / (psutil.cpu_count() or 1),
        others=run.others_cores,
        generator_lag_ms=run.generator_lag_ms,
    )
    wanted = len(admitted) if load.admission else load.vehicles
    settled = server.after(max(0.0, SETTLING_S - load.warm_up_s))
    return Measured(
        admitted, wanted, settled.growth_mb, settled.minutes, resources, 1e3 * link_busy / load.hz
    )


def links_busy(report: Path, load: Load) -> float:
    """Return the share of the time that the busiest vehicle's uplink transmitted."""
    links = [json.loads(line) for line in report.read_text().splitlines()]
    seconds = load.warm_up_s + load.duration_s
    return max(float(link["uplink"]["expected_s"]) for link in links) / seconds


START_S = 60.0
"""Time that the fleet may take to start, and to write its result, on a busy machine."""
POLL_S = 0.02


def drive_prerecorded(
    load: Load, addresses: Sequence[str], pids: Mapping[str, int], work: Path, folder: Path
) -> RunMeasurements:
    """Run prerecorded vehicles towards ``addresses``; raise ``RfedgeError`` if the fleet fails."""
    spec = FleetSpec(
        addresses=tuple(addresses),
        hz=load.hz,
        cameras=load.cameras,
        warm_up_s=load.warm_up_s,
        duration_s=load.duration_s,
        ready_s=load.vehicle_ms / 1e3,
        drive=str(folder),
    )
    spec_path, result_path = work / "fleet.spec.json", work / "fleet.json"
    started = result_path.with_suffix(".started")
    for path in (result_path, started):
        path.unlink(missing_ok=True)
    spec_path.write_text(json.dumps(asdict(spec)))
    command = [sys.executable, "-m", "rfedge.loadtest.fleet", str(spec_path), str(result_path)]
    with (work / "fleet.log").open("wb") as log:
        fleet = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
    try:
        _await_start(fleet, started, CONNECT_S + SETTLE_S + load.warm_up_s + START_S, work)
        watcher = Watcher({**pids, "vehicles": fleet.pid})
        watcher.start()
        time.sleep(load.duration_s)
        usage = watcher.stop()
        fleet.wait(DRAIN_S + START_S)
    except subprocess.TimeoutExpired:
        raise RfedgeError(f"the fleet does not end; see {work / 'fleet.log'}") from None
    finally:
        fleet.kill()
        fleet.wait()
    result = json.loads(result_path.read_text())
    vehicles = [VehicleReport(**vehicle) for vehicle in result["vehicles"]]
    return RunMeasurements(vehicles, result["lag_p99_ms"], usage, watcher.machine_busy, load.hz)


def _await_start(
    fleet: subprocess.Popen[bytes], started: Path, within_s: float, work: Path
) -> None:
    deadline_s = time.monotonic() + within_s
    while not started.exists():
        if fleet.poll() is not None or time.monotonic() > deadline_s:
            tail = (work / "fleet.log").read_text(errors="replace").splitlines()[-3:]
            raise RfedgeError("the fleet did not start: " + " / ".join(tail))
        time.sleep(POLL_S)


LIVE_START_S = 60.0
LIVE_STOP_S = 20.0
LIVE_POLL_S = 0.1


def drive_live(
    load: Load,
    addresses: Sequence[str],
    pids: Mapping[str, int],
    work: Path,
    agent: Sequence[str],
) -> RunMeasurements:
    """Run agents towards ``addresses``; raise ``RfedgeError`` if one ends early."""
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
            if process.wait(LIVE_STOP_S) != 0:
                raise RfedgeError(f"vehicle {i} failed; see {work / f'agent{i}.log'}")
    vehicles = [vehicle_report(report, since_ns, until_ns) for report in reports]
    together = _together([usage[name] for name in names])
    kept = {name: usage[name] for name in pids}
    return RunMeasurements(
        vehicles, 0.0, {**kept, "vehicles": together}, watcher.machine_busy, load.hz
    )


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
    deadline_s = time.monotonic() + LIVE_START_S
    while not all(report.exists() and report.stat().st_size for report in reports):
        ended = [i for i, process in enumerate(agents) if process.poll() is not None]
        if ended or time.monotonic() > deadline_s:
            raise RfedgeError(f"vehicles {ended or 'that started too late'}: see {work}/agent*.log")
        time.sleep(LIVE_POLL_S)


def _together(usages: Sequence[Usage]) -> Usage:
    """Return the use of several processes, summed sample by sample."""
    together = zip(*(usage.samples for usage in usages), strict=False)
    return Usage([sum(samples[1:], samples[0]) for samples in together])
