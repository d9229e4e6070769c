"""Peers and decoders that misbehave, memory that runs out, options that are mistaken."""

import asyncio
import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import grpc
import pytest

from attack.attacker import ATTACKS
from attack.conftest import ENVIRONMENT
from attack.control_group import ControlGroup
from attack.target import Target
from fault.conftest import FAULT_S
from fault.test_packets import nacked, paced
from live_server import tls_options
from mec_server.config import IdentityBudget
from mec_server.ledger.budgets import Resource
from mec_server.ledger.ledger import LONGER_BURST_S
from rfcore.wire.messages import Ack
from rfedge.certs import Members, certify, write_certificates

ROOM_BYTES = 24 << 20
BURST_OF_REJECTED_S = LONGER_BURST_S[Resource.REJECTED_SECONDS]


async def test_renders_that_differ(streaming: Any, case: Any, coded: Any, raw_vehicle: Any) -> None:
    server, bystander = streaming
    case.about("render mismatch", "another render's digest in each other frame", "F13")
    told: Counter[str] = Counter()
    async with raw_vehicle(server.address) as vehicle:
        await vehicle.greet(coded.hello)
        await case.calm()
        async for frame in paced(coded.frames):
            packet = replace(frame.packet, render_digest=bytes(2))
            told["wrong", (await vehicle.told(replace(frame, packet=packet)))[0]] += 1
            told["right", (await vehicle.told(frame))[0]] += 1
        case.over()
    wanted = {("wrong", "render_mismatch"), ("right", "ack")}
    case.holds("refused as render_mismatch, the next frame taken", set(told) == wanted)
    counted = nacked(server, "render_mismatch") == told["wrong", "render_mismatch"]
    case.holds("metric counts them", counted)
    await case.spares(bystander)
    case.finish()


@pytest.mark.fault_core
async def test_renders_for_nothing(site: Any, case: Any, coded: Any, raw_vehicle: Any) -> None:
    case.about(
        "renders for nothing",
        "50 Hz of frames with another render's digest: each costs a render before it is refused",
        "F13 F23",
    )
    server = await site.server()
    bystander = await site.bystander(server.address)
    told: Counter[str] = Counter()
    ended = False
    async with raw_vehicle(server.address) as vehicle:
        await vehicle.greet(coded.hello)
        await case.calm()
        spent_s = -rejected_s(server)
        began_s = time.monotonic()
        async for frame in paced(coded.frames, case.lasting(FAULT_S)):
            packet = replace(frame.packet, render_digest=bytes(2))
            try:
                told[(await vehicle.told(replace(frame, packet=packet)))[0]] += 1
            except (grpc.aio.AioRpcError, asyncio.InvalidStateError):
                ended = await vehicle.stream.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
                break
        await asyncio.sleep(max(0.0, began_s + case.lasting(FAULT_S) - time.monotonic()))
        lasted_s = time.monotonic() - began_s
        spent_s += rejected_s(server)
        case.over()
    renders = told["render_mismatch"]
    case.tells("answers", ", ".join(f"{reason} {n}" for reason, n in sorted(told.items())))
    case.tells("its stream ended for them", "yes" if ended else "no")
    case.holds("some rendered, none shown", renders > 0 and told["ack"] == 0)
    # A budget is known to be spent when the frame that overdrew it has been paid.
    budget_s = IdentityBudget().rejected_workers * (lasted_s + BURST_OF_REJECTED_S)
    beyond_one_s = spent_s * (1 - 1 / max(1, renders))
    case.at_most("worker time for them, but for one frame", beyond_one_s, budget_s)
    await case.spares(bystander)
    case.finish()


def rejected_s(server: Any) -> float:
    return float(server.value("rfedge_server_spent_total", resource="rejected_seconds"))


async def test_a_decoder_that_hangs(
    site: Any, case: Any, coded: Any, raw_vehicle: Any, appears: Any
) -> None:
    case.about("decoder process hangs", "SIGSTOP of the process of one camera", "F17")
    server = await site.server("--decoder", "child")
    (of_bystander,) = server.decoders()
    bystander = await site.vehicle(server.address, "bystander")
    async with raw_vehicle(server.address) as vehicle:
        await appears(lambda: len(server.decoders()) == 2)
        (ready,) = set(server.decoders()) - {of_bystander}
        await vehicle.greet(coded.hello)
        assert isinstance(await vehicle.ask(coded.frames[0]), Ack)
        await case.calm()
        os.kill(ready, signal.SIGSTOP)
        stopped_s = time.time()
        refused = (await vehicle.told(coded.frames[1]))[0]
        decoded = await vehicle.ask(coded.frames[2])
        case.at_most("next frame decoded", time.time() - stopped_s, 3)
        case.holds("one Nack decoder_failed", refused == "decoder_failed")
        wanted = coded.frames[2].packet.reconstruction_digest
        exact = isinstance(decoded, Ack) and decoded.reconstruction_digest == wanted
        case.holds("frames after it byte-equal to a fault-free run", exact)
        await asyncio.sleep(1.0)  # long enough for the bystander to send some pictures
        case.over()
    case.holds("log tells of it", len(server.entries("decoder lost")) == 1)
    await case.spares(bystander)
    case.finish()


@pytest.mark.usefixtures("as_root")
async def test_memory_that_runs_out(
    site: Any, case: Any, coded: Any, raw_vehicle: Any, appears: Any
) -> None:
    case.about(
        "out of memory",
        f"a control group with {ROOM_BYTES >> 20} MiB left, 16 cameras and decoders allowed",
        "F21",
    )
    options = ("--decoder", "child", "--max-decoders", "64")
    group = ControlGroup(f"rfedge-fault-{os.getpid()}")
    cameras = tuple(replace(coded.hello.cameras[0], camera_id=f"c{i}") for i in range(16))
    try:
        server = await site.server(*options, within=group.within)
        bystander = await site.vehicle(server.address, "bystander")
        group.limit_memory(group.memory_bytes() + ROOM_BYTES)
        async with raw_vehicle(server.address) as vehicle:
            await vehicle.say(replace(coded.hello, cameras=cameras))
            await appears(lambda: group.kills() > 0)
            killed_s = time.time()
        await asyncio.sleep(0.2)
        died = server.process.poll() is not None
        if died:  # as compose does with `restart: unless-stopped`
            await site.server(*options, listen=server.address, within=group.within)
        await appears(lambda: bystander.acked(killed_s + 0.2))
        served_s = bystander.acked_at_s(killed_s + 0.2)[0]
        case.at_most("bystander served again", served_s - killed_s, 5)
        killed = "the server, started again" if died else "a decoder"
        case.tells("what the kernel killed", killed)
        case.recovers_exactly(bystander, killed_s + 0.2)
    finally:
        site.close()
        group.close()
    case.finish()


@asynccontextmanager
async def attacking(name: str, target: Target, folder: Path) -> AsyncIterator[None]:
    """Attack while the body runs; see ``tests/attack``."""
    command = ["nice", "-n", "10", sys.executable, "-m", "attack.attacker"]
    with (folder / "attacker.log").open("wb") as log:
        attacker = subprocess.Popen(
            [*command, name, "60", json.dumps(asdict(target))],
            stdout=log,
            stderr=log,
            env=ENVIRONMENT,
        )
    try:
        yield
        assert attacker.poll() is None, (folder / "attacker.log").read_text()
    finally:
        attacker.kill()
        attacker.wait()


@pytest.mark.parametrize(
    ("attack", "covers"),
    [
        ("strangers", "F22"),
        ("resets", "F22"),
        ("pings", "F22"),
        ("foreign_names", "F23"),
        ("many_streams", "F23"),
        ("half_requests", "F26"),
    ],
)
async def test_an_abusive_peer(
    attack: str, covers: str, site: Any, street: Any, case: Any, tmp_path: Path
) -> None:
    chosen = ATTACKS[attack]
    about = f"{chosen.work.__doc__} Certificate: {chosen.identity}."
    case.about(attack.replace("_", " "), about, covers)
    root = tmp_path / "certs"
    members = Members(("attacker", "bystander"), ("attacker",))
    write_certificates(root, certify(members, datetime.now(UTC), days=2))

    server = await site.server(*tls_options(root, "server"))
    own = tls_options(root, "vehicle-bystander")
    bystander = await site.vehicle(server.address, "bystander", *own)
    metrics = f"127.0.0.1:{server.entries('metrics')[-1]['port']}"
    fields = str(street.store)
    target = Target(
        *(server.address, metrics, str(root), street.field_id, fields, "", server.process.pid)
    )
    await case.calm()
    before_bytes = server.rss_bytes()
    async with attacking(attack, target, tmp_path):
        await asyncio.sleep(2 * FAULT_S)
        case.over()
    grown_mb = (server.rss_bytes("VmHWM") - before_bytes) / 1e6
    case.at_most("server's memory grows by", grown_mb, 64, "MB")
    case.holds("server lives", server.process.poll() is None)
    await case.spares(bystander)
    case.finish()


MISTAKES = (
    ("mec_server", ("--max-stream", "4"), "max-stream"),
    ("mec_server", ("--workers", "0"), "workers"),
    ("mec_server", ("--decoder", "sandbox"), "decoder"),
    ("cav_agent", ("--rate", "-1"), "rate"),
    ("cav_agent", ("--effort", "ultrafast"), "effort"),
    ("cav_agent", ("--coder", "x265"), "coder"),
)


async def test_mistaken_options(street: Any, case: Any) -> None:
    case.about("mistaken options", f"{len(MISTAKES)} command lines, one wrong option each", "F28")
    needed = {
        "mec_server": ("--fields", street.store, "--listen", "127.0.0.1:0"),
        "cav_agent": ("--server", "127.0.0.1:1", "--drive", street.drive, "--fields", street.store),
    }
    for module, wrong, named in MISTAKES:
        words = [sys.executable, "-m", module, *map(str, needed[module]), *wrong]
        began_s = time.monotonic()
        done = subprocess.run(words, capture_output=True, timeout=60)
        told = (done.stdout + done.stderr).decode()
        what = " ".join(wrong)
        case.holds(f"{what}: exit 2, named", done.returncode == 2 and named in told)
        case.holds(f"{what}: no traceback", "Traceback" not in told)
        case.at_most(f"{what}: told within", time.monotonic() - began_s, 20)
    case.finish()
