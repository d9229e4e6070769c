"""A vehicle is told what another one sees: real agents, a real server, a socket."""

import asyncio
import json
import threading
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import grpc
import pytest

from cav_agent.config import AgentConfig, PaceKind
from cav_agent.vehicle import Vehicle
from lab.world import EvalWorld
from lab.world.run import _ages_told_ms
from mec_server.twin import rendering
from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.codec.h264.config import CoderSettings
from rfcore.codec.packet import DeltaPacket
from rfcore.native.yuv import field_view_from_view
from rfcore.perception.composition import LivePicture
from rfcore.perception.ground import FieldGround
from rfcore.wire.conventions import CONSUMER_OPTIONS
from rfcore.wire.messages import Ack, Frame, Hello
from rfcore.wire.notices import FieldChange, FieldChangeKind, ObjectAhead, StreetNotice
from rfcore.wire.tile_manifest import Ground, VersionLabel, publish
from rfcore.wire.twin_render import ViewRequest, view_request_to_wire
from rfcore.wire.v1 import twin_pb2_grpc
from rfedge.loadtest.prerecorded import PrerecordedDrive

NOW = datetime(2026, 1, 1, tzinfo=UTC)


pytestmark = pytest.mark.usefixtures("small_things")


def as_vehicle(hello: Hello, name: str, *, takes: bool) -> Hello:
    return replace(hello, vehicle_id=name, take_notices=takes)


def bare_frame(street: Any, hello: Hello, pose: Pose) -> Frame:
    """A frame that shows the field as it is: its one reference, the render, and no slice."""
    intrinsics: Intrinsics = hello.cameras[0].intrinsics
    pose = pose.rounded()
    camera = Camera(intrinsics, pose)
    render = field_view_from_view(street.field.render(camera), camera).render
    digest = render.digest()
    packet = DeltaPacket(0, 0, digest[:2], b"", digest[:6], b"")
    return Frame("front", 0, pose, "", packet)


async def heard(vehicle: Any, notices: list[StreetNotice]) -> Ack:
    """Return the next answer of a stream; notices before it go to ``notices``."""
    while True:
        message = await vehicle.hear()
        if isinstance(message, StreetNotice):
            notices.append(message)
        else:
            assert isinstance(message, Ack)
            return message


async def shown_and_looked_at(
    vehicle: Any, frames: Sequence[Frame], looked_at: list[LivePicture]
) -> None:
    """Send frames, each once the one before was looked at; one of another vehicle was already."""
    for count, frame in enumerate(frames, start=2):
        await vehicle.say(frame)
        assert isinstance(await vehicle.hear(), Ack), "who takes no notices gets none"
        while len(looked_at) < count:
            await asyncio.sleep(0.001)


async def heard_notice(vehicle: Any, notices: list[StreetNotice]) -> None:
    """Return when there is a notice."""
    while not notices:
        message = await vehicle.hear()
        assert isinstance(message, StreetNotice)
        notices.append(message)


@pytest.fixture
def looked_at(monkeypatch: pytest.MonkeyPatch) -> list[LivePicture]:
    """Return the pictures that the server has looked at so far."""
    pictures: list[LivePicture] = []
    cut_out = rendering.cut_out

    def noted(picture: LivePicture, ground: FieldGround) -> Any:
        found = cut_out(picture, ground)
        pictures.append(picture)
        return found

    monkeypatch.setattr(rendering, "cut_out", noted)
    return pictures


async def test_what_one_vehicle_sees_another_is_told(
    street: Any, coded: Any, serve: Any, raw_vehicle: Any, looked_at: list[LivePicture]
) -> None:
    """The first vehicle's pictures have a red box. The second, four metres behind, sends one
    picture, of the bare field."""
    notices: list[StreetNotice] = []
    behind = Pose((0.0, 0.0, -4.0), (1.0, 0.0, 0.0, 0.0))
    async with serve() as server, raw_vehicle(server.address) as first:
        async with raw_vehicle(server.address) as second:
            await second.greet(as_vehicle(coded.hello, "second", takes=True))
            await first.greet(as_vehicle(coded.hello, "first", takes=False))
            await second.say(bare_frame(street, coded.hello, behind))
            await heard(second, notices)
            async with asyncio.timeout(20):
                await shown_and_looked_at(first, coded.frames, looked_at)
                await heard_notice(second, notices)
        value = server.registry.get_sample_value
        assert value("rfedge_twin_notices_total", {"kind": "object"}) >= 1
        assert value("rfedge_twin_notice_age_seconds_count") >= 1
        assert value("rfedge_twin_pictures_missed_total") == 0
        assert value("rfedge_server_task_failures_total", {"task": "notices"}) in (None, 0)
    ahead = notices[0].subject
    assert isinstance(ahead, ObjectAhead)
    assert (ahead.field_id, ahead.vehicles) == (street.field_id, 1)
    assert ahead.at_m[2] > 1


async def test_a_view_that_takes_long_holds_no_notice_back(
    street: Any,
    coded: Any,
    serve: Any,
    raw_vehicle: Any,
    looked_at: list[LivePicture],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    gate, begun, compose = threading.Event(), threading.Event(), rendering.compose

    def held_back(*args: Any) -> Any:
        begun.set()
        assert gate.wait(30)
        return compose(*args)

    monkeypatch.setattr(rendering, "compose", held_back)
    notices: list[StreetNotice] = []
    behind = Pose((0.0, 0.0, -1.0), (1.0, 0.0, 0.0, 0.0))
    camera = Camera(coded.hello.cameras[0].intrinsics, behind)
    request = view_request_to_wire(ViewRequest(camera, field_id=street.field_id))
    async with (
        serve() as server,
        grpc.aio.insecure_channel(str(server.address), options=CONSUMER_OPTIONS) as channel,
        raw_vehicle(server.address) as first,
        raw_vehicle(server.address) as second,
        asyncio.timeout(30),
    ):
        view = twin_pb2_grpc.TwinServiceStub(channel).Render(request)
        assert await asyncio.to_thread(begun.wait, 30)
        await second.greet(as_vehicle(coded.hello, "second", takes=True))
        await first.greet(as_vehicle(coded.hello, "first", takes=False))
        await second.say(bare_frame(street, coded.hello, behind))
        await heard(second, notices)
        await shown_and_looked_at(first, coded.frames, looked_at)
        await heard_notice(second, notices)
        assert not view.done()
        gate.set()
        await view


@asynccontextmanager
async def driving(vehicle: Vehicle) -> AsyncIterator[None]:
    task = asyncio.create_task(vehicle.run())
    try:
        yield
    finally:
        vehicle.stop()
        await task


@pytest.mark.parametrize(
    ("light", "kind"),
    [("", FieldChangeKind.MAP), ("dusk", FieldChangeKind.LIGHT)],
    ids=["map", "light"],
)
async def test_an_agent_hands_on_that_its_tile_has_another_map_or_light(
    street: Any, serve: Any, tmp_path: Path, light: str, kind: FieldChangeKind
) -> None:
    folder, path = tmp_path / "fields", tmp_path / "notices"
    folder.mkdir()
    publish(folder, "west", street.store / "street.rff", Ground(), NOW)
    taken: list[StreetNotice] = []
    async with serve(fields=folder) as server:
        config = AgentConfig(
            str(server.address),
            street.drive,
            tmp_path / "mine",
            loop=True,
            rate=5.0,
            pace=PaceKind.REALTIME,
            coding=CoderSettings(effort="fast"),
            notices=path,
        )
        async with asyncio.timeout(30), driving(Vehicle(config, taken.append)):
            while not path.exists():
                await asyncio.sleep(0.01)
            reader, writer = await asyncio.open_unix_connection(path)
            while server._edge.notice_takers() == []:
                await asyncio.sleep(0.01)
            label = VersionLabel(light)
            new = publish(folder, "west", street.other_store / "other.rff", Ground(), NOW, label)
            line = json.loads(await reader.readline())
            writer.close()
    field_id = new.lights[0].field_id if light else new.field_id
    assert field_id == street.other_id
    assert (line["kind"], line["tile"], line["field_id"]) == (str(kind), "west", field_id)
    change = FieldChange(kind, "west", field_id, 2, light)
    assert [notice.subject for notice in taken] == [change]


async def test_prerecorded_vehicles_tell_how_old_a_notice_is_when_it_arrives(
    street: Any, coded: Any, serve: Any, tmp_path: Path
) -> None:
    """The picture is sent at once, so that its age is that of a real vehicle's less its coding."""
    frames = tuple(coded.frames)
    bare = (bare_frame(street, coded.hello, Pose((0.0, 0.0, -1.0), (1.0, 0.0, 0.0, 0.0))),)
    seeing = PrerecordedDrive(coded.hello, frames, frames)
    told = PrerecordedDrive(coded.hello, bare, bare)
    asked = EvalWorld(work=tmp_path, notices_hz=4.0, seconds=3.0)
    async with serve() as server, asyncio.timeout(30):
        ages_ms = await _ages_told_ms(asked, str(server.address), seeing, told)
    assert ages_ms
    assert all(0 < age_ms < 3000 for age_ms in ages_ms)
