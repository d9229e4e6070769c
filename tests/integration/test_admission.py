"""A server that is full says so, to newcomers; who is in notices nothing."""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import replace
from typing import Any

import grpc
from structlog.testing import capture_logs

from live_server import counted
from mec_server.config import AdmissionLimits
from rfcore.wire.conventions import RETRY_AFTER
from rfcore.wire.messages import Hello, Welcome

FULL_WITH_ONE = AdmissionLimits(load=1e-6, lowest_hz=2.0, retry_s=0.1)


def asking(coded: Any, name: str, rate_hz: float) -> Hello:
    cameras = tuple(replace(camera, rate_hz=rate_hz) for camera in coded.hello.cameras)
    hello: Hello = replace(coded.hello, vehicle_id=name, cameras=cameras)
    return hello


async def test_beyond_capacity_vehicles_are_refused_and_the_first_keeps_its_service(
    serve: Callable[..., Any], raw_vehicle: Callable[..., Any], coded: Any
) -> None:
    async with (
        serve(admission=FULL_WITH_ONE) as server,
        raw_vehicle(server.address) as first,
        raw_vehicle(server.address) as second,
    ):
        welcome = await first.ask(asking(coded, "cav-1", 30.0))
        assert isinstance(welcome, Welcome)
        assert welcome.rate_hz == 2.0, "the lowest rate: there is nothing to give"
        with capture_logs() as logs:
            await second.say(asking(coded, "cav-2", 30.0))
            assert await second.end() is grpc.StatusCode.RESOURCE_EXHAUSTED
        assert "come again in 0.1 s" in await second.stream.details()
        assert (RETRY_AFTER, "100") in tuple(await second.stream.trailing_metadata())
        assert counted(server, "rfedge_server_limited_total", limit="capacity") == 1.0
        assert counted(server, "rfedge_server_reduced_vehicles") == 1.0
        (line,) = [line for line in logs if line["event"] == "vehicle refused"]
        assert (line["vehicle"], line["reason"]) == ("cav-2", "capacity")
        for sequence in range(3):
            assert await first.told(coded.frames[sequence]) == ("ack", sequence)


async def test_a_refused_vehicle_comes_again_when_it_was_told_to(
    serve: Callable[..., Any],
    raw_vehicle: Callable[..., Any],
    travel: Callable[..., Awaitable[Any]],
    coded: Any,
) -> None:
    async with serve(admission=FULL_WITH_ONE) as server:
        with capture_logs() as logs:
            async with raw_vehicle(server.address) as first:
                await first.greet(asking(coded, "cav-1", 30.0))
                travelling = asyncio.create_task(travel(server.address))
                while counted(server, "rfedge_server_limited_total", limit="capacity") < 2:
                    assert not travelling.done()
                    await asyncio.sleep(0.01)
                await first.farewell()
            counts = (await travelling).counts
    assert set(counts) == {"acked"}
    assert any("come again" in line.get("problem", "") for line in logs)
