"""Attacks of one identity on what all share: each ends at a budget that is named, and a bystander
with another certificate, or another name, is served meanwhile."""

import asyncio
import hashlib
import itertools
import os
import threading
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import grpc
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc
from structlog.testing import capture_logs

from frames import flipped, message_of
from integration.conftest import random_field
from live_server import Files, certificates, counted, held, limited, until, watched
from mec_server.config import AdmissionLimits, IdentityBudget, SessionLimits
from mec_server.session import MAX_UNUSABLE, DecodeJob
from rfcore.field import save_field
from rfcore.wire.conventions import CHANNEL_OPTIONS, RETRY_AFTER, STREAM_METHOD
from rfcore.wire.convert import hello_to_bytes
from rfcore.wire.messages import Ack, Frame, Hello, Nack
from rfcore.wire.v1 import field_pb2 as pb
from rfcore.wire.v1.field_pb2_grpc import FieldServiceStub
from rfedge.certs import Members

EXHAUSTED = grpc.StatusCode.RESOURCE_EXHAUSTED
SHORT = SessionLimits(stalled_s=0.3)


def named(hello: Hello, vehicle_id: str, cameras: int = 1, rate_hz: float = 0.0) -> Hello:
    described = tuple(
        replace(hello.cameras[0], camera_id=f"{vehicle_id}-{number}", rate_hz=rate_hz)
        for number in range(cameras)
    )
    return replace(hello, vehicle_id=vehicle_id, cameras=described)


def of_camera(frame: Frame, vehicle_id: str) -> Frame:
    return replace(frame, camera_id=f"{vehicle_id}-0")


@pytest.fixture
def certs(tmp_path: Path) -> Files:
    members = Members(("cav-raw", "cav-other"), ("watch", "other"))
    return certificates(tmp_path / "certs", members)


@pytest.fixture
def connect(certs: Any) -> Callable[..., Any]:
    """Return a context manager that connects with a certificate."""

    @asynccontextmanager
    async def run(server: Any, name: str) -> AsyncIterator[grpc.aio.Channel]:
        # A local pool: several channels of one certificate are several connections.
        options = (*CHANNEL_OPTIONS, ("grpc.use_local_subchannel_pool", 1))
        credentials = certs(name).channel_credentials()
        async with grpc.aio.secure_channel(
            str(server.address), credentials, options=options
        ) as channel:
            yield channel

    return run


@pytest.fixture
def large_field(tmp_path: Path) -> tuple[Path, str]:
    """A folder with a field of 3 MB: more than gRPC takes in for a peer that does not read."""
    folder = tmp_path / "large"
    folder.mkdir()
    return folder, save_field(random_field(3, 30_000), folder / "large.rff")


async def drives(channel: grpc.aio.Channel, coded: Any) -> None:
    """Expect that the vehicle is served over ``channel``."""
    stream = channel.stream_stream(STREAM_METHOD)()
    await stream.write(hello_to_bytes(coded.hello))
    await stream.read()
    await stream.write(message_of(coded.hello, coded.frames[0]))
    await stream.read()
    await stream.done_writing()
    with suppress(grpc.aio.AioRpcError):
        while await stream.read() is not grpc.aio.EOF:
            pass
    assert await stream.code() is grpc.StatusCode.OK


# --- calls: FetchField, Watch, health


async def test_unread_fetches_over_many_connections_stop_at_two_and_end(
    certs: Any, connect: Any, serve: Any, large_field: Any
) -> None:
    folder, field_id = large_field
    async with (
        serve(tls=certs("server"), fields=folder, limits=SHORT) as server,
        AsyncExitStack() as s,
    ):
        calls = []
        for _ in range(3):
            channel = await s.enter_async_context(connect(server, "consumer-watch"))
            stub = FieldServiceStub(channel)
            calls += [stub.FetchField(pb.FetchFieldRequest(field_id=field_id)) for _ in range(8)]
        await until(lambda: limited(server, "identity_fetches") == len(calls) - 2)
        assert held(server, "fetches") == 2
        other = FieldServiceStub(await s.enter_async_context(connect(server, "vehicle-cav-raw")))
        got = 0
        async for answer in other.FetchField(pb.FetchFieldRequest(field_id=field_id)):
            got += len(answer.chunk)
        assert got == (folder / "large.rff").stat().st_size
        refused = next(call for call in calls if call.done())
        assert await refused.code() is EXHAUSTED
        assert (RETRY_AFTER, "1000") in tuple(await refused.trailing_metadata())
        unread = [call for call in calls if not call.done()]
        assert len(unread) == 2
        await until(lambda: limited(server, "unread_answers") == 2)
        assert held(server, "fetches") == 2, "what was not read still takes memory"
        for call in unread:
            assert "were not taken within 0.3 s" in await read_to_the_end(call)
        await until(lambda: held(server, "fetches") == 0)


def opened_here(path: Path) -> int:
    """Return how many descriptors of this process are open on a file."""
    links = []
    for descriptor in Path("/proc/self/fd").iterdir():
        with suppress(OSError):
            links.append(descriptor.readlink())
    return links.count(path)


async def test_a_transfer_that_stands_still_or_is_cut_holds_no_file_open(
    certs: Any, connect: Any, serve: Any, large_field: Any
) -> None:
    folder, field_id = large_field
    async with (
        serve(tls=certs("server"), fields=folder) as server,
        connect(server, "consumer-watch") as channel,
    ):
        stub = FieldServiceStub(channel)
        read = stub.FetchField(pb.FetchFieldRequest(field_id=field_id))
        assert (await read.read()).chunk
        await until(lambda: opened_here(folder / "large.rff") == 0)
        assert held(server, "fetches") == 1, "it goes on, and waits for us"
        read.cancel()
        await until(lambda: held(server, "fetches") == 0)
        assert opened_here(folder / "large.rff") == 0


async def test_a_field_that_is_gone_is_told_without_a_path_of_the_server(
    certs: Any, connect: Any, serve: Any, large_field: Any
) -> None:
    folder, field_id = large_field
    async with (
        serve(tls=certs("server"), fields=folder) as server,
        connect(server, "consumer-watch") as channel,
    ):
        server._index.refresh = lambda: None
        (folder / "large.rff").unlink()
        stub = FieldServiceStub(channel)
        for call in (
            stub.GetManifest(pb.GetManifestRequest(field_id=field_id)),
            stub.FetchField(pb.FetchFieldRequest(field_id=field_id)),
        ):
            assert await call.code() is grpc.StatusCode.NOT_FOUND
            assert "cannot be read here" in await call.details()
            assert str(folder) not in await call.details()


async def read_to_the_end(call: Any) -> str:
    """Return the details of a call's status once everything before it was read."""
    with suppress(grpc.aio.AioRpcError):
        while await call.read() is not grpc.aio.EOF:
            pass
    assert await call.code() is EXHAUSTED
    return str(await call.details())


async def test_calls_of_any_service_that_stay_open_stop_at_a_budget(
    certs: Any, connect: Any, serve: Any, coded: Any
) -> None:
    async with serve(tls=certs("server")) as server, AsyncExitStack() as stack:
        most = IdentityBudget().rpcs
        channel = await stack.enter_async_context(connect(server, "consumer-watch"))
        health = health_pb2_grpc.HealthStub(channel)
        calls = [health.Watch(health_pb2.HealthCheckRequest()) for _ in range(most + 8)]
        await until(lambda: limited(server, "identity_rpcs") == 8)
        assert held(server, "rpcs") == most
        await drives(await stack.enter_async_context(connect(server, "vehicle-cav-raw")), coded)
        for call in calls:
            call.cancel()
        await until(lambda: held(server, "rpcs") == 0)


# --- Hello: decoders, promises, openings


async def test_decoders_are_given_back_when_they_are_closed(
    serve: Any, raw_vehicle: Any, coded: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate = threading.Event()

    def hang(_: object) -> None:
        assert gate.wait(30)

    async with serve() as server:
        async with raw_vehicle(server.address) as vehicle:
            await vehicle.greet(coded.hello)
            monkeypatch.setattr("mec_server.reconstruction.CameraDecoder.close", hang)
            assert await vehicle.farewell() is grpc.StatusCode.OK
        await until(lambda: held(server, "streams") == 0)
        assert held(server, "decoders") == 1, "it is being closed, and still takes a process"
        gate.set()
        await until(lambda: held(server, "decoders") == 0)


async def test_openings_that_fail_again_and_again_make_their_vehicle_wait(
    serve: Any, raw_vehicle: Any, coded: Any
) -> None:
    camera = coded.hello.cameras[0]
    header = replace(camera.codec, sps=camera.codec.sps[:-2])
    broken = replace(coded.hello, cameras=(replace(camera, codec=header),))
    async with serve() as server:
        async with raw_vehicle(server.address) as vehicle:
            for _ in range(3):
                assert isinstance(await vehicle.ask(broken), Nack)
            await vehicle.say(coded.hello)
            assert await vehicle.end() is EXHAUSTED
            assert "3 openings of this vehicle came to nothing" in await vehicle.stream.details()
            metadata = dict(await vehicle.stream.trailing_metadata())
            assert 0 < int(metadata[RETRY_AFTER]) <= 500
        assert limited(server, "failed_openings") == 1
        assert counted(server, "rfedge_server_openings_total", result="failed") == 3
        async with raw_vehicle(server.address) as other:
            await other.greet(replace(coded.hello, vehicle_id="cav-other"))


# --- frames


@pytest.mark.parametrize("count", [0, MAX_UNUSABLE])
async def test_streams_of_no_frame_or_of_unusable_ones_make_their_vehicle_wait(
    serve: Any, raw_vehicle: Any, coded: Any, count: int
) -> None:
    damaged = flipped(message_of(coded.hello, coded.frames[0]))

    async def wasted_stream(server: Any) -> None:
        async with raw_vehicle(server.address) as vehicle:
            await vehicle.greet(coded.hello)
            for _ in range(count):
                await vehicle.say(damaged)
            if count == 0:
                assert await vehicle.farewell() is grpc.StatusCode.OK
                return
            assert await vehicle.end() is EXHAUSTED
            assert "could not be used" in await vehicle.stream.details()

    async with serve() as server:
        for _ in range(2):
            await wasted_stream(server)
        async with raw_vehicle(server.address) as honest:
            await honest.greet(coded.hello)
            assert await honest.told(coded.frames[0]) == ("ack", 0)
        for _ in range(3):
            await wasted_stream(server)
        async with raw_vehicle(server.address) as vehicle:
            await vehicle.say(coded.hello)
            assert await vehicle.end() is EXHAUSTED
            assert "3 openings of this vehicle came to nothing" in await vehicle.stream.details()
        assert limited(server, "failed_openings") == 1


async def test_a_frame_that_could_not_be_decoded_in_time_is_not_rendered(
    serve: Any, raw_vehicle: Any, coded: Any
) -> None:
    hasty = AdmissionLimits(render_deadline_s=1e-4)
    async with serve(admission=hasty) as server, raw_vehicle(server.address) as vehicle:
        await vehicle.greet(coded.hello)
        answer = await vehicle.ask(coded.frames[0])
        assert isinstance(answer, Nack)
        assert answer.reason == "overloaded"
        assert "the deadline is 0.0001 s after its arrival" in answer.problem
        assert limited(server, "render_deadline") == 1
        assert counted(server, "rfedge_server_spent_total", resource="worker_seconds") < 0.01


async def test_who_sends_what_cannot_be_decoded_is_soon_not_rendered_for(
    serve: Any, raw_vehicle: Any, coded: Any
) -> None:
    """With next to no time for rejected frames, the first one spends it all."""
    spent = IdentityBudget(rejected_workers=1e-6)
    junk = coded.frames[0].packet
    junk = replace(junk, render_digest=bytes(2), render_block_means=b"")
    async with (
        serve(identity_budget=spent) as server,
        raw_vehicle(server.address) as mallory,
        raw_vehicle(server.address) as modest,
    ):
        await mallory.greet(named(coded.hello, "mallory"))
        await modest.greet(named(coded.hello, "modest"))
        first, *others = [
            await mallory.told(of_camera(replace(coded.frames[0], packet=junk), "mallory"))
            for _ in range(4)
        ]
        assert first == ("render_mismatch", 0)
        assert others == [("overloaded", 0)] * 3
        assert limited(server, "identity_rejected_seconds") == 3
        assert await modest.told(of_camera(coded.frames[0], "modest")) == ("ack", 0)


async def test_a_long_render_is_charged_to_its_identity_and_leaves_a_worker_to_the_others(
    serve: Any, raw_vehicle: Any, coded: Any
) -> None:

    gate = threading.Event()
    begun: list[str] = []

    def slow(vehicle_id: str, _: DecodeJob) -> None:
        begun.append(vehicle_id)
        if vehicle_id == "greedy":
            assert gate.wait(30)

    async with (
        serve(watched(slow), workers=2) as server,
        raw_vehicle(server.address) as greedy,
        raw_vehicle(server.address) as modest,
    ):
        await greedy.greet(named(coded.hello, "greedy", 4))
        await modest.greet(named(coded.hello, "modest"))
        for number in range(4):
            await greedy.say(replace(coded.frames[0], camera_id=f"greedy-{number}"))
        await until(lambda: "greedy" in begun)
        for sequence in range(3):
            frame = of_camera(coded.frames[sequence], "modest")
            assert await modest.told(frame) == ("ack", sequence)
        assert begun.count("greedy") == 1, "one of two workers, while others stream"
        gate.set()
        for _ in range(4):
            assert isinstance(await greedy.hear(), Ack)


async def test_frames_of_who_sent_what_cannot_be_decoded_give_way_to_those_of_others(
    serve: Any, raw_vehicle: Any, coded: Any
) -> None:
    threads: list[tuple[str, str]] = []

    def note(vehicle_id: str, _: DecodeJob) -> None:
        threads.append((vehicle_id, threading.current_thread().name.rpartition("_")[0]))

    never_made_up_for = IdentityBudget(rejected_workers=1e-6)
    junk = replace(coded.frames[0].packet, render_digest=bytes(2), render_block_means=b"")
    async with serve(watched(note), identity_budget=never_made_up_for) as server:
        async with raw_vehicle(server.address) as mallory:
            await mallory.greet(named(coded.hello, "mallory"))
            bad = replace(coded.frames[0], packet=junk)
            assert await mallory.told(of_camera(bad, "mallory")) == ("render_mismatch", 0)
            good = of_camera(coded.frames[0], "mallory")
            assert await mallory.told(good) == ("ack", 0)
            await mallory.farewell()
        async with raw_vehicle(server.address) as modest:
            await modest.greet(named(coded.hello, "modest"))
            assert await modest.told(of_camera(coded.frames[0], "modest")) == ("ack", 0)
    assert threads == [
        ("mallory", "worker"),
        ("mallory", "background"),
        ("modest", "worker"),
    ]


async def test_answers_that_nobody_reads_end_the_stream(
    serve: Any, raw_vehicle: Any, coded: Any
) -> None:
    budget = IdentityBudget(messages_per_s=1e6)
    async with serve(limits=SHORT, identity_budget=budget) as server:
        async with raw_vehicle(server.address) as vehicle:
            await vehicle.greet(coded.hello)

            def acked() -> float:
                return counted(server, "rfedge_server_frames_total", result="acked", reason="")

            async def flood() -> None:
                """Never 64 useless messages in a row, and never read an answer."""
                for epoch in itertools.count(1):
                    for _ in range(50):
                        await vehicle.say(b"\xff rubbish")
                    packet = replace(coded.frames[0].packet, epoch=epoch)
                    await vehicle.say(replace(coded.frames[0], packet=packet))
                    await until(lambda epoch=epoch: acked() == epoch)

            flooding = asyncio.create_task(flood())
            await until(lambda: limited(server, "unread_answers") == 1)
            await until(lambda: held(server, "decoders") == 0)
            assert held(server, "streams") == 1, "what was not read still takes memory"
            flooding.cancel()
            await asyncio.gather(flooding, return_exceptions=True)
            assert "no answer was taken for 0.3 s" in await read_to_the_end(vehicle.stream)
        await until(lambda: held(server, "streams") == 0)


# --- fields


def told(lines: list[Any], event: str) -> bool:
    return any(line["event"] == event for line in lines)


async def largest_lag_s(during: Awaitable[object]) -> float:
    """Return for how long the event loop did nothing else, at most, while ``during`` went on."""
    loop, largest_s = asyncio.get_running_loop(), 0.0
    task = asyncio.ensure_future(during)
    while not task.done():
        before_s = loop.time()
        await asyncio.sleep(0.002)
        largest_s = max(largest_s, loop.time() - before_s - 0.002)
    await task
    return largest_s


async def test_whatever_is_put_into_the_folder_of_fields_streams_go_on(
    serve: Any, raw_vehicle: Any, coded: Any, street: Any, tmp_path: Path, monkeypatch: Any
) -> None:
    folder, gate, digesting = tmp_path / "fields", threading.Event(), threading.Event()
    folder.mkdir()
    (folder / "street.rff").write_bytes((street.store / "street.rff").read_bytes())
    digest = hashlib.file_digest

    def slow_digest(file: Any, name: str) -> Any:
        digesting.set()
        assert gate.wait(30)
        return digest(file, name)

    async def vehicles_come() -> None:
        for number in range(10):
            async with raw_vehicle(server.address) as vehicle:
                await vehicle.greet(replace(coded.hello, vehicle_id=f"cav-{number}"))
                assert await vehicle.told(coded.frames[0]) == ("ack", 0)

    with capture_logs() as lines:
        async with serve(fields=folder) as server:
            monkeypatch.setattr(hashlib, "file_digest", slow_digest)
            (folder / "folder.rff").mkdir()
            os.mkfifo(folder / "pipe.rff")
            (folder / "dangling.rff").symlink_to(folder / "nowhere")
            (folder / "large.rff").write_bytes((street.other_store / "other.rff").read_bytes())
            await asyncio.to_thread(digesting.wait, 30)
            assert await largest_lag_s(vehicles_come()) < 0.5, "the digest is waiting for us"
            assert server._index.ids() == (street.field_id,)
            gate.set()
            await until(
                lambda: server._index.ids() == tuple(sorted((street.field_id, street.other_id)))
            )
            await until(lambda: sum(line["event"] == "entry skipped" for line in lines) >= 3)
            for _ in range(3):
                await server.index_fields()
    skipped = [line for line in lines if line["event"] == "entry skipped"]
    assert {Path(line["path"]).name for line in skipped} == {
        "folder.rff",
        "pipe.rff",
        "dangling.rff",
    }
    assert len(skipped) == 3, "each is logged once"
