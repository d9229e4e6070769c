"""Feeds from real files, sockets and a pseudo terminal."""

from __future__ import annotations

import asyncio
import os
import pty
import socket
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from cav_agent.pose_feed.feed import PoseFeed
from cav_agent.pose_feed.fix import FeedProblem
from cav_agent.pose_feed.sources import FeedKind, FeedSource, FeedTask
from lab.localisation.pose_feed import sentence
from rfcore.errors import InvalidInput

BODY = "GPGGA,2213{:02d}.0,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,"
DEADLINE_S = 20.0


def sentences(count: int, start: int = 0) -> bytes:
    return "".join(sentence(BODY.format(n)) for n in range(start, start + count)).encode()


class Reading:
    """A feed task that runs, and what it told."""

    def __init__(self, source: FeedSource) -> None:
        self.problems: list[FeedProblem] = []
        self.feed = PoseFeed(lambda problem, *_: self.problems.append(problem))
        self.changed = asyncio.Event()
        self.task = FeedTask(source, self.feed, time.time_ns, lambda _: self.changed.set())

    async def until(self, condition: Callable[[], bool]) -> None:
        """Wait for a condition that more bytes, or a problem, may make true."""
        async with asyncio.timeout(DEADLINE_S):
            while not condition():
                self.changed.clear()
                try:
                    async with asyncio.timeout(0.1):
                        await self.changed.wait()
                except TimeoutError:
                    continue


@asynccontextmanager
async def reading(source: FeedSource) -> AsyncIterator[Reading]:
    made = Reading(source)
    running = asyncio.create_task(made.task.run())
    try:
        yield made
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


async def test_a_file_is_read_to_its_end_even_without_a_last_line_break(tmp_path: Path):
    file = tmp_path / "drive.nmea"
    file.write_bytes(sentences(5)[:-2])
    made = Reading(FeedSource(FeedKind.FILE, file))
    await made.task.run()
    assert made.feed.count == 5
    assert set(made.problems) <= {FeedProblem.CLOCK}


async def test_a_file_that_is_not_there_ends_the_start(tmp_path: Path):
    with pytest.raises(OSError, match="nowhere"):
        await Reading(FeedSource(FeedKind.FILE, tmp_path / "nowhere")).task.run()
    with pytest.raises(InvalidInput, match="is no file"):
        await Reading(FeedSource(FeedKind.FILE, tmp_path)).task.run()


async def test_datagrams_are_read_as_they_come():
    async with reading(FeedSource(FeedKind.UDP, host="127.0.0.1")) as made:
        await asyncio.wait_for(made.task.opened.wait(), DEADLINE_S)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(sentences(1).strip(), made.task.address)
            sender.sendto(b"\xff noise", made.task.address)
            sender.sendto(sentences(2, 1), made.task.address)
            await made.until(lambda: made.feed.count == 3)
    assert FeedProblem.MALFORMED in made.problems


async def test_a_serial_line_is_read_and_tried_again_after_it_was_pulled():
    ours, theirs = pty.openpty()
    async with reading(FeedSource(FeedKind.SERIAL, Path(os.ttyname(theirs)))) as made:
        await asyncio.wait_for(made.task.opened.wait(), DEADLINE_S)
        for n in range(3):
            os.write(ours, sentences(1, n))
        await made.until(lambda: made.feed.count == 3)
        os.close(theirs)
        os.close(ours)
        await made.until(lambda: FeedProblem.LOST in made.problems)


async def test_a_path_that_is_no_serial_line_is_told(tmp_path: Path):
    file = tmp_path / "not-a-line"
    file.write_bytes(b"")
    async with reading(FeedSource(FeedKind.SERIAL, file)) as made:
        await made.until(lambda: FeedProblem.LOST in made.problems)
    assert made.feed.count == 0


async def test_gpsd_is_asked_to_report_and_connected_to_again():
    asked: list[bytes] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        asked.append(await reader.readline())
        writer.write(b'{"class":"VERSION","release":"3.25"}\r\n')
        second = len(asked)
        writer.write(
            b'{"class":"TPV","mode":3,"time":"2023-11-14T22:13:%02d.000Z","lat":48.1,"lon":11.5}\r\n'
            % second
        )
        await writer.drain()
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    async with server, reading(FeedSource(FeedKind.GPSD, host="127.0.0.1", port=port)) as made:
        await made.until(lambda: made.feed.count >= 2)
    assert asked[0].startswith(b'?WATCH={"enable":true')
    assert FeedProblem.LOST in made.problems


async def test_a_host_that_does_not_answer_is_told_and_does_no_harm():
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        port = unused.getsockname()[1]
        async with reading(FeedSource(FeedKind.GPSD, host="127.0.0.1", port=port)) as made:
            await made.until(lambda: FeedProblem.LOST in made.problems)
