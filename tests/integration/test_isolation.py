"""What one vehicle does wrong costs the others nothing or little; what fails is never silent."""

import asyncio
import threading
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import grpc
import pytest
from structlog.testing import capture_logs

from live_server import counted, until, watch_call
from mec_server.config import AdmissionLimits, DecoderKind, LearnSettings, NatsSettings
from mec_server.connections import ClosedConnections, Connections
from mec_server.metrics import BackgroundTask
from mec_server.peers import FAILED
from mec_server.reconstruction import Decoder, FieldSource, Reconstruction, Tools, open_cameras
from mec_server.session import DecodeJob, OpenJob
from rfcore.codec.h264.ffmpeg import H264Decoder
from rfcore.wire.conventions import AGENT_PROCESS
from rfcore.wire.messages import Ack, Hello

EVERYBODY = AdmissionLimits(load=0.0)
SAME_AGENT = ((AGENT_PROCESS, "the same"),)
OPENINGS = "rfedge_server_openings_total"
FAILURES = "rfedge_server_task_failures_total"


class WatchedDecoder:
    """Calls ``before`` on the worker for each frame, then has ``decoder`` render and decode it."""

    def __init__(self, decoder: Decoder, before: Callable[[DecodeJob], None]) -> None:
        self._decoder = decoder
        self._before = before

    def reconstruct(self, job: DecodeJob) -> Reconstruction:
        self._before(job)
        return self._decoder.reconstruct(job)

    def close(self) -> None:
        self._decoder.close()


def watched(before: Callable[[str, DecodeJob], None]) -> Callable[..., dict[str, Decoder]]:
    """Return ``open_cameras`` with decoders that call ``before`` with vehicle and frame."""

    def opened(job: OpenJob, fields: FieldSource, tools: Tools) -> dict[str, Decoder]:
        vehicle_id = job.hello.vehicle_id
        return {
            name: WatchedDecoder(decoder, lambda frame: before(vehicle_id, frame))
            for name, decoder in open_cameras(job, fields, tools).items()
        }

    return opened


def with_cameras(hello: Hello, vehicle_id: str, camera_ids: list[str]) -> Hello:
    cameras = tuple(replace(hello.cameras[0], camera_id=name) for name in camera_ids)
    return replace(hello, vehicle_id=vehicle_id, cameras=cameras)


# --- frames


async def test_a_frame_waits_for_at_most_one_more_of_a_vehicle_that_has_many_waiting(
    coded: Any, serve: Any, raw_vehicle: Any
) -> None:
    begun: list[str] = []
    gate = threading.Event()

    def hold_the_first(vehicle_id: str, _: DecodeJob) -> None:
        begun.append(vehicle_id)
        assert gate.wait(30)

    names = [f"camera{number}" for number in range(8)]
    opened, first = watched(hold_the_first), coded.frames[0]
    async with (
        serve(opened, workers=1, admission=EVERYBODY) as server,
        raw_vehicle(server.address) as greedy,
        raw_vehicle(server.address) as modest,
    ):
        await greedy.greet(with_cameras(coded.hello, "cav-greedy", names))
        await modest.greet(with_cameras(coded.hello, "cav-modest", ["front"]))
        for name in names:
            await greedy.say(replace(first, camera_id=name))
        await until(lambda: frames_received(server) == len(names))
        await modest.say(first)
        await until(lambda: frames_received(server) == len(names) + 1)
        gate.set()
        assert isinstance(await modest.hear(), Ack)
        for _ in names:
            assert isinstance(await greedy.hear(), Ack)
    assert begun[:3] == ["cav-greedy", "cav-greedy", "cav-modest"]
    assert len(begun) == len(names) + 1


def frames_received(server: Any) -> int:
    """Return how many frames the server has taken in, of whatever references."""
    return round(
        sum(
            sample.value
            for family in server.registry.collect()
            for sample in family.samples
            if sample.name == "rfedge_server_coded_frames_total"
        )
    )


# --- openings


async def test_openings_of_streams_that_are_over_are_dropped_and_delay_nobody(
    coded: Any, serve: Any, raw_vehicle: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened_for: list[str] = []
    gate = threading.Event()

    def opened(job: OpenJob, fields: FieldSource, tools: Tools) -> dict[str, Decoder]:
        opened_for.append(job.hello.vehicle_id)
        assert gate.wait(30)
        return open_cameras(job, fields, tools)

    def hello(name: str) -> Hello:
        return replace(coded.hello, vehicle_id=name)

    async with AsyncExitStack() as stack, serve(opened, admission=EVERYBODY) as server:
        asked = submissions(server, monkeypatch)
        first = await stack.enter_async_context(raw_vehicle(server.address))
        await first.say(hello("cav-first"))
        await until(lambda: opened_for == ["cav-first"])
        async with AsyncExitStack() as impatient:
            for _ in range(5):
                vehicle = await impatient.enter_async_context(
                    raw_vehicle(server.address, metadata=SAME_AGENT)
                )
                await vehicle.say(hello("cav-impatient"))
            await until(lambda: asked.count("cav-impatient") == 5)
        await until(lambda: counted(server, "rfedge_server_sessions") == 1)
        last = await stack.enter_async_context(raw_vehicle(server.address))
        await last.say(hello("cav-last"))
        await until(lambda: "cav-last" in asked)
        gate.set()
        for vehicle in (first, last):
            await vehicle.hear()
            assert await vehicle.told(coded.frames[0]) == ("ack", 0)
        await until(lambda: counted(server, OPENINGS, result="cancelled") == 5)
        assert counted(server, OPENINGS, result="opened") == 2
    assert opened_for == ["cav-first", "cav-last"]


async def test_a_stream_that_ends_halfway_through_its_opening_opens_no_more_decoders(
    coded: Any, serve: Any, raw_vehicle: Any
) -> None:
    first, gate, started = threading.Event(), threading.Event(), list[tuple[int, int]]()

    def open_decoder(size_px: tuple[int, int]) -> H264Decoder:
        started.append(size_px)
        first.set()
        assert gate.wait(30)
        return H264Decoder(size_px)

    async with serve(admission=EVERYBODY) as server:
        decoding = server._edge._server.decoding
        decoding = replace(decoding, tools=replace(decoding.tools, open_decoder=open_decoder))
        server._edge._server = replace(server._edge._server, decoding=decoding)
        async with raw_vehicle(server.address) as vehicle:
            await vehicle.say(with_cameras(coded.hello, "cav-gone", ["a", "b", "c"]))
            assert await asyncio.to_thread(first.wait, 30)
        await until(lambda: counted(server, "rfedge_server_sessions") == 0)
        gate.set()
        await until(lambda: counted(server, OPENINGS, result="cancelled") == 1)
    assert len(started) == 1


def submissions(server: Any, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the owners of all openings that are submitted from now on."""
    owners: list[str] = []
    submit = server._opener.submit

    def noted(owner: str, *work: Any) -> None:
        owners.append(owner)
        submit(owner, *work)

    monkeypatch.setattr(server._opener, "submit", noted)
    return owners


# --- background tasks


@dataclass(frozen=True)
class Scene:
    """What a test of a failing background task needs."""

    coded: Any
    serve: Any
    raw_vehicle: Any
    patch: pytest.MonkeyPatch
    folder: Path


class SurpriseError(Exception):
    """What nobody expects."""


def surprise(*_: Any) -> Any:
    raise SurpriseError


def failed(server: Any, task: BackgroundTask) -> bool:
    return counted(server, FAILURES, task=task) >= 1


async def publications_fail(scene: Scene) -> Any:
    scene.patch.setattr("mec_server.server.PUBLICATIONS_EVERY_S", 0.001)
    async with scene.serve() as server:
        refresh, looked = server._published.refresh, asyncio.Event()
        scene.patch.setattr(server._published, "refresh", surprise)
        await until(lambda: failed(server, BackgroundTask.PUBLICATIONS))
        loop = asyncio.get_running_loop()

        def good_again() -> bool:
            loop.call_soon_threadsafe(looked.set)
            return bool(refresh())

        scene.patch.setattr(server._published, "refresh", good_again)
        async with asyncio.timeout(30):
            await looked.wait()
    return server


async def fields_fail(scene: Scene) -> Any:
    async with scene.serve() as server:
        scene.patch.setattr(server._index, "refresh", surprise)
        await until(lambda: failed(server, BackgroundTask.FIELDS))
        await drive_on(scene, server)
        looked = threading.Event()
        scene.patch.setattr(server._index, "refresh", looked.set)
        await asyncio.to_thread(looked.wait, 30)
        assert looked.is_set()
    return server


async def connections_fail(scene: Scene) -> Any:
    sweep, looked = "mec_server.connections.Connections.sweep", threading.Event()

    def seen(_: Connections, now: float) -> list[ClosedConnections]:
        del now
        looked.set()
        return []

    async with scene.serve() as server:
        scene.patch.setattr(sweep, surprise)
        await until(lambda: failed(server, BackgroundTask.CONNECTIONS))
        await drive_on(scene, server)
        scene.patch.setattr(sweep, seen)
        await asyncio.to_thread(looked.wait, 30)
        assert looked.is_set()
    return server


async def opening_fails(scene: Scene) -> Any:
    def opened(job: OpenJob, fields: FieldSource, tools: Tools) -> dict[str, Decoder]:
        return surprise() if job.hello.vehicle_id == "cav-bad" else open_cameras(job, fields, tools)

    async with scene.serve(opened) as server:
        async with scene.raw_vehicle(server.address) as bad:
            await bad.say(replace(scene.coded.hello, vehicle_id="cav-bad"))
            assert await bad.end() is grpc.StatusCode.INTERNAL, "the stream that met it ends"
        await drive_on(scene, server)
    return server


async def stream_fails(scene: Scene) -> Any:
    def broken(_: str, __: DecodeJob) -> None:
        surprise()

    async with scene.serve(watched(broken)) as server, scene.raw_vehicle(server.address) as vehicle:
        await vehicle.greet(scene.coded.hello)
        await vehicle.say(scene.coded.frames[0])
        assert await vehicle.end() is grpc.StatusCode.INTERNAL
    return server


async def consumer_fails(scene: Scene) -> Any:
    scene.patch.setattr("mec_server.twin.service.encoded_picture", surprise)
    async with scene.serve() as server, AsyncExitStack() as stack:
        channel = grpc.aio.insecure_channel(str(server.address))
        watching = watch_call(await stack.enter_async_context(channel))
        await until(lambda: counted(server, "rfedge_twin_consumers") == 1)
        await drive_on(scene, server)
        with pytest.raises(grpc.aio.AioRpcError) as raised:
            await watching.read()
        assert raised.value.code() is grpc.StatusCode.INTERNAL
        assert raised.value.details() == FAILED  # and nothing of the exception
        await drive_on(scene, server)
    return server


async def outcome_fails(scene: Scene) -> Any:
    async with scene.serve() as server:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("mec_server.stream.Stream._finished", surprise)
            async with scene.raw_vehicle(server.address) as vehicle:
                await vehicle.greet(scene.coded.hello)
                await vehicle.say(scene.coded.frames[0])
                await until(lambda: failed(server, BackgroundTask.OUTCOME))
        await until(lambda: counted(server, "rfedge_server_sessions") == 0)
        await drive_on(scene, server)
    return server


async def closing_fails(scene: Scene) -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mec_server.reconstruction.CameraDecoder.close", surprise)
        async with scene.serve() as server:
            await drive_on(scene, server)
            await until(lambda: failed(server, BackgroundTask.CLOSING))
    return server


async def decoder_start_fails(scene: Scene) -> Any:
    async with scene.serve(decoder=DecoderKind.CHILD) as server:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(server._decoders._pool, "_start", surprise)
            await drive_on(scene, server)  # with the spare process that was ready
            await until(lambda: failed(server, BackgroundTask.DECODER_START))
    return server


async def recording_fails(scene: Scene) -> Any:
    scene.patch.setattr("mec_server.recorder.png_bytes", surprise)
    async with scene.serve(record=scene.folder) as server:
        await drive_on(scene, server)
        await until(lambda: failed(server, BackgroundTask.RECORDING))
        assert counted(server, "rfedge_server_recording") == 0
        await drive_on(scene, server)
    return server


async def learning_fails(scene: Scene) -> Any:
    scene.patch.setattr("mec_server.server.LEARNING_EVERY_S", 0.001)
    scene.patch.setattr("mec_server.server.Learner.look", surprise)
    learn = LearnSettings(on=True)
    async with scene.serve(record=scene.folder, learn=learn) as server:
        await until(lambda: failed(server, BackgroundTask.LEARNING))
        await drive_on(scene, server)
    return server


async def notices_fail(scene: Scene) -> Any:
    scene.patch.setattr("mec_server.server.NOTICES_EVERY_S", 0.001)
    scene.patch.setattr("mec_server.server.StreetNotices.follow", surprise)
    async with scene.serve() as server:
        await until(lambda: failed(server, BackgroundTask.NOTICES))
        await drive_on(scene, server)
    return server


async def drive_on(scene: Scene, server: Any) -> None:
    """Expect that a vehicle is served."""
    async with scene.raw_vehicle(server.address) as vehicle:
        await vehicle.greet(scene.coded.hello)
        assert await vehicle.told(scene.coded.frames[0]) == ("ack", 0)
        assert await vehicle.farewell() is grpc.StatusCode.OK


async def access_fails(scene: Scene) -> Any:
    scene.patch.setattr("mec_server.server.SWEEP_EVERY_S", 0.001)
    async with scene.serve() as server:
        sweep, swept = server._guard.sweep, asyncio.Event()
        scene.patch.setattr(server._guard, "sweep", surprise)
        await until(lambda: failed(server, BackgroundTask.ACCESS))

        def good_again() -> None:
            swept.set()
            sweep()

        scene.patch.setattr(server._guard, "sweep", good_again)
        async with asyncio.timeout(30):
            await swept.wait()
        return server


async def nats_twin_fails(scene: Scene) -> Any:
    return await _nats_fails(scene, "mec_server.twin.nats.TwinPublisher", BackgroundTask.NATS_TWIN)


async def nats_fields_fail(scene: Scene) -> Any:
    return await _nats_fails(scene, "mec_server.nats.FieldExchange", BackgroundTask.NATS_FIELDS)


async def _nats_fails(scene: Scene, part: str, task: BackgroundTask) -> Any:
    """Have a part fail at first; nobody listens at the port, so that the other one waits."""
    scene.patch.setattr("mec_server.twin.nats.AGAIN_S", 0.001)
    scene.patch.setattr(f"{part}.run", surprise)
    nats = NatsSettings("nats://127.0.0.1:1")
    async with scene.serve(nats=nats) as server:
        await until(lambda: failed(server, task))
        await drive_on(scene, server)
    return server


SABOTAGE: dict[BackgroundTask, Callable[[Scene], Awaitable[Any]]] = {
    BackgroundTask.PUBLICATIONS: publications_fail,
    BackgroundTask.ACCESS: access_fails,
    BackgroundTask.FIELDS: fields_fail,
    BackgroundTask.CONNECTIONS: connections_fail,
    BackgroundTask.OPENING: opening_fails,
    BackgroundTask.OUTCOME: outcome_fails,
    BackgroundTask.CLOSING: closing_fails,
    BackgroundTask.DECODER_START: decoder_start_fails,
    BackgroundTask.STREAM: stream_fails,
    BackgroundTask.CONSUMER: consumer_fails,
    BackgroundTask.RECORDING: recording_fails,
    BackgroundTask.LEARNING: learning_fails,
    BackgroundTask.NOTICES: notices_fail,
    BackgroundTask.NATS_TWIN: nats_twin_fails,
    BackgroundTask.NATS_FIELDS: nats_fields_fail,
}
ENDS_WITH_IT = {BackgroundTask.OPENING: BackgroundTask.STREAM}
"""A task that ends through the failure of another is counted, too."""


@pytest.mark.parametrize("task", BackgroundTask)
async def test_an_unexpected_exception_in_a_background_task_is_logged_and_counted(
    task: BackgroundTask,
    coded: Any,
    serve: Any,
    raw_vehicle: Any,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    scene = Scene(coded, serve, raw_vehicle, monkeypatch, tmp_path)
    with capture_logs() as lines:
        server = await SABOTAGE[task](scene)
    expected = {task, ENDS_WITH_IT.get(task, task)}
    assert {each for each in BackgroundTask if failed(server, each)} == expected
    logged = [line for line in lines if line["event"] == "background task failed"]
    assert {line["task"] for line in logged} == expected
    assert all("SurpriseError()" in line["problem"] for line in logged)
    assert len(logged) == sum(counted(server, FAILURES, task=each) for each in expected)


async def test_vehicles_and_consumers_that_vanish_are_no_failures(
    coded: Any, serve: Any, raw_vehicle: Any
) -> None:
    async with serve(admission=EVERYBODY) as server, AsyncExitStack() as stack:
        channel = grpc.aio.insecure_channel(str(server.address))
        await stack.enter_async_context(channel)
        for number in range(8):
            watching = watch_call(channel)
            await until(lambda: counted(server, "rfedge_twin_consumers") == 1)
            async with raw_vehicle(server.address) as vehicle:
                await vehicle.greet(replace(coded.hello, vehicle_id=f"cav-{number}"))
                await vehicle.say(coded.frames[0])
                if number % 2:
                    await watching.read()
                await vehicle.say(coded.frames[1])
            watching.cancel()
            await until(lambda: counted(server, "rfedge_server_sessions") == 0)
            await until(lambda: counted(server, "rfedge_twin_consumers") == 0)
    assert [task for task in BackgroundTask if failed(server, task)] == []
