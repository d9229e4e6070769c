"""A peer that asks for too much is told in status, metric and answer; the others notice nothing."""

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack
from dataclasses import replace
from typing import Any

import grpc
import pytest
from structlog.testing import capture_logs

from live_server import counted, limited
from mec_server.config import AdmissionLimits, IdentityBudget, ServerBudget
from rfcore.wire.conventions import RETRY_AFTER
from rfcore.wire.messages import Hello, Nack, Welcome


def with_camera(hello: Hello, camera_id: str) -> Hello:
    return replace(hello, cameras=(replace(hello.cameras[0], camera_id=camera_id),))


async def test_a_stream_beyond_the_vehicles_own_is_refused_and_another_vehicles_is_not(
    coded: Any, serve: Any, raw_vehicle: Any
) -> None:
    two = IdentityBudget(streams=2)
    async with AsyncExitStack() as stack, serve(identity_budget=two) as server:
        for name in ("front", "rear"):
            vehicle = await stack.enter_async_context(raw_vehicle(server.address))
            await vehicle.greet(with_camera(coded.hello, name))
        third = await stack.enter_async_context(raw_vehicle(server.address))
        await third.say(with_camera(coded.hello, "left"))
        assert await third.end() is grpc.StatusCode.RESOURCE_EXHAUSTED
        assert "2 streams, asked for 1 more, 2 may be" in await third.stream.details()
        assert limited(server, "identity_streams") == 1
        other = await stack.enter_async_context(raw_vehicle(server.address))
        await other.greet(replace(coded.hello, vehicle_id="cav-other"))
        assert await vehicle.farewell() is grpc.StatusCode.OK
        again = await stack.enter_async_context(raw_vehicle(server.address))
        await again.greet(with_camera(coded.hello, "rear"))


async def test_a_stream_beyond_the_servers_is_refused_before_it_said_anything(
    coded: Any, serve: Any, raw_vehicle: Any
) -> None:
    one = ServerBudget(streams=1)
    async with serve(server_budget=one) as server, raw_vehicle(server.address) as vehicle:
        await vehicle.greet(coded.hello)
        async with raw_vehicle(server.address) as other:
            assert await other.end() is grpc.StatusCode.RESOURCE_EXHAUSTED
            assert "have 1 streams" in await other.stream.details()
        assert limited(server, "server_streams") == 1
        assert await vehicle.told(coded.frames[0]) == ("ack", 0)


async def test_frames_beyond_the_rate_are_answered_with_the_limit(
    coded: Any, serve: Any, raw_vehicle: Any
) -> None:
    budget = IdentityBudget(messages_per_s=2)
    async with serve(identity_budget=budget) as server, raw_vehicle(server.address) as vehicle:
        await vehicle.greet(coded.hello)
        answers = [await vehicle.ask(frame) for frame in coded.frames]
        refused = [a for a in answers if isinstance(a, Nack)]
        assert len(refused) >= 1, "six frames, two a second"
        assert {str(nack.reason) for nack in refused} == {"overloaded"}
        assert refused[0].problem.startswith(
            "identity_messages: more than 2 messages a second; come again in "
        )
        assert limited(server, "identity_messages") == len(refused)
        assert await vehicle.farewell() is grpc.StatusCode.OK


async def test_a_second_agent_for_a_camera_is_refused_with_the_reason_and_when_to_try_again(
    coded: Any, serve: Any, raw_vehicle: Any
) -> None:
    async with (
        serve() as server,
        raw_vehicle(server.address) as first,
        raw_vehicle(server.address) as second,
    ):
        await first.greet(coded.hello)
        await second.say(coded.hello)
        assert await second.end() is grpc.StatusCode.RESOURCE_EXHAUSTED
        details = await second.stream.details()
        assert details.startswith(
            "camera_taken: another agent sends camera front of vehicle cav-raw; stop it, or give "
            "this one another --vehicle or --camera"
        )
        assert (RETRY_AFTER, "3000") in tuple(await second.stream.trailing_metadata())
        assert limited(server, "camera_taken") == 1
        assert await first.told(coded.frames[0]) == ("ack", 0), "the first one notices nothing"


async def test_an_agent_that_fell_silent_is_replaced_by_another_and_told_why(
    coded: Any, serve: Any, raw_vehicle: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mec_server.ledger.entry.CAMERA_SILENT_S", 0.0)
    async with (
        serve() as server,
        raw_vehicle(server.address) as silent,
        raw_vehicle(server.address) as second,
    ):
        await silent.greet(coded.hello)
        await second.greet(coded.hello)
        assert await second.told(coded.frames[0]) == ("ack", 0)
        assert await silent.end() is grpc.StatusCode.RESOURCE_EXHAUSTED
        assert "another agent sends cav-raw/front now" in await silent.stream.details()
        assert limited(server, "camera_taken") == 1


async def test_a_second_hello_counts_with_its_own_cameras(
    coded: Any, serve: Any, raw_vehicle: Any
) -> None:
    """A Hello that could not be opened does not let the next one in under its name."""
    broken = replace(coded.hello.cameras[0], camera_id="rear")
    header = replace(broken.codec, sps=broken.codec.sps[:-2])
    bad = replace(coded.hello, cameras=(replace(broken, codec=header),))
    async with (
        serve() as server,
        raw_vehicle(server.address) as first,
        raw_vehicle(server.address) as second,
    ):
        await first.greet(coded.hello)
        answer = await second.ask(bad)
        assert isinstance(answer, Nack), answer
        await second.say(coded.hello)
        assert await second.end() is grpc.StatusCode.RESOURCE_EXHAUSTED
        assert "camera_taken" in await second.stream.details()


# --- a server that is full says so, to newcomers; who is in notices nothing


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
