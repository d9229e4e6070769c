"""What one vehicle sees, another is told: real agents, a real server, a socket."""

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from cav_agent.config import AgentConfig, PaceKind
from cav_agent.vehicle import Vehicle
from mec_server.twin import contacts, rendering
from mec_server.twin.composition import LivePicture
from mec_server.twin.ground import FieldGround
from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.codec.h264.config import CoderSettings
from rfcore.codec.packet import DeltaPacket
from rfcore.native.yuv import field_view_from_view
from rfcore.wire.messages import Ack, Frame, Hello
from rfcore.wire.notices import FieldChange, FieldChangeKind, ObjectAhead, StreetNotice
from rfcore.wire.publish import Ground, publish
from rfcore.wire.tile_manifest import VersionLabel

NOW = datetime(2026, 1, 1, tzinfo=UTC)


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("LEAST_PX", "LEAST_COLUMNS", "LEAST_WIDTH_M", "LEAST_MARKED_M"):
        monkeypatch.setattr(contacts, name, 0)  # of a picture of 76x52
    monkeypatch.setattr(contacts, "MOST_SLOPE", 1.0)  # the field is a cloud, without ground


def as_vehicle(hello: Hello, name: str, *, takes: bool) -> Hello:
    return replace(hello, vehicle_id=name, take_notices=takes)


def bare_frame(street: Any, hello: Hello, pose: Pose) -> Frame:
    """A frame that shows the field as it is: its one reference, the render, and no slice."""
    intrinsics: Intrinsics = hello.cameras[0].intrinsics
    camera = Camera(intrinsics, pose)
    render = field_view_from_view(street.field.render(camera), camera).render
    digest = render.digest()
    packet = DeltaPacket(0, 0, digest, b"", digest, b"", 0).sealed()
    return Frame("front", 0, pose, bytes.fromhex(street.field_id)[:8], packet)


async def heard(vehicle: Any, notices: list[StreetNotice]) -> Ack:
    """Return the next answer of a stream; notices before it go to ``notices``."""
    while True:
        message = await vehicle.hear()
        if isinstance(message, StreetNotice):
            notices.append(message)
        else:
            assert isinstance(message, Ack)
            return message


@pytest.fixture
def looked_at(monkeypatch: pytest.MonkeyPatch) -> list[LivePicture]:
    """What the server has looked at so far."""
    pictures: list[LivePicture] = []
    find = rendering.find

    def noted(picture: LivePicture, ground: FieldGround) -> Any:
        found = find(picture, ground)
        pictures.append(picture)
        return found

    monkeypatch.setattr(rendering, "find", noted)
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
                for count, frame in enumerate(coded.frames, start=2):
                    await first.say(frame)
                    assert isinstance(await first.hear(), Ack), "who takes no notices gets none"
                    while len(looked_at) < count:
                        await asyncio.sleep(0.001)
                while not notices:
                    message = await second.hear()
                    assert isinstance(message, StreetNotice)
                    notices.append(message)
        value = server.registry.get_sample_value
        assert value("rfedge_twin_notices_total", {"kind": "object"}) >= 1
        assert value("rfedge_twin_notice_age_seconds_count") >= 1
        assert value("rfedge_twin_pictures_missed_total") == 0
        assert value("rfedge_server_task_failures_total", {"task": "notices"}) in (None, 0)
    ahead = notices[0].subject
    assert isinstance(ahead, ObjectAhead)
    assert (ahead.field_id, ahead.vehicles) == (street.field_id, 1)
    assert ahead.at_m[2] > 1


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
