"""Processes killed, stopped and replaced."""

import asyncio
import os
import signal
import time
from typing import Any

import pytest

from fault.conftest import FAULT_S
from live_server import port_opens
from rfcore.wire.messages import Ack, Nack


@pytest.mark.fault_core
async def test_kill_9_of_the_server(site: Any, case: Any, appears: Any) -> None:
    case.about("server killed", "kill -9, then started again on its port", "F1")
    first = await site.server()
    vehicle = await site.vehicle(first.address, "cav-1")
    killed_s = first.send(signal.SIGKILL)
    first.process.wait()
    opening = asyncio.create_task(port_opens(first.address))
    second = await site.server(listen=first.address)
    opened_s = await opening
    await appears(lambda: len(vehicle.acked(opened_s)) >= 6)
    case.at_most("stream back after the port opens", vehicle.acked_at_s(opened_s)[0] - opened_s, 1)
    case.recovers_exactly(vehicle, opened_s)
    (lost, *_) = vehicle.entries("stream lost")
    case.holds("vehicle's log says UNAVAILABLE", lost["problem"].startswith("UNAVAILABLE"))
    case.holds("one session at the new server", second.value("rfedge_server_sessions") == 1)
    stale = [x for x in vehicle.lines() if killed_s < x["capture_time_ns"] / 1e9 < opened_s - 1]
    case.holds("nothing from before is sent", all(x["result"] != "acked" for x in stale))
    case.finish()


async def test_kill_9_of_an_agent(site: Any, case: Any, appears: Any) -> None:
    case.about("vehicle killed", "kill -9", "F2")
    server = await site.server("--decoder", "child")
    bystander = await site.vehicle(server.address, "bystander")
    victim = await site.vehicle(server.address, "cav-1")
    await case.calm()
    assert len(server.decoders()) == 3, "two in use, one stands ready"
    killed_s = victim.send(signal.SIGKILL)
    while server.value("rfedge_server_sessions") != 1:
        await asyncio.sleep(0.01)
    case.at_most("its session is gone", time.time() - killed_s, 2)
    await appears(lambda: len(server.decoders()) == 2)
    case.at_most("its decoder is gone", time.time() - killed_s, 2)
    await asyncio.sleep(FAULT_S)
    case.over()
    case.holds("log says stream closed", len(server.entries("stream closed")) == 1)
    await case.spares(bystander)
    case.finish()


@pytest.mark.fault_core
async def test_kill_9_of_a_decoder(
    site: Any, case: Any, coded: Any, raw_vehicle: Any, appears: Any
) -> None:
    case.about("decoder process killed", "kill -9 of the process of one camera", "F17")
    server = await site.server("--decoder", "child")
    (of_bystander,) = server.decoders()
    bystander = await site.bystander(server.address)
    async with raw_vehicle(server.address) as vehicle:
        await appears(lambda: len(server.decoders()) == 2)
        (ready,) = set(server.decoders()) - {of_bystander}
        await vehicle.greet(coded.hello)
        assert isinstance(await vehicle.ask(coded.frames[0]), Ack)
        await case.calm()
        killed_s = time.time()
        os.kill(ready, signal.SIGKILL)
        answers = [await vehicle.ask(coded.frames[1]), await vehicle.ask(coded.frames[2])]
        case.at_most("next frame decoded", time.time() - killed_s, 0.5)
        refused, decoded = answers
        case.holds(
            "one Nack decoder_failed",
            isinstance(refused, Nack) and str(refused.reason) == "decoder_failed",
        )
        wanted = coded.frames[2].packet.reconstruction_digest
        case.holds(
            "frames after it byte-equal to a fault-free run",
            isinstance(decoded, Ack) and decoded.reconstruction_digest == wanted,
        )
        await asyncio.sleep(case.lasting(FAULT_S))
        case.over()
    (entry,) = server.entries("decoder lost")
    case.holds("log names the signal", "SIGKILL" in entry["problem"])
    lost = server.value("rfedge_server_decoders_lost_total", cause="signal")
    case.holds("metric counts it", lost == 1)
    await case.spares(bystander)
    case.finish()


async def test_an_agent_stopped_for_5_s(site: Any, case: Any, appears: Any) -> None:
    case.about("vehicle stopped for 5 s", "SIGSTOP, SIGCONT", "F3")
    server = await site.server()
    bystander = await site.vehicle(server.address, "bystander")
    victim = await site.vehicle(server.address, "cav-1")
    await case.calm()
    victim.send(signal.SIGSTOP)
    await asyncio.sleep(5.0)
    woken_s = victim.send(signal.SIGCONT)
    await appears(lambda: len(victim.acked_at_s(woken_s)) >= 10)
    case.over()
    case.at_most("frames again", victim.acked_at_s(woken_s)[1] - woken_s, 1)
    fresh = [x["latency_ms"] for x in victim.acked(woken_s)]
    case.at_most("age of what is captured afterwards", max(fresh) / 1e3, 1)
    exact = all(x["server_digest"] == x["reconstruction_digest"] for x in victim.acked(woken_s))
    case.holds("its pictures exact", exact)
    await case.spares(bystander)
    case.finish()


async def test_a_server_stopped_for_5_s(site: Any, case: Any, appears: Any) -> None:
    case.about("server stopped for 5 s", "SIGSTOP, SIGCONT", "F3")
    server = await site.server()
    vehicle = await site.vehicle(server.address, "cav-1")
    stopped_s = server.send(signal.SIGSTOP)
    await appears(lambda: vehicle.entries("stream lost"))
    case.at_most("vehicle notices", time.time() - stopped_s, 1.5)
    await asyncio.sleep(max(0.0, stopped_s + 5.0 - time.time()))
    woken_s = server.send(signal.SIGCONT)
    await appears(lambda: len(vehicle.acked(woken_s)) >= 6)
    case.at_most("frames again", vehicle.acked_at_s(woken_s)[0] - woken_s, 1)
    old = [x for x in vehicle.lines() if x["capture_time_ns"] / 1e9 < woken_s - 3.0]
    backlog = [x for x in old if x["result"] == "acked" and x["latency_ms"] > 1000]
    case.holds("no backlog is delivered late", backlog == [])
    case.recovers_exactly(vehicle, woken_s)
    case.finish()


async def test_a_rolling_restart(site: Any, case: Any, appears: Any) -> None:
    case.about("server replaced", "SIGTERM, then another process on its port", "F25")
    first = await site.server()
    vehicles = [await site.vehicle(first.address, f"cav-{i}") for i in range(2)]
    told_s = first.send(signal.SIGTERM)
    first.process.wait()
    drained_s = time.time() - told_s
    opening = asyncio.create_task(port_opens(first.address))
    await site.server(listen=first.address)
    opened_s = await opening
    for vehicle in vehicles:
        await appears(lambda v=vehicle: len(v.acked(opened_s)) >= 6)
    back_s = [v.acked_at_s(opened_s)[0] - opened_s for v in vehicles]
    case.at_most("drained", drained_s, 5)
    case.at_most("slower vehicle back after the port opens", max(back_s), 1)
    lost = [x for v in vehicles for x in v.lines() if x["result"] in ("lost", "nacked")]
    case.at_most("frames lost of two vehicles", len(lost), 5, "")
    case.holds("exit status 0", first.process.returncode == 0)
    for vehicle in vehicles:
        case.recovers_exactly(vehicle, opened_s)
    case.finish()
