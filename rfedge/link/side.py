"""One end of one connection through the link, as an asyncio protocol of ``rfedge.link.proxy``."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable

from rfedge.link.direction import Direction

__all__ = ["Side"]

SEGMENT_BYTES = 4096
"""Bytes released at once: 8 ms at 4 Mbit/s, so that a long message does not arrive in one lump."""

READ_BYTES = 16 * 1024
SOCKET_BUFFER_BYTES = 64 * 1024


class Side(asyncio.BufferedProtocol):
    """One end of one connection: what it sends goes into ``outward``, to ``peer``."""

    def __init__(self, outward: Direction, ended: Callable[[], None]) -> None:
        self.peer: Side | None = None
        self.transport: asyncio.Transport | None = None
        self._outward = outward
        self._ended = ended
        self._buffer = bytearray(READ_BYTES)
        self._held: set[str] = set()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Wait for the other end before reading anything; asyncio has set TCP_NODELAY."""
        assert isinstance(transport, asyncio.Transport)
        self.transport = transport
        transport.set_write_buffer_limits(SOCKET_BUFFER_BYTES)
        self._outward.senders.add(self)
        self.hold("peer")

    def join(self, peer: Side) -> None:
        """Send what comes in here to ``peer``."""
        self.peer = peer
        self.resume("peer")

    def hold(self, reason: str) -> None:
        """Stop reading until ``reason`` is gone."""
        if not self._held and self.transport is not None:
            self.transport.pause_reading()
        self._held.add(reason)

    def resume(self, reason: str) -> None:
        """Read again if ``reason`` was the last one against it."""
        if self._held == {reason} and self.transport is not None:
            self.transport.resume_reading()
        self._held.discard(reason)

    def abort(self) -> None:
        """Close at once."""
        if self.transport is not None:
            self.transport.abort()

    @property
    def is_open(self) -> bool:
        """Whether the socket is connected and nobody closes it."""
        return self.transport is not None and not self.transport.is_closing()

    def bound_receive_buffer(self) -> None:
        """Keep the kernel from hiding seconds of data behind the link's own queue."""
        if self.transport is not None:
            sock = self.transport.get_extra_info("socket")
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, SOCKET_BUFFER_BYTES)

    def get_buffer(self, sizehint: int) -> memoryview:  # noqa: ARG002
        """Offer no more than the link has room for."""
        return memoryview(self._buffer)[: max(1, min(READ_BYTES, self._outward.room_bytes))]

    def buffer_updated(self, nbytes: int) -> None:
        """Push what came in, in segments."""
        data = bytes(self._buffer[:nbytes])
        for start in range(0, nbytes, SEGMENT_BYTES):
            segment = data[start : start + SEGMENT_BYTES]
            self._outward.push(lambda part=segment: self._deliver(part), len(segment))  # type: ignore[misc]

    def eof_received(self) -> bool:
        """Pass the end on behind the data; keep our own direction open."""
        self._outward.push(self._deliver_end, 0)
        return True

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002
        """Take the other end down too, after what is under way."""
        self._outward.senders.discard(self)
        self._outward.push(self._close_peer, 0)
        self._ended()

    def pause_writing(self) -> None:
        """Our socket does not take more: the other end shall not send more."""
        if self.peer is not None:
            self.peer.hold("receiver")

    def resume_writing(self) -> None:
        """Our socket takes data again."""
        if self.peer is not None:
            self.peer.resume("receiver")

    def _deliver(self, data: bytes) -> None:
        if self.peer is not None and self.peer.transport is not None:
            self.peer.transport.write(data)

    def _deliver_end(self) -> None:
        transport = self.peer.transport if self.peer is not None else None
        if transport is not None and transport.can_write_eof() and not transport.is_closing():
            transport.write_eof()

    def _close_peer(self) -> None:
        if self.peer is not None and self.peer.transport is not None:
            self.peer.transport.close()
