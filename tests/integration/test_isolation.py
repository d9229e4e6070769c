"""A fault of one vehicle costs the others nothing or little, and is never silent."""

import asyncio
import threading
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import grpc
import pytest
from structlog.testing import capture_logs

from live_server import counted, until, watch_call, watched
from mec_server.config import AdmissionLimits, DecoderKind, LearnSettings, NatsSettings
from mec_server.metrics import BackgroundTask
from mec_server.peers import FAILED
from mec_server.reconstruction import Decoder, FieldSource, Tools, open_cameras
from mec_server.session import DecodeJob, OpenJob
from rfcore.codec.h264.ffmpeg import H264Decoder
from rfcore.wire.conventions import AGENT_PROCESS
from rfcore.wire.messages import Ack, Hello

EVERYBODY = AdmissionLimits(load=0.0)
SAME_AGENT = ((AGENT_PROCESS, "the same"),)
OPENINGS = "rfedge_server_openings_total"
FAILURES = "rfedge_server_task_failures_total"


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
    """Parts of a test of a failing background task."""

    coded: Any
    serve: Any
    raw_vehicle: Any
    patch: pytest.MonkeyPatch
    folder: Path


class SurpriseError(Exception):
    """An error that no code expects."""


def surprise(*_: Any) -> Any:
    raise SurpriseError


def failed(server: Any, task: BackgroundTask) -> bool:
    return counted(server, FAILURES, task=task) >= 1


REPEATED = {
    BackgroundTask.PUBLICATIONS: (
        "fields.index.PublishedFields.refresh",
        "PUBLICATIONS_EVERY_S",
    ),
    BackgroundTask.ACCESS: ("guard.Guard.sweep", "SWEEP_EVERY_S"),
    BackgroundTask.FIELDS: ("fields.index.FieldIndex.refresh", "FIELDS_EVERY_S"),
    BackgroundTask.CONNECTIONS: ("connections.Connections.sweep", "CONNECTIONS_EVERY_S"),
    BackgroundTask.LEARNING: ("learner.Learner.look", "LEARNING_EVERY_S"),
    BackgroundTask.NOTICES: ("twin.notices.StreetNotices.follow", "NOTICES_EVERY_S"),
    BackgroundTask.NATS_TWIN: ("twin.nats.TwinPublisher.run", ""),
    BackgroundTask.NATS_FIELDS: ("nats.FieldExchange.run", ""),
}
"""The work of each repeated task, and the constant of its period."""


async def repeated_task_fails(task: BackgroundTask, scene: Scene) -> Any:
    """Have what a task does fail until a vehicle was served; expect that it is done again."""
    name, period = REPEATED[task]
    done = resolve_name(f"mec_server.{name}")
    well, again = threading.Event(), threading.Event()

    def fail_at_first(*args: Any) -> Any:
        if not well.is_set():
            raise SurpriseError
        again.set()
        return done(*args)

    scene.patch.setattr(f"mec_server.{name}", fail_at_first)
    pause = f"mec_server.server.{period}" if period else "mec_server.twin.nats.AGAIN_S"
    scene.patch.setattr(pause, 0.001)
    options: dict[str, Any] = {}
    if task is BackgroundTask.LEARNING:
        options = {"record": scene.folder, "learn": LearnSettings(on=True)}
    elif not period:  # nobody listens at the port, so that the other part waits
        options = {"nats": NatsSettings("nats://127.0.0.1:1")}
    async with scene.serve(**options) as server:
        await until(lambda: failed(server, task))
        await drive_on(scene, server)
        well.set()
        await until(again.is_set)
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


async def drive_on(scene: Scene, server: Any) -> None:
    """Expect that a vehicle is served."""
    async with scene.raw_vehicle(server.address) as vehicle:
        await vehicle.greet(scene.coded.hello)
        assert await vehicle.told(scene.coded.frames[0]) == ("ack", 0)
        assert await vehicle.farewell() is grpc.StatusCode.OK


SABOTAGE: dict[BackgroundTask, Callable[[Scene], Awaitable[Any]]] = {
    BackgroundTask.OPENING: opening_fails,
    BackgroundTask.OUTCOME: outcome_fails,
    BackgroundTask.CLOSING: closing_fails,
    BackgroundTask.DECODER_START: decoder_start_fails,
    BackgroundTask.STREAM: stream_fails,
    BackgroundTask.CONSUMER: consumer_fails,
    BackgroundTask.RECORDING: recording_fails,
} | {task: partial(repeated_task_fails, task) for task in REPEATED}
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
