"""The vehicle that an attack may not harm: ``python -m attack.bystander DRIVE ADDRESS CERTIFICATES
REPORT``.

Its packets are coded beforehand (DRIVE, a folder of ``rfedge.loadtest.prerecorded``), because a
vehicle renders and codes on a machine of its own: here it would compete with server and attacker.
REPORT has a JSON line for each picture, in the order in which they were due. A stream that ends is
opened again; what was under way is lost.
"""

from __future__ import annotations

import asyncio
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from attack.target import Target
from rfedge.loadtest.prerecorded import End, PrerecordedDrive, Schedule, Shot
from rfedge.loadtest.vehicle import PrerecordedVehicle

NAME = "bystander"
HZ = 10.0
CONNECT_S = AGAIN_S = 1.0
LOST_S = 5.0
"""After which a picture without an answer is lost."""
FOR_EVER_S = 3600.0
POLL_S = 0.02


def vehicle(drive: PrerecordedDrive, target: Target) -> PrerecordedVehicle:
    """Return one that is not connected yet, with a camera of ``HZ``."""
    camera = replace(drive.hello.cameras[0], rate_hz=HZ)
    hello = replace(drive.hello, cameras=(camera,))
    context = target.tls_context(f"vehicle-{NAME}")
    return PrerecordedVehicle(NAME, target.address, hello, drive, context)


def line(shot: Shot, now: float, reason: str) -> dict[str, Any]:
    """Return a picture's line of the report, under the names of the agent's report."""
    captured_ns = time.time_ns() + round((shot.due_s - now) * 1e9)
    latency_ms = None if shot.latency_s is None else 1e3 * shot.latency_s
    result = "lost" if shot.end is End.OPEN else str(shot.end)
    return {
        "capture_time_ns": captured_ns,
        "result": result,
        "latency_ms": latency_ms,
        "reason": "none" if shot.end is End.ACKED else reason,
    }


def ended(shots: list[Shot], begin: int, now: float, over: bool) -> Iterator[Shot]:
    """Yield the pictures from number ``begin`` on of which it is known how they ended."""
    for shot in shots[begin:]:
        waits = shot.end is End.OPEN and not over and now < shot.due_s + LOST_S
        if shot.due_s > now or waits:
            return
        yield shot


async def drive_once(drive: PrerecordedDrive, target: Target, report: Path) -> None:
    """Drive until the stream ends, and write down how every picture ended."""
    one, written = vehicle(drive, target), 0
    await one.connect(CONNECT_S)
    begin_s = time.monotonic()
    one.depart(Schedule(begin_s, begin_s + FOR_EVER_S, HZ), begin_s + FOR_EVER_S)
    over = False
    while not over:
        await asyncio.sleep(POLL_S)
        over, now = one.over.is_set(), time.monotonic()
        known = list(ended(one.replays[0].shots, written, now, over))
        written += len(known)
        with report.open("a") as file:
            file.writelines(json.dumps(line(x, now, one.failed)) + "\n" for x in known)
    print(one.refused or one.failed, flush=True)


async def main(drive: str, address: str, certificates: str, report: str) -> None:
    target = Target(address, "", certificates, "", "", "", 0)
    coded = PrerecordedDrive.read(Path(drive))
    while True:
        await drive_once(coded, target, Path(report))
        await asyncio.sleep(AGAIN_S)


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
