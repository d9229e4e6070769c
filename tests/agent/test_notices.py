"""The socket on which an agent hands notices to other programs."""

import asyncio
import json
import socket
import stat
from pathlib import Path
from typing import Any

import pytest

from cav_agent import notices
from cav_agent.notices import NoticeSocket, notice_line
from rfcore.errors import InvalidInput
from rfcore.wire.notices import FieldChange, FieldChangeKind, ObjectAhead, StreetNotice

FIELD = "ab" * 32
AHEAD = ObjectAhead(FIELD, (1.0, 2.0, 0.0), (0.0, -4.0, 0.0), 1.8, 1.4, 20.0, 0.75, 2.0, 0.1, 2)
OBJECT = StreetNotice(3, 1.0, AHEAD)
LIGHT = StreetNotice(
    4, 600.0, FieldChange(FieldChangeKind.LIGHT, "west", FIELD, version=2, light="dusk")
)


async def readers_are(told: NoticeSocket, count: int) -> None:
    async with asyncio.timeout(10):
        while len(told._readers) != count:
            await asyncio.sleep(0.001)


async def test_every_reader_gets_a_line_for_each_notice(tmp_path: Path) -> None:
    path = tmp_path / "notices"
    async with NoticeSocket(path) as told:
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        pairs = [await asyncio.open_unix_connection(path) for _ in range(2)]
        await readers_are(told, 2)
        told.send(OBJECT)
        told.send(LIGHT)
        for reader, writer in pairs:
            first, second = [json.loads(await reader.readline()) for _ in range(2)]
            assert first == json.loads(json.dumps(notice_line(OBJECT, first["received_ns"])))
            assert (first["kind"], first["at_m"], first["unseen_s"]) == ("object", [1, 2, 0], 0.1)
            assert (second["kind"], second["light"], second["notice_id"]) == ("light", "dusk", 4)
            writer.close()
        await readers_are(told, 0)
        told.send(OBJECT)
    assert not path.exists()


async def test_a_reader_that_does_not_read_is_let_go_and_the_others_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(notices, "MAX_UNREAD_BYTES", 4096)
    path = tmp_path / "notices"
    async with NoticeSocket(path) as told:
        lazy = socket.socket(socket.AF_UNIX)
        lazy.connect(str(path))
        reader, writer = await asyncio.open_unix_connection(path)
        await readers_are(told, 2)
        lines = 0
        while len(told._readers) == 2:
            told.send(OBJECT)
            assert json.loads(await reader.readline())["notice_id"] == 3
            lines += 1
            assert lines < 100_000
        told.send(LIGHT)
        assert json.loads(await reader.readline())["notice_id"] == 4
        writer.close()
        lazy.close()


async def test_more_readers_than_may_be_are_turned_away(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(notices, "MOST_READERS", 1)
    async with NoticeSocket(tmp_path / "notices") as told:
        _, first = await asyncio.open_unix_connection(tmp_path / "notices")
        await readers_are(told, 1)
        reader, second = await asyncio.open_unix_connection(tmp_path / "notices")
        assert await reader.read() == b""
        assert len(told._readers) == 1
        first.close()
        second.close()


async def test_a_socket_that_was_left_behind_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "notices"
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    async with NoticeSocket(path) as told:
        _, writer = await asyncio.open_unix_connection(path)
        await readers_are(told, 1)
        writer.close()


def a_file(path: Path) -> Any:
    path.write_text("mine")


def a_listener(path: Path) -> Any:
    listening = socket.socket(socket.AF_UNIX)
    listening.bind(str(path))
    listening.listen()
    return listening


@pytest.mark.parametrize(
    ("occupy", "problem"),
    [(a_file, "exists and is no socket"), (a_listener, "another program listens")],
)
async def test_a_path_that_is_taken_is_left_alone(
    tmp_path: Path, occupy: Any, problem: str
) -> None:
    path = tmp_path / "notices"
    holder = occupy(path)
    with pytest.raises(InvalidInput, match=problem):
        async with NoticeSocket(path):
            pytest.fail("it listens")
    assert path.exists()
    if holder is not None:
        holder.close()


async def test_a_path_that_no_socket_can_have_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="more than 107 bytes"):
        async with NoticeSocket(tmp_path / ("n" * 120)):
            pytest.fail("it listens")
