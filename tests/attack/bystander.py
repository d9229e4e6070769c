"""Those whom an attack may not harm: ``python -m attack.bystander ROLE ADDRESS CERTIFICATES REPORT
[DRIVE]``.

* ``vehicle``: it was there before. A stream that ends is opened again; what was under way is lost.
  Where CERTIFICATES is empty, it has none.
* ``consumer``: it watches that vehicle, in JPEG.
* ``newcomer``: a vehicle that comes for one picture, again and again, from an address of its own.

Packets are coded beforehand (DRIVE, a folder of ``rfedge.loadtest.prerecorded``), because a vehicle
renders and codes on a machine of its own: here it would compete with server and attacker. REPORT
has a JSON line for each picture that was due, came, or was the newcomer's first.
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

import grpc

from attack.target import Target
from rfcore.wire.twin import (
    PictureEncoding,
    Subscription,
    TwinPicture,
    subscription_to_wire,
    twin_message_from_wire,
)
from rfcore.wire.v1 import twin_pb2_grpc
from rfedge.loadtest.fleet import PrerecordedVehicle, wall_ns
from rfedge.loadtest.prerecorded import End, PrerecordedDrive, Schedule, Shot

NAME, NEWCOMER = "bystander", "newcomer"
HZ = 10.0
CONNECT_S = AGAIN_S = 1.0
LOST_S = 5.0
"""After which a picture without an answer is lost."""
FOR_EVER_S = 3600.0
POLL_S = 0.02
NEWCOMER_SOURCE = "127.0.0.2"
"""Addresses are barred and counted, and the attacker's is not a newcomer's."""
GIVE_UP_S = 10.0
"""After which a newcomer leaves without having been shown."""
BETWEEN_S = 0.25
"""Between one newcomer and the next."""


def vehicle(drive: PrerecordedDrive, target: Target, name: str = NAME) -> PrerecordedVehicle:
    """Return one that is not connected yet, with a camera of ``HZ``."""
    camera = replace(drive.hello.cameras[0], rate_hz=HZ)
    hello = replace(drive.hello, cameras=(camera,))
    context = target.tls_context(f"vehicle-{name}") if target.certificates else None
    return PrerecordedVehicle(name, target.address, hello, drive, context)


def write(report: Path, *lines: dict[str, Any]) -> None:
    with report.open("a") as file:
        file.writelines(json.dumps(line) + "\n" for line in lines)


def line(shot: Shot, reason: str) -> dict[str, Any]:
    """Return a picture's line of the report, under the names of the agent's report."""
    latency_ms = None if shot.latency_s is None else 1e3 * shot.latency_s
    result = "lost" if shot.end is End.OPEN else str(shot.end)
    return {
        "capture_time_ns": wall_ns(shot.due_s) // 1000 * 1000,  # as frames have it
        "result": result,
        "latency_ms": latency_ms,
        "exact": shot.is_exact,
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
        write(report, *(line(shot, one.failed) for shot in known))
    print(one.refused or one.failed, flush=True)


async def watch_once(target: Target, report: Path) -> None:
    """Watch the vehicle until the stream ends, and write down when each picture was there."""
    subscription = Subscription(frozenset((NAME,)), PictureEncoding.JPEG)
    try:
        async with target.channel(f"consumer-{NAME}") as channel:
            stub = twin_pb2_grpc.TwinServiceStub(channel)
            async for response in stub.Watch(subscription_to_wire(subscription)):
                seen, now_ns = twin_message_from_wire(response), time.time_ns()
                if isinstance(seen, TwinPicture):
                    age_ms = (now_ns - seen.capture_time_ns) / 1e6
                    write(report, {"capture_time_ns": seen.capture_time_ns, "age_ms": age_ms})
    except grpc.aio.AioRpcError as error:
        print(error.code().name, error.details(), flush=True)


async def arrive_once(drive: PrerecordedDrive, target: Target, report: Path) -> None:
    """Connect, have one picture shown, leave, and write down how long it took.

    From the first packet of the connection to the Ack, the server's word that the picture is shown;
    None if it never was.
    """
    one, began_ns, begin_s = vehicle(drive, target, NEWCOMER), time.time_ns(), time.monotonic()
    await one.connect(GIVE_UP_S, NEWCOMER_SOURCE)
    met_s = time.monotonic()
    one.depart(Schedule(met_s, met_s + 0.5 / HZ, HZ), begin_s + GIVE_UP_S)
    await one.over.wait()
    one.leave()
    acked_s = [s.ended_s for s in one.replays[0].shots if s.end is End.ACKED]
    shown_s = acked_s[0] - begin_s if acked_s and acked_s[0] is not None else None
    problem = "" if shown_s is not None else one.refused or one.failed or "no Ack"
    write(report, {"began_ns": began_ns, "shown_s": shown_s, "problem": problem})


async def main(role: str, address: str, certificates: str, report: str, drive: str = "") -> None:
    target = Target(address, "", certificates, "", "", "", 0)
    coded = PrerecordedDrive.read(Path(drive)) if drive else None
    while True:
        match role, coded:
            case "vehicle", PrerecordedDrive():
                await drive_once(coded, target, Path(report))
                await asyncio.sleep(AGAIN_S)
            case "newcomer", PrerecordedDrive():
                await arrive_once(coded, target, Path(report))
                await asyncio.sleep(BETWEEN_S)
            case "consumer", None:
                await watch_once(target, Path(report))
                await asyncio.sleep(AGAIN_S)
            case _:
                raise SystemExit(__doc__)


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
