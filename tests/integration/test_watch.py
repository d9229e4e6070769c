"""Consumers of the twin beside real vehicles: exact, limited, and never in the way."""

import asyncio
import doctest
import gc
import json
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import grpc
import numpy as np
import pytest
from mcap.reader import make_reader

from live_server import consumer
from mec_server.config import ServerBudget, SessionLimits
from mec_server.twin import rendering
from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfcore.field import load_field
from rfcore.field.store import anchored_file
from rfcore.geodesy import Anchor
from rfcore.image import read_rgb
from rfcore.wire.settings import MetricsSettings
from rfcore.wire.twin import (
    Departure,
    PictureEncoding,
    Subscription,
    TwinPicture,
    subscription_to_wire,
    twin_message_from_wire,
)
from rfcore.wire.twin_client import TwinClient
from rfcore.wire.twin_render import (
    ObjectsRequest,
    ObjectsSeen,
    ViewRequest,
    objects_request_to_wire,
    view_request_to_wire,
)
from rfcore.wire.v1 import twin_pb2, twin_pb2_grpc
from rfedge.watch import WatchSettings, watch

CAMERA = Intrinsics(76, 52, 50.0, 50.0, 38.0, 26.0)


@pytest.fixture(autouse=True)
def views_have_the_usual_priority(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rendering, "VIEWS_NICE", 0)


async def next_of(call: Any) -> TwinPicture | Departure:
    response = await call.read()
    assert response is not grpc.aio.EOF
    return twin_message_from_wire(response)


async def seen_until_departure(call: Any) -> list[TwinPicture]:
    pictures = []
    while isinstance(message := await next_of(call), TwinPicture):
        pictures.append(message)
    return pictures


async def test_a_consumer_sees_to_the_bit_what_the_vehicle_holds(serve: Any, travel: Any) -> None:
    async with (
        serve() as server,
        consumer(server.address, Subscription(encoding=PictureEncoding.I420)) as call,
    ):
        record = await travel(server.address)
        pictures = await seen_until_departure(call)
    held = {line["sequence"]: line["reconstruction_digest"] for line in record.lines}
    assert [p.sequence for p in pictures] == sorted({p.sequence for p in pictures})
    assert pictures[-1].sequence == 5, "the newest is always seen"
    assert len(pictures) + pictures[-1].skipped == 6
    for picture in pictures:
        assert picture.planes.digest() == picture.reconstruction_digest
        assert picture.reconstruction_digest.hex().startswith(held[picture.sequence])
        assert (picture.vehicle_id, picture.camera_id) == ("cav-1", "front")
        assert picture.age_ns > 0


async def test_the_example_of_the_client_runs(serve: Any, travel: Any, capsys: Any) -> None:
    assert TwinClient.__doc__ is not None
    examples = doctest.DocTestParser().get_examples(TwinClient.__doc__)
    source = "".join(example.source for example in examples)
    async with serve() as server:
        watching = asyncio.create_task(
            asyncio.to_thread(exec, source.replace("127.0.0.1:50051", str(server.address)), {})
        )
        while not server.registry.get_sample_value("rfedge_twin_consumers"):
            await asyncio.sleep(0.01)
        await travel(server.address)
        await server.stop()
        await watching
    assert "cav-1 front (52, 76, 3)" in capsys.readouterr().out.splitlines()


@pytest.mark.parametrize(("encoding", "worst"), [("png", 0), ("jpeg", 12), ("none", None)])
async def test_a_picture_comes_in_the_encoding_that_was_asked_for(
    serve: Any, travel: Any, encoding: str, worst: int | None
) -> None:
    """JPEG at quality 90 with half the chroma stays within a few levels on average."""
    async with serve() as server:
        async with consumer(server.address, Subscription(encoding=PictureEncoding.I420)) as call:
            await travel(server.address)
            exact = (await seen_until_departure(call))[-1]
        async with consumer(
            server.address, Subscription(encoding=PictureEncoding(encoding))
        ) as call:
            await travel(server.address)
            picture = (await seen_until_departure(call))[-1]
    assert picture.encoding == encoding
    if worst is None:
        assert picture.picture == b""
        return
    error = np.abs(picture.rgb.astype(int) - exact.rgb)
    assert error.mean() <= worst


async def test_a_consumer_that_never_reads_slows_no_vehicle_and_is_let_go(
    serve: Any, travel: Any
) -> None:
    """Its window is full after a few pictures; misses are counted; after 3 s it is let go.

    Vehicles drive until then: on a busy machine a picture can be missed before the window is full.
    """
    limits = SessionLimits(stalled_s=3.0)
    async with serve(limits=limits) as server:
        value = server.registry.get_sample_value
        async with consumer(server.address, Subscription(encoding=PictureEncoding.I420)):
            while value("rfedge_twin_consumers_ended_total", {"reason": "slow"}) < 1:
                record = await travel(server.address)
                assert record.counts == {"acked": 6}
            assert value("rfedge_twin_pictures_missed_total") > 0
            assert value("rfedge_twin_consumers") == 0
        record = await travel(server.address)
        assert record.counts == {"acked": 6}


async def test_consumers_are_limited_and_one_that_leaves_makes_room(
    serve: Any, travel: Any
) -> None:
    async with serve(server_budget=ServerBudget(watches=1)) as server:
        value = server.registry.get_sample_value
        async with consumer(server.address, Subscription()) as first:
            await travel(server.address)
            assert isinstance(await next_of(first), TwinPicture)
            async with consumer(server.address, Subscription()) as second:
                assert await second.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
                assert "have 1 watches, asked for 1 more, 1 may be" in await second.details()
        while value("rfedge_twin_consumers"):
            await asyncio.sleep(0.01)
        assert value("rfedge_twin_consumers_ended_total", {"reason": "left"}) == 1
        assert value("rfedge_twin_consumers_ended_total", {"reason": "refused"}) == 1
        async with consumer(server.address, Subscription()) as third:
            await travel(server.address)
            assert isinstance(await next_of(third), TwinPicture)


@pytest.mark.parametrize(
    ("subscription", "problem"),
    [
        (Subscription(frozenset({"../etc"})), "vehicle_ids"),
        (Subscription(frozenset(str(i) for i in range(257))), "vehicle_ids: 257 is outside 0..256"),
    ],
)
async def test_a_subscription_nobody_can_have_is_refused(
    serve: Any, subscription: Subscription, problem: str
) -> None:
    async with serve() as server, consumer(server.address, subscription) as call:
        assert await call.code() is grpc.StatusCode.INVALID_ARGUMENT
        assert problem in await call.details()


@asynccontextmanager
async def consumer_of_stopping(serve: Any) -> AsyncIterator[Any]:
    """A consumer whose server stops while it watches."""
    async with AsyncExitStack() as stack:
        server = await stack.enter_async_context(serve())
        call = await stack.enter_async_context(consumer(server.address, Subscription()))
        assert server.registry.get_sample_value("rfedge_twin_consumers") == 1
        await server.stop()
        yield call


async def test_a_server_that_drains_lets_consumers_go(serve: Any) -> None:
    async with consumer_of_stopping(serve) as call:
        assert await call.code() is grpc.StatusCode.OK


async def test_the_age_of_the_twin_is_there_while_a_vehicle_streams(
    serve: Any, travel: Any
) -> None:
    async with serve(metrics=MetricsSettings(per_vehicle=True)) as server:
        value = server.registry.get_sample_value
        async with consumer(server.address, Subscription(encoding=PictureEncoding.NONE)) as call:
            driving = asyncio.create_task(travel(server.address))
            while (age_s := value("rfedge_twin_age_seconds", {"vehicle": "cav-1"})) is None:
                await asyncio.sleep(0)
            assert age_s > 0
            await driving
            await seen_until_departure(call)
        assert value("rfedge_twin_age_seconds", {"vehicle": "cav-1"}) is None


@pytest.fixture
def watch_command() -> Callable[..., Awaitable[list[str]]]:
    """Return a coroutine that watches in a thread, and the lines it printed."""

    async def run(address: object, **settings: Any) -> None:
        with TwinClient(str(address)) as client:
            await asyncio.to_thread(watch, WatchSettings(**settings), client, client.objects)

    return run


async def test_the_watch_command_keeps_pictures_and_a_video(
    serve: Any, travel: Any, watch_command: Any, tmp_path: Path, capsys: Any
) -> None:
    settings = {"folder": tmp_path / "kept", "video": tmp_path / "kept.mp4", "pictures": 4}
    async with serve() as server:
        watching = asyncio.create_task(watch_command(server.address, **settings))
        while not server.registry.get_sample_value("rfedge_twin_consumers"):
            await asyncio.sleep(0.01)
        while not watching.done():
            record = await travel(server.address)
        await watching
    folder = tmp_path / "kept" / "cav-1" / "front"
    index = [json.loads(line) for line in (folder / "index.jsonl").read_text().splitlines()]
    assert len(index) == 4
    known = {line["reconstruction_digest"] for line in record.lines}
    for line in index:
        assert line["digest"][:12] in known
        assert read_rgb(folder / line["file"]).shape == (52, 76, 3)
    with av.open(str(tmp_path / "kept.mp4")) as container:
        times = [frame.time for frame in container.decode(video=0)]
    captured = [line["capture_time_ns"] for line in index]
    assert times == pytest.approx([(t - captured[0]) / 1e9 for t in captured], abs=2e-5)
    assert capsys.readouterr().out.count("cav-1/front 0:") == 4


async def test_the_watch_command_keeps_an_mcap_of_what_the_server_shows(
    serve: Any, travel: Any, watch_command: Any, tmp_path: Path
) -> None:
    async with serve() as server:
        settings = {"mcap": tmp_path / "kept.mcap", "pictures": 4}
        watching = asyncio.create_task(watch_command(server.address, **settings))
        while not server.registry.get_sample_value("rfedge_twin_consumers"):
            await asyncio.sleep(0.01)
        while not watching.done():
            await travel(server.address)
        await watching
    with (tmp_path / "kept.mcap").open("rb") as file:
        found = [
            (schema.name, channel.topic) for schema, channel, _ in make_reader(file).iter_messages()
        ]
    kept = {topic: name for name, topic in found}
    assert kept["/cav-1/front/video"] == "foxglove.CompressedVideo"
    assert kept["/tf"] == "foxglove.FrameTransform"
    assert 1 <= [topic for _, topic in found].count("/cav-1/front/video") <= 4


@pytest.mark.usefixtures("small_things")
async def test_the_watch_command_keeps_what_the_server_sees_as_collective_perception_messages(
    street: Any, coded: Any, serve: Any, raw_vehicle: Any, tmp_path: Path
) -> None:
    """The red box of the drive, on the same field with an anchor."""
    field_id = anchored_file(street.store / "street.rff", Anchor(48, 11), tmp_path / "street.rff")
    kept = tmp_path / "kept" / "seen.jsonl"
    settings, field = WatchSettings(cpm=kept, station=42), load_field(tmp_path / "street.rff")
    async with serve(fields=tmp_path) as server, raw_vehicle(server.address) as vehicle:
        with TwinClient(str(server.address)) as client:
            reports = []

            def objects(request: ObjectsRequest) -> Iterator[ObjectsSeen]:
                for seen in client.objects(request):
                    reports.append(seen)
                    yield seen

            watching = asyncio.create_task(
                asyncio.to_thread(watch, settings, client, objects, field)
            )
            await vehicle.greet(replace(coded.hello, field_ids=(field_id,)))
            for number, frame in enumerate(coded.frames):
                captured_ns = time.time_ns() - 15_000_000 * (5 - number)  # of different instants
                captured = replace(frame, capture_time_ns=captured_ns)
                assert await vehicle.told(captured) == ("ack", number)
                while len(reports) <= number:
                    await asyncio.sleep(0.001)
            async with asyncio.timeout(15):
                while '"objectId"' not in kept.read_text():
                    await asyncio.sleep(0.01)
            client.stop()
            await watching
    lines = [json.loads(line)["cpm"] for line in kept.read_text().splitlines()]
    assert {line["header"]["stationId"] for line in lines} == {42}
    position = lines[-1]["payload"]["managementContainer"]["referencePosition"]
    assert (position["latitude"], position["longitude"]) == (480000000, 110000000)
    told = [line["payload"]["cpmContainers"][1]["containerData"] for line in lines]
    one = next(each["perceivedObjects"][0] for each in told if each["perceivedObjects"])
    assert 200 < one["position"]["zCoordinate"]["value"] < 1200, "the cloud is at 2 to 8 m"
    assert -2048 < one["measurementDeltaTime"] < 0


@pytest.mark.parametrize(
    ("settings", "problem"),
    [
        ({"mcap": Path("x.mcap"), "encoding": "jpeg"}, "jpeg makes no video"),
        ({"pictures": 0}, "pictures: 0 must be at least 1"),
        ({"video": Path("x.mp4"), "encoding": "jpeg"}, "jpeg makes no video"),
        ({"folder": Path("x"), "encoding": "none"}, "leaves nothing to keep"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings: dict[str, Any], problem: str) -> None:
    with pytest.raises(InvalidInput, match=problem):
        WatchSettings(**settings)


def test_plaintext_to_another_machine_needs_permission() -> None:
    with pytest.raises(InvalidInput, match="not a loopback address"):
        TwinClient("example.org:1")
    TwinClient("example.org:1", allow_insecure=True).close()


async def at_most_consumers(server: Any, count: int) -> None:
    """Wait until the server has let go of consumers that left."""
    async with asyncio.timeout(30):
        while server.registry.get_sample_value("rfedge_twin_consumers") > count:
            await asyncio.sleep(0.01)


async def test_consumers_that_vanish_while_they_are_written_to_leave_no_traceback(
    serve: Any, raw_vehicle: Any, coded: Any, street: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    """Their connection closes while pictures, objects and views come; some have read one."""
    problems: list[Any] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, what: problems.append(what))
    view = ViewRequest(Camera(CAMERA, Pose.identity()), field_id=street.field_id)

    async def vanish(address: str, read: int) -> None:
        async with grpc.aio.insecure_channel(address) as channel:
            stub = twin_pb2_grpc.TwinServiceStub(channel)
            i420 = Subscription(encoding=PictureEncoding.I420)
            objects = objects_request_to_wire(ObjectsRequest(field_id=street.field_id))
            moving = stub.RenderStream()
            calls = [stub.Watch(subscription_to_wire(i420)), stub.Objects(objects), moving]
            await moving.write(twin_pb2.RenderStreamRequest(view=view_request_to_wire(view)))
            for call in calls[:read]:
                await call.read()

    async with serve() as server, raw_vehicle(server.address) as vehicle:
        await vehicle.greet(coded.hello)
        for number in range(12):
            if number < len(coded.frames):
                await vehicle.told(coded.frames[number])
            await vanish(str(server.address), number % 4)
            await at_most_consumers(server, 2)  # an identity may have 4
        await at_most_consumers(server, 0)
    gc.collect()
    await asyncio.sleep(0)
    assert not problems
    said = capfd.readouterr()
    assert "Traceback" not in said.out + said.err
