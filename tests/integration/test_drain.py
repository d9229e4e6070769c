"""A server that is told to stop lets its vehicles move first: two servers, one vehicle."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import grpc
from grpc_health.v1 import health_pb2, health_pb2_grpc

from cav_agent.config import AgentLimits
from rfcore.wire.messages import Ack, DrainNotice
from rfcore.wire.tile_manifest import Ground, publish
from rfcore.wire.tiles import Area

PATIENT = AgentLimits(answer_s=60.0, stall_s=60.0)
"""A busy machine is not a server that is lost."""

EVERYWHERE = Ground(Area((-5.0, -5.0), (5.0, 5.0)), 0.0)


@asynccontextmanager
async def two_servers(street: Any, serve: Any, folder: Path) -> AsyncIterator[Any]:
    """Run two servers of the same tile; the first can be told to stop (``drained``)."""
    store = folder / "published"
    store.mkdir()
    now = datetime(2026, 1, 1, tzinfo=UTC)
    publish(store, "street", street.store / "street.rff", EVERYWHERE, now)
    async with AsyncExitStack() as first, serve(fields=store) as b:
        a = await first.enter_async_context(serve(fields=store, drain_hold_s=0.2, drain_s=60.0))
        yield a, b, first.aclose


async def health(address: object) -> health_pb2.HealthCheckResponse.ServingStatus:
    async with grpc.aio.insecure_channel(str(address)) as channel:
        stub = health_pb2_grpc.HealthStub(channel)
        return (await stub.Check(health_pb2.HealthCheckRequest())).status


async def test_a_server_that_drains_hands_its_vehicle_over_without_a_lost_frame_or_a_keyframe(
    street: Any, serve: Any, vehicle: Any, tmp_path: Path
) -> None:
    async with (
        two_servers(street, serve, tmp_path) as (a, b, drained),
        vehicle(
            a.address,
            neighbours=(str(b.address),),
            fields=tmp_path / "mine",
            loop=True,
            limits=PATIENT,
        ) as driving,  # fmt: skip
    ):
        await driving.until(lambda: driving.acked() >= 4)
        draining = asyncio.create_task(drained())
        await driving.until(lambda: driving.handovers("server_lost") == 1)
        there = driving.acked()
        await driving.until(lambda: draining.done() and driving.acked() >= there + 4)
        await draining
    lines = driving.lines()
    assert [line for line in lines if line["result"] != "acked"] == []
    assert [line["index"] for line in lines] == [i % 6 for i in range(len(lines))]
    assert len({line["epoch"] for line in lines}) == 2, (
        "a stream to each server, nothing in between"
    )
    for line in lines:
        assert line["server_digest"] == line["reconstruction_digest"], "the same bytes at both ends"
        assert "render" in line["references"], "never a keyframe"


async def test_while_a_server_drains_it_serves_who_is_there_and_lets_nobody_in(
    coded: Any, serve: Any, raw_vehicle: Any
) -> None:
    async with AsyncExitStack() as running:
        server = await running.enter_async_context(serve(drain_hold_s=0.2))
        async with raw_vehicle(server.address) as vehicle:
            await vehicle.greet(coded.hello)
            stopping = asyncio.create_task(running.aclose())
            assert await vehicle.hear() == DrainNotice()
            assert await health(server.address) == health_pb2.HealthCheckResponse.NOT_SERVING
            async with raw_vehicle(server.address) as late:
                assert await late.end() is grpc.StatusCode.UNAVAILABLE
            assert isinstance(await vehicle.ask(coded.frames[0]), Ack)
            assert await vehicle.farewell() is grpc.StatusCode.OK
            await stopping


async def test_who_is_in_a_hurry_ends_the_hold(serve: Any) -> None:
    async with asyncio.timeout(10), AsyncExitStack() as running:
        server = await running.enter_async_context(serve(drain_hold_s=600.0))
        server.hurry()
