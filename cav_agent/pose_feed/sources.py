"""Reading a pose feed: file, UDP, serial line, gpsd; off the path of the frames.

One task reads and gives bytes to a ``PoseFeed``. A source that cannot be opened or breaks off is
told and tried again; only a file that is not there ends the start with an error.
"""

from __future__ import annotations

import asyncio
import os
import termios
from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing, suppress
from pathlib import Path

from cav_agent.pose_feed.feed import PoseFeed
from cav_agent.pose_feed.fix import FeedProblem
from cav_agent.pose_feed.settings import FeedSource, SourceKind
from rfcore.errors import InvalidInput

__all__ = ["FeedTask"]

RETRY_S = 1.0
IDLE_S = 0.5
CHUNK_BYTES = 1 << 16
MAX_FILE_BYTES = 1 << 28
WATCH = b'?WATCH={"enable":true,"json":true};\n'
MOST_WAITING = 1000
"""Chunks or datagrams not yet taken; more are lost, oldest first."""


class FeedTask:
    """Reads one source into a feed until it is cancelled, or to the end of a file.

    ``heard`` is called after fixes were taken, with their number. ``address`` is where UDP is
    received, once ``opened`` is set.
    """

    def __init__(
        self,
        source: FeedSource,
        feed: PoseFeed,
        clock_ns: Callable[[], int],
        heard: Callable[[int], None] = lambda _: None,
    ) -> None:
        self._source, self._feed = source, feed
        self._clock_ns, self._heard = clock_ns, heard
        self.opened = asyncio.Event()
        self.address: tuple[str, int] | None = None

    async def run(self) -> None:
        """Read; raise ``OSError`` or ``InvalidInput`` for a file that cannot be read."""
        if self._source.kind is SourceKind.FILE:
            await self._read_file(self._source.path)
            return
        watching = asyncio.create_task(self._watch())
        try:
            while True:
                with suppress(OSError, EOFError):
                    await self._read_once()
                self.opened.clear()
                await asyncio.sleep(RETRY_S)
        finally:
            watching.cancel()
            await asyncio.gather(watching, return_exceptions=True)

    async def _read_file(self, path: Path) -> None:
        size = path.stat().st_size
        if not path.is_file() or size > MAX_FILE_BYTES:
            raise InvalidInput("pose_feed", f"{path} is no file of at most {MAX_FILE_BYTES} bytes")
        data = await asyncio.to_thread(path.read_bytes)
        self._heard(await asyncio.to_thread(self._feed.receive, data, self._clock_ns()))
        self._feed.end(self._clock_ns())
        self.opened.set()

    async def _read_once(self) -> None:
        """Read a source until it breaks off, which is told; raises what it broke off with."""
        try:
            async with aclosing(self._chunks()) as chunks:
                async for data in chunks:
                    self._heard(self._feed.receive(data, self._clock_ns()))
            raise EOFError("the source ended")
        except (OSError, EOFError) as error:
            text = f"{self._source.kind}: {error}; tried again"
            self._feed.problems.note(FeedProblem.LOST, text, self._clock_ns())
            raise

    def _chunks(self) -> AsyncGenerator[bytes, None]:
        if self._source.kind is SourceKind.UDP:
            return self._datagrams()
        if self._source.kind is SourceKind.SERIAL:
            return self._serial()
        return self._gpsd()

    async def _watch(self) -> None:
        while True:
            self._feed.idle(self._clock_ns())
            await asyncio.sleep(IDLE_S)

    async def _datagrams(self) -> AsyncGenerator[bytes, None]:
        received: asyncio.Queue[bytes] = asyncio.Queue(MOST_WAITING)
        address = (self._source.host, self._source.port)
        loop = asyncio.get_running_loop()
        transport, _ = await loop.create_datagram_endpoint(
            lambda: _Receiver(received), local_addr=address
        )
        try:
            self.address = transport.get_extra_info("sockname")[:2]
            self.opened.set()
            while True:
                yield await received.get() + b"\n"
        finally:
            transport.close()

    async def _serial(self) -> AsyncGenerator[bytes, None]:
        descriptor = _open_serial(self._source.path, self._source.baud)
        loop = asyncio.get_running_loop()
        readable = asyncio.Event()
        loop.add_reader(descriptor, readable.set)
        try:
            self.opened.set()
            while True:
                await readable.wait()
                readable.clear()
                try:
                    data = os.read(descriptor, CHUNK_BYTES)
                except BlockingIOError:
                    continue
                if not data:
                    return
                yield data
        finally:
            loop.remove_reader(descriptor)
            os.close(descriptor)

    async def _gpsd(self) -> AsyncGenerator[bytes, None]:
        reader, writer = await asyncio.open_connection(self._source.host, self._source.port)
        try:
            writer.write(WATCH)
            await writer.drain()
            self.opened.set()
            while data := await reader.read(CHUNK_BYTES):
                yield data
        finally:
            writer.close()


class _Receiver(asyncio.DatagramProtocol):
    """Queues datagrams; where nobody takes them, the oldest is lost."""

    def __init__(self, received: asyncio.Queue[bytes]) -> None:
        self._received = received

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:  # noqa: ARG002
        if self._received.full():
            self._received.get_nowait()
        self._received.put_nowait(data)


def _open_serial(path: Path, baud: int) -> int:
    """Return a descriptor of a serial line, raw, 8N1, that does not block."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        settings = termios.tcgetattr(descriptor)
        speed = getattr(termios, f"B{baud}")
        settings[0] = settings[1] = settings[3] = 0  # no translation of input or output, no echo
        settings[2] = termios.CS8 | termios.CREAD | termios.CLOCAL
        settings[4] = settings[5] = speed
        termios.tcsetattr(descriptor, termios.TCSANOW, settings)
    except termios.error as error:
        os.close(descriptor)
        raise OSError(f"{path} is no serial line ({error})") from error
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor
