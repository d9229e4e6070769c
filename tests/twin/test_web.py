"""The page opens for those who may see it, and a slow browser delays nobody."""

from __future__ import annotations

import asyncio
import json
import struct
from collections.abc import AsyncIterator, Callable
from concurrent.futures import Executor
from contextlib import asynccontextmanager, suppress
from typing import Any
from unittest.mock import Mock

import aiohttp
import pytest
from yarl import URL

from rfcore.errors import InvalidInput
from rfcore.field import SplatField
from rfcore.wire.address import Address
from rfcore.wire.twin_render import ViewRequest
from rfedge.twin import web as module
from rfedge.twin.comparing import Comparer
from rfedge.twin.scene import Board, Message, PlacedField, TwinScene
from rfedge.twin.web import Look, Select, ShowObjects, TwinWeb, WebSettings, wish
from wall_scene import seen

TOKEN = "correct-horse-battery"


class Site:
    """A page that is served, and a browser's session with it."""

    def __init__(self, url: str, session: aiohttp.ClientSession, board: Board) -> None:
        self.url = url.partition("?")[0]
        self.session = session
        self.board = board
        self.scene = TwinScene(board)
        self.comparer = Comparer(self.scene, Mock(Executor))

    def socket(self, **headers: str) -> Any:
        origin = {"Origin": self.url.rstrip("/"), **headers}
        return self.session.ws_connect(f"{self.url}socket", headers=origin, max_msg_size=0)


@asynccontextmanager
async def site(token: str | None = None, live: Any = None) -> AsyncIterator[Site]:
    board = Board()
    made = Site("", Mock(aiohttp.ClientSession), board)
    web = TwinWeb(
        WebSettings(Address("127.0.0.1", 0), token),
        board,
        made.scene,
        made.comparer,
        lambda: 0.0,
        live,
    )
    made.url = (await web.start()).partition("?")[0]
    async with aiohttp.ClientSession() as session:
        made.session = session
        try:
            yield made
        finally:
            await web.stop()


def header_of(data: bytes) -> dict[str, Any]:
    (length,) = struct.unpack_from("<I", data)
    header: dict[str, Any] = json.loads(data[4 : 4 + length])
    return header


async def test_the_page_and_its_parts_are_there() -> None:
    async with site() as made:
        for path in ("", "page/app.js", "page/vendor/three.module.min.js"):
            async with made.session.get(made.url + path) as response:
                assert response.status == 200
                assert "frame-ancestors 'none'" in response.headers["Content-Security-Policy"]
        async with made.session.get(made.url + "page/../web.py") as response:
            assert response.status == 404


async def test_without_the_token_nothing_is_given() -> None:
    async with site(TOKEN) as made:
        for path in ("", "page/app.js", "socket", "?token=wrong-horse-battery"):
            async with made.session.get(made.url + path) as response:
                assert response.status == 403
        async with made.session.get(f"{made.url}?token={TOKEN}") as response:
            assert response.status == 200
            assert "httponly" in response.headers["Set-Cookie"].lower()
        cookies = {"rfedge-twin": TOKEN}
        async with aiohttp.ClientSession(cookies=cookies) as session:
            assert (await session.get(made.url + "page/app.js")).status == 200


async def test_health_is_told_without_the_token_and_nothing_else() -> None:
    async with site(TOKEN) as made, made.session.get(made.url + "healthy") as response:
        assert (response.status, await response.text()) == (200, "ok\n")


async def test_health_gives_no_cookie_and_a_cookie_of_other_bytes_is_wrong() -> None:
    async with site(TOKEN) as made:
        async with made.session.get(f"{made.url}healthy?token=x") as response:
            assert "Set-Cookie" not in response.headers
        reader, writer = await asyncio.open_connection("127.0.0.1", URL(made.url).port)
        writer.write(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nCookie: rfedge-twin=\xff\r\n\r\n")
        assert b" 403 " in await reader.readline()
        writer.close()


async def test_connections_that_ask_nothing_are_closed_and_so_are_those_beyond_the_limit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "MAX_CONNECTIONS", 3)
    monkeypatch.setattr(module, "FIRST_REQUEST_S", 1.0)
    async with site() as made, asyncio.timeout(15):
        port = URL(made.url).port
        halves = [await asyncio.open_connection("127.0.0.1", port) for _ in range(3)]
        for _, writer in halves:
            writer.write(b"GET / HTTP/1.1\r\n")
        fourth, spare = await asyncio.open_connection("127.0.0.1", port)
        assert await fourth.read() == b"", "closed at once"
        spare.close()
        for reader, writer in halves:
            with suppress(ConnectionError):
                assert await reader.read() == b"", "closed when its time is over"
            writer.close()
        async with made.session.get(made.url) as response:
            assert response.status == 200


async def test_a_foreign_name_for_this_machine_is_refused() -> None:
    async with site() as made:
        headers = {"Host": "evil.example"}
        async with made.session.get(made.url, headers=headers) as response:
            assert response.status == 403


async def test_another_sites_script_gets_no_socket() -> None:
    async with site() as made:
        with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
            async with made.socket(Origin="http://evil.example"):
                pass


async def test_a_browser_is_sent_what_is_shown_and_what_comes(wall: SplatField) -> None:
    async with site() as made:
        made.scene.place(PlacedField(wall, "tile", b"splats"), 0.0)
        async with made.socket() as socket:
            assert header_of(await socket.receive_bytes(timeout=5))["kind"] == "fields"
            made.scene.show(seen(wall), 0.0)
            data = await socket.receive_bytes(timeout=5)
            assert header_of(data)["vehicle"] == "cav-1"
            assert data.endswith(seen(wall).picture)
        async with made.session.get(f"{made.url}splats/{wall.field_id}.spz") as response:
            assert await response.read() == b"splats"
        async with made.session.get(f"{made.url}splats/{'0' * 64}.spz") as response:
            assert response.status == 404


async def test_what_a_user_looks_at_is_compared_until_the_browser_goes(wall: SplatField) -> None:
    async with site() as made:
        made.scene.place(PlacedField(wall, "tile", b""), 0.0)
        made.scene.show(seen(wall), 0.0)
        made.comparer.began(seen(wall), 0.0)
        made.scene.show(seen(wall, sequence=1), 0.0)

        async def until(is_due: bool) -> None:
            async with asyncio.timeout(5):
                while (made.comparer.due(0.0) is not None) != is_due:
                    await asyncio.sleep(0.01)

        async with made.socket() as socket:
            await socket.send_str(json.dumps({"select": ["cav-1", "front"]}))
            await until(True)
            await socket.send_str(json.dumps({"select": None}))
            await until(False)
            await socket.send_str(json.dumps({"select": ["cav-1", "front"]}))
            await until(True)
        await until(False)


async def test_a_browser_that_reads_nothing_delays_nobody() -> None:
    async with site() as made, made.socket() as slow, made.socket() as quick:
        assert not slow.closed
        part = bytes(1 << 20)
        for number in range(64):  # far more than the sockets of both ends hold
            made.board.post("a", Message({"number": number}, 0.0, (part,)))
            async with asyncio.timeout(5):
                while header_of(await quick.receive_bytes())["number"] != number:
                    pass


PLACE = {
    "field": "ab" * 32,
    "translation_m": [1.0, 2.0, 3.0],
    "rotation_wxyz": [1.0, 0.0, 0.0, 0.0],
    "intrinsics": {
        "width_px": 640,
        "height_px": 360,
        "fx_px": 400.0,
        "fy_px": 400.0,
        "cx_px": 320.0,
        "cy_px": 180.0,
    },
}


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        '{"select": 1}',
        '{"other": null}',
        '{"select": [1, 2]}',
        '{"select": null, "look": null}',
        '{"objects": 1}',
        json.dumps({"look": {**PLACE, "field": "../etc"}}),
        json.dumps({"look": {**PLACE, "rotation_wxyz": [2, 0, 0, 0]}}),
        json.dumps({"look": {**PLACE, "translation_m": 1}}),
        json.dumps({"look": {**PLACE, "translation_m": ["a", 0, 0]}}),
        json.dumps({"look": {**PLACE, "intrinsics": {"width_px": 1}}}),
        json.dumps({"look": {"field": "ab" * 32}}),
        json.dumps({"look": {**PLACE, "translation_m": [10**400, 0, 0]}}),
        json.dumps({"look": {**PLACE, "intrinsics": {**PLACE["intrinsics"], "width_px": 64.5}}}),
        '{"look": ' + "[" * 1500 + "]" * 1500 + "}",
    ],
)
def test_what_the_page_never_says_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"."):
        wish(text)


def test_what_the_page_says_is_understood() -> None:
    assert wish('{"select": null}') == Select(None)
    assert wish('{"select": ["cav-1", "front"]}') == Select(("cav-1", "front"))
    assert wish('{"objects": true}') == ShowObjects(True)
    assert wish('{"look": null}') == Look(None)
    asked = wish(json.dumps({"look": PLACE}))
    assert isinstance(asked, Look)
    assert asked.request is not None
    assert asked.request.field_id == PLACE["field"]
    assert asked.request.camera.world_from_cam.translation_m == (1.0, 2.0, 3.0)
    assert asked.request.camera.intrinsics.fx_px == 400.0


class Asked:
    """A source that notes what is asked of it, and shows one view."""

    def __init__(self) -> None:
        self.said: list[object] = []

    def open_view(self, tell: Callable[[Message], None]) -> Asked:
        self._tell = tell
        return self

    def look(self, request: ViewRequest | None) -> None:
        self.said.append(request and request.field_id)
        self._tell(Message({"kind": "view"}, 0.0, (b"jpeg", b"freshness")))

    def close(self) -> None:
        self.said.append("closed")

    def want_objects(self, wanted: bool) -> None:
        self.said.append(wanted)


async def test_a_browsers_view_and_objects_are_its_own_and_end_with_it() -> None:
    live = Asked()
    async with site(live=live) as made:
        async with made.socket() as other, made.socket() as socket:
            abilities = header_of(await socket.receive_bytes(timeout=5))
            assert (abilities["kind"], abilities["live"]) == ("abilities", True)
            for said in ({"objects": True}, {"objects": True}, {"look": PLACE}):
                await socket.send_str(json.dumps(said))
            view = await socket.receive_bytes(timeout=5)
            assert header_of(view)["kind"] == "view"
            assert view.endswith(b"jpegfreshness")
            assert live.said == [True, PLACE["field"]]
            await socket.close()
            made.board.post("a", Message({"kind": "news"}, 0.0))
            kinds = [header_of(await other.receive_bytes(timeout=5))["kind"] for _ in range(2)]
            assert kinds == ["abilities", "news"], "nothing of another browser's view"
        async with asyncio.timeout(5):
            while live.said.count("closed") < 2:
                await asyncio.sleep(0)
    assert live.said == [True, PLACE["field"], False, "closed", "closed"]


@pytest.mark.parametrize(
    ("host", "token", "problem"),
    [("0.0.0.0", None, "give a token"), ("127.0.0.1", "short", "5 characters, fewer than 16")],
)
def test_a_page_for_everybody_needs_a_token_worth_the_name(
    host: str, token: str | None, problem: str
) -> None:
    with pytest.raises(InvalidInput, match=problem):
        WebSettings(Address(host, 8080), token)
