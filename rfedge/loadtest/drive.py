"""Runs the fleet of canned vehicles as a process, and watches everybody meanwhile."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from rfcore.errors import RfedgeError
from rfedge.loadtest.brought import Brought, VehicleReport
from rfedge.loadtest.fleet import CONNECT_S, DRAIN_S, SETTLE_S, FleetSpec
from rfedge.loadtest.plan import Load
from rfedge.loadtest.usage import Watcher

__all__ = ["drive_canned"]

START_S = 60.0
"""How long the fleet may take to start, and to write what it brought, on a busy machine."""

POLL_S = 0.02


def drive_canned(
    load: Load, addresses: Sequence[str], pids: Mapping[str, int], work: Path, folder: Path
) -> Brought:
    """Drive canned vehicles to ``addresses``; raise ``RfedgeError`` if the fleet fails."""
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
    return Brought(vehicles, result["lag_p99_ms"], usage, watcher.machine_busy, load.hz)


def _await_start(
    fleet: subprocess.Popen[bytes], started: Path, within_s: float, work: Path
) -> None:
    deadline_s = time.monotonic() + within_s
    while not started.exists():
        if fleet.poll() is not None or time.monotonic() > deadline_s:
            tail = (work / "fleet.log").read_text(errors="replace").splitlines()[-3:]
            raise RfedgeError("the fleet did not start: " + " / ".join(tail))
        time.sleep(POLL_S)
