"""The options of a pose feed, and the task that reads its source.

A feed comes from a file, UDP, a serial line or gpsd. One task reads it, off the path of the frames,
and gives bytes to a ``PoseFeed``. A source that cannot be opened or breaks off is reported and
tried again; only a file that is missing ends the start with an error.
"""

from __future__ import annotations

import asyncio
import math
import os
import termios
from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing, suppress
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from cav_agent.pose_feed.feed import PoseFeed
from cav_agent.pose_feed.fix import CameraMount, FeedProblem
from rfcore.errors import InvalidInput

BAUDS = (4800, 9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600)
GPSD_PORT = 2947
RETRY_S = 1.0
IDLE_S = 0.5
CHUNK_BYTES = 1 << 16
MAX_FILE_BYTES = 1 << 28
WATCH = b'?WATCH={"enable":true,"json":true};\n'
MOST_WAITING = 1000
"""Chunks or datagrams not yet taken; more are lost, oldest first."""


class FeedKind(StrEnum):
    """The kind of a feed's source."""

    FILE = "file"
    UDP = "udp"
    SERIAL = "serial"
    GPSD = "gpsd"


@dataclass(frozen=True)
class FeedSource:
    """A parsed source: ``path`` of file and serial, ``host`` and ``port`` of UDP and gpsd."""

    kind: FeedKind
    path: Path = Path()
    host: str = ""
    port: int = 0
    baud: int = 9600


@dataclass(frozen=True)
class PoseFeedSettings:
    """The source of the vehicle's own poses, instead of the drive's."""

    pose_feed: str | None = None
    """GNSS as NMEA, gpsd's JSON, or JSON lines (docs/how-to/localise.md), from file:PATH,
    udp:HOST:PORT, serial:DEVICE:BAUD or gpsd:HOST:PORT. The drive's poses are then not used."""
    camera_at: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The camera seen from the feed's antenna: metres forward, left, up."""
    camera_turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Its rotation from looking forward: degrees of yaw left, pitch down, roll right."""
    feed_offset_s: float = 0.0
    """Add to the feed's times to get the camera's, seconds."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.feed_offset_s) and abs(self.feed_offset_s) < 1e9):
            raise InvalidInput("feed_offset_s", f"{self.feed_offset_s} is not below 1e9 s")
        _ = self.mount, self.source

    @property
    def mount(self) -> CameraMount:
        """Return where the camera is on the vehicle."""
        return CameraMount(self.camera_at, self.camera_turn)

    @property
    def source(self) -> FeedSource | None:
        """The source; None where no feed is configured."""
        return None if self.pose_feed is None else parse_source(self.pose_feed)


def parse_source(text: str) -> FeedSource:
    """Parse ``file:PATH`` and the like; raise ``InvalidInput`` for others."""
    kind, _, rest = text.partition(":")
    if kind == FeedKind.FILE and rest:
        return FeedSource(FeedKind.FILE, Path(rest))
    if kind == FeedKind.SERIAL and rest:
        device, _, baud = rest.partition(":")
        rate = _number(text, baud) if baud else 9600
        if rate not in BAUDS:
            raise InvalidInput("pose_feed", f"{rate} baud is none of {', '.join(map(str, BAUDS))}")
        return FeedSource(FeedKind.SERIAL, Path(device), baud=rate)
    if kind in (FeedKind.UDP, FeedKind.GPSD) and rest:
        host, colon, port = rest.rpartition(":")
        if not colon and kind == FeedKind.GPSD:
            host, port = rest, str(GPSD_PORT)
        number = _number(text, port)
        if host and 0 <= number <= 65535:
            return FeedSource(FeedKind(kind), host=host.strip("[]"), port=number)
    raise InvalidInput(
        "pose_feed",
        f"'{text}' is none of file:PATH, udp:HOST:PORT, serial:DEVICE:BAUD, gpsd:HOST:PORT",
    )


def _number(text: str, digits: str) -> int:
    if not (digits.isascii() and digits.isdecimal() and len(digits) <= 7):
        raise InvalidInput("pose_feed", f"'{text}' ends in '{digits}', not a number")
    return int(digits)


class FeedTask:
    """Reads one source into a feed until it is cancelled, or to the end of a file.

    ``on_fixes`` is called with the number of fixes each time that some were taken. ``address`` is
    where UDP is received, once ``opened`` is set.
    """

    def __init__(
        self,
        source: FeedSource,
        feed: PoseFeed,
        clock_ns: Callable[[], int],
        on_fixes: Callable[[int], None] = lambda _: None,
    ) -> None:
        self._source, self._feed = source, feed
        self._clock_ns, self._on_fixes = clock_ns, on_fixes
        self.opened = asyncio.Event()
        self.address: tuple[str, int] | None = None

    async def run(self) -> None:
        """Read; raise ``OSError`` or ``InvalidInput`` for a file that cannot be read."""
        if self._source.kind is FeedKind.FILE:
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
        self._on_fixes(await asyncio.to_thread(self._feed.receive, data, self._clock_ns()))
        self._feed.end(self._clock_ns())
        self.opened.set()

    async def _read_once(self) -> None:
        """Read a source until it breaks off; report that, and raise what it broke off with."""
        try:
            async with aclosing(self._chunks()) as chunks:
                async for data in chunks:
                    self._on_fixes(self._feed.receive(data, self._clock_ns()))
            raise EOFError("the source ended")
        except (OSError, EOFError) as error:
            text = f"{self._source.kind}: {error}; tried again"
            self._feed.problems.note(FeedProblem.LOST, text, self._clock_ns())
            raise

    def _chunks(self) -> AsyncGenerator[bytes, None]:
        if self._source.kind is FeedKind.UDP:
            return self._datagrams()
        if self._source.kind is FeedKind.SERIAL:
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
            lambda: DatagramQueue(received), local_addr=address
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


class DatagramQueue(asyncio.DatagramProtocol):
    """Queues datagrams; when nobody takes them, the oldest is lost."""

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
