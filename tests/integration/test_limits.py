"""Who asks for too much is told so, in status, metric and answer; the others notice nothing."""

from contextlib import AsyncExitStack
from dataclasses import replace
from typing import Any

import grpc

from mec_server.config import VehicleQuota
from rfcore.wire.messages import Nack


def limited(server: Any, limit: str) -> float:
    value = server.registry.get_sample_value("rfedge_server_limited_total", {"limit": limit})
    assert value is not None
    return float(value)


async def test_a_stream_beyond_the_vehicles_own_is_refused_and_another_vehicles_is_not(
    coded: Any, serve: Any, raw_vehicle: Any
) -> None:
    async with AsyncExitStack() as stack, serve(quota=VehicleQuota(streams=2)) as server:
        for _ in range(2):
            vehicle = await stack.enter_async_context(raw_vehicle(server.address))
            await vehicle.greet(coded.hello)
        third = await stack.enter_async_context(raw_vehicle(server.address))
        await third.say(coded.hello)
        assert await third.end() is grpc.StatusCode.RESOURCE_EXHAUSTED
        assert "2 streams open, 2 may be" in await third.stream.details()
        assert limited(server, "vehicle_streams") == 1
        other = await stack.enter_async_context(raw_vehicle(server.address))
        await other.greet(replace(coded.hello, vehicle_id="cav-other"))
        assert await vehicle.farewell() is grpc.StatusCode.OK
        again = await stack.enter_async_context(raw_vehicle(server.address))
        await again.greet(coded.hello)


async def test_a_stream_beyond_the_servers_is_refused_before_it_said_anything(
    coded: Any, serve: Any, raw_vehicle: Any
) -> None:
    async with serve(max_streams=1) as server, raw_vehicle(server.address) as vehicle:
        await vehicle.greet(coded.hello)
        async with raw_vehicle(server.address) as other:
            assert await other.end() is grpc.StatusCode.RESOURCE_EXHAUSTED
            assert "1 streams are open" in await other.stream.details()
        assert limited(server, "server_streams") == 1
        assert await vehicle.told(coded.frames[0]) == ("ack", 0)


async def test_frames_beyond_the_rate_are_answered_with_the_limit(
    coded: Any, serve: Any, raw_vehicle: Any
) -> None:
    quota = VehicleQuota(frames_per_s=2)
    async with serve(quota=quota) as server, raw_vehicle(server.address) as vehicle:
        await vehicle.greet(coded.hello)
        answers = [await vehicle.ask(frame) for frame in coded.frames]
        refused = [a for a in answers if isinstance(a, Nack)]
        assert len(refused) >= 1, "six frames, two a second"
        assert {str(nack.reason) for nack in refused} == {"overloaded"}
        assert refused[0].problem == "frame_rate: more than 2 frames a second"
        assert limited(server, "frame_rate") == len(refused)
        assert await vehicle.farewell() is grpc.StatusCode.OK


async def test_a_stream_of_nothing_but_rubbish_is_ended(
    coded: Any, serve: Any, raw_vehicle: Any
) -> None:
    async with serve() as server, raw_vehicle(server.address) as vehicle:
        await vehicle.greet(coded.hello)
        for _ in range(64):
            assert (await vehicle.told(b"\xff rubbish"))[0] == "invalid_argument"
        assert await vehicle.end() is grpc.StatusCode.RESOURCE_EXHAUSTED
        assert "64 messages in a row" in await vehicle.stream.details()
        assert limited(server, "unusable_frames") == 1
