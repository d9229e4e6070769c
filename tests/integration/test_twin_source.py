"""A browser's user gets objects and views, beside pictures, from a real server."""

import asyncio
import itertools
import json
import struct
import time
import zlib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mec_server.ledger.budgets import Limit
from mec_server.tile_history import Learnt, TileHistory
from mec_server.twin import rendering
from mec_server.twin.rendering import ViewService
from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import LimitExceeded
from rfcore.image import rgb_from_bytes
from rfcore.wire.tile_manifest import Ground, VersionLabel, publish
from rfcore.wire.twin_client import AsyncTwinClient
from rfcore.wire.twin_render import ViewRequest
from rfedge.twin import server_source
from rfedge.twin.scene import Board, Message, TwinScene
from rfedge.twin.server_source import FIELD_ALONE, ServerSource

INTRINSICS = Intrinsics(76, 52, 50.0, 50.0, 38.0, 26.0)
NEAR = Camera(INTRINSICS, Pose.identity())
FAR = Camera(INTRINSICS, Pose((0.0, 0.0, -40.0), (1.0, 0.0, 0.0, 0.0)))


@pytest.fixture(autouse=True)
def views_have_the_usual_priority(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rendering, "VIEWS_NICE", 0)


class Browser:
    """The messages that a browser would be sent."""

    def __init__(self, board: Board) -> None:
        self.arrived = asyncio.Event()
        self.board = board
        self.reader = board.read(self.arrived.set)
        self.views: asyncio.Queue[Message] = asyncio.Queue()

    async def next(self, kind: str) -> dict[str, Any]:
        """Return the header of the next message of this kind that the board sends."""
        async with asyncio.timeout(30):
            while True:
                while (message := self.reader.take()) is not None:
                    data = message.encode(message.made_s)
                    (length,) = struct.unpack_from("<I", data)
                    header: dict[str, Any] = json.loads(data[4 : 4 + length])
                    if header["kind"] == kind:
                        return header
                self.arrived.clear()
                await self.arrived.wait()

    def board_keys(self) -> list[Any]:
        """Return what a browser that comes now would be shown."""
        return list(self.board._messages)

    async def view(self) -> Message:
        return await asyncio.wait_for(self.views.get(), 30)


@asynccontextmanager
async def following(server: Any, folder: Path) -> AsyncIterator[tuple[ServerSource, Browser]]:
    board = Board()
    source = ServerSource(AsyncTwinClient(str(server.address)), folder, TwinScene(board))
    browser = Browser(board)
    running = asyncio.create_task(source.run())
    try:
        await browser.next("fields")
        yield source, browser
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


async def test_a_live_view_follows_its_user_says_what_is_refused_and_goes_on(
    street: Any, coded: Any, serve: Any, raw_vehicle: Any, tmp_path: Path
) -> None:
    near = ViewRequest(NEAR, field_id=street.field_id, max_age_s=10.0)
    async with (
        serve() as server,
        raw_vehicle(server.address) as vehicle,
        following(server, tmp_path) as (source, browser),
    ):
        await vehicle.greet(coded.hello)
        await vehicle.told(coded.frames[0])
        view = source.open_view(browser.views.put_nowait)
        view.look(near)
        shown = await browser.view()
        assert shown.header["kind"] == "view"
        assert shown.header["field"] == street.field_id
        (camera,) = shown.header["cameras"]
        assert (camera["vehicle"], camera["camera"]) == ("cav-raw", "front")
        jpeg, deflated = shown.parts
        assert rgb_from_bytes(jpeg, "view").shape == (52, 76, 3)
        freshness = np.frombuffer(zlib.decompress(deflated), np.uint8)
        assert freshness.size == 52 * 76
        assert (freshness != FIELD_ALONE).mean() == pytest.approx(shown.header["live_share"])
        assert shown.header["live_share"] > 0.1
        assert (await browser.view()).header["kind"] == "view", "again, without being asked"

        view.look(replace(near, camera=FAR))
        while (told := (await browser.view()).header)["kind"] == "view":
            pass
        assert told["kind"] == "view_refused"
        assert "-40 is more than 5 m outside of the field" in told["problem"]
        view.look(near)
        assert (await browser.view()).header["kind"] == "view"
        view.look(None)


async def test_a_live_view_waits_as_told_and_goes_on(
    street: Any, serve: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a machine where a view takes more worker time than an identity has."""
    view, calls = ViewService.view, itertools.count()

    async def spent_at_first(*arguments: Any) -> Any:
        if next(calls) < 2:
            raise LimitExceeded(
                Limit.IDENTITY_WORKER_SECONDS, "more than 1 worker seconds a second", 0.01
            )
        return await view(*arguments)

    monkeypatch.setattr(ViewService, "view", spent_at_first)
    async with serve() as server, following(server, tmp_path) as (source, browser):
        live = source.open_view(browser.views.put_nowait)
        live.look(ViewRequest(NEAR, field_id=street.field_id))
        told = [(await browser.view()).header for _ in range(4)]
        live.close()
    assert [each["kind"] for each in told] == ["view_refused"] * 2 + ["view"] * 2
    assert "asked again in 0.0 s" in told[0]["problem"]


async def test_a_live_view_asks_for_half_of_the_time_that_views_take(
    street: Any, serve: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    view, spans = ViewService.view, []

    async def slow(*arguments: Any) -> Any:
        begun_s = time.monotonic()
        await asyncio.to_thread(time.sleep, 2 * server_source.VIEW_EVERY_S)  # rendering
        drawn = await view(*arguments)
        spans.append((begun_s, time.monotonic()))
        return drawn

    monkeypatch.setattr(ViewService, "view", slow)
    async with serve() as server, following(server, tmp_path) as (source, browser):
        live = source.open_view(browser.views.put_nowait)
        live.look(ViewRequest(NEAR, field_id=street.field_id))
        for _ in range(3):
            await browser.view()
        live.close()
    for (begun_s, ended_s), (next_s, _) in itertools.pairwise(spans):
        assert next_s - ended_s >= 0.95 * (ended_s - begun_s)


async def test_the_operator_sees_the_lights_of_a_tile_and_what_was_learnt(
    street: Any, serve: Any, tmp_path: Path
) -> None:
    fields, now = tmp_path / "fields", datetime(2026, 1, 1, tzinfo=UTC)
    fields.mkdir()
    publish(fields, "west", street.store / "street.rff", Ground(), now)
    label = VersionLabel("dusk", passes=2, time_of_day_h=18.5)
    publish(fields, "west", street.other_store / "other.rff", Ground(), now, label)
    learnt = Learnt(street.other_id, "dusk", street.field_id, 2, 53.0, 1_767_290_400_000)
    async with serve(fields=fields) as server:
        server._show_learnt({"west": TileHistory((learnt,)), "gone": TileHistory((learnt,))})
        board = Board()
        browser = Browser(board)
        client = AsyncTwinClient(str(server.address))
        source = ServerSource(client, tmp_path / "mine", TwinScene(board))
        running = asyncio.create_task(source.run())
        rows = (await browser.next("tiles"))["rows"]
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
    assert [(row["tile"], row["light"], row["version"]) for row in rows] == [
        ("west", "", 1),
        ("west", "dusk", 2),
    ]
    assert (rows[1]["passes"], rows[1]["time_of_day_h"], rows[1]["saved_ratio"]) == (2, 18.5, 0.53)
    assert rows[1]["learnt_ms"] == 1_767_290_400_000


async def test_a_view_without_a_server_says_so(tmp_path: Path) -> None:
    source = ServerSource(AsyncTwinClient("127.0.0.1:1"), tmp_path, TwinScene(Board()))
    told: asyncio.Queue[Message] = asyncio.Queue()
    source.open_view(told.put_nowait).look(ViewRequest(NEAR, field_id="0" * 64))
    message = await asyncio.wait_for(told.get(), 30)
    assert message.header == {
        "kind": "view_refused",
        "problem": "there is no connection to the server",
    }


async def test_objects_are_followed_while_somebody_shows_them(
    street: Any, coded: Any, serve: Any, raw_vehicle: Any, tmp_path: Path
) -> None:
    async with (
        serve() as server,
        raw_vehicle(server.address) as vehicle,
        following(server, tmp_path) as (source, browser),
    ):

        async def until_consumers(count: int) -> None:
            async with asyncio.timeout(30):
                while server.registry.get_sample_value("rfedge_twin_consumers") != count:
                    await asyncio.sleep(0)

        await vehicle.greet(coded.hello)
        await until_consumers(1)
        source.want_objects(True)
        await until_consumers(2)
        await vehicle.told(coded.frames[0])
        shown = await browser.next("objects")
        assert (shown["field"], shown["problem"]) == (street.field_id, "")
        source.want_objects(False)
        await until_consumers(1)
        assert not [key for key in browser.board_keys() if key[0] == "objects"]


async def test_objects_that_a_server_refuses_leave_the_reason(
    street: Any, serve: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nowhere = server_source.ObjectsRequest(tile="west")
    monkeypatch.setattr(server_source, "ObjectsRequest", lambda field_id: nowhere)  # noqa: ARG005
    async with serve() as server, following(server, tmp_path) as (source, browser):
        source.want_objects(True)
        shown = await browser.next("objects")
        assert shown["field"] == street.field_id
        assert "west" in shown["problem"]
