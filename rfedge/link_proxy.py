"""``rfedge link``: a throughput-limited link between a real vehicle and a real server.

An asyncio TCP proxy around two ``rfcore.link`` machines, one a direction, shared by all
connections as one radio link would be. Sizes are wire bytes (HTTP/2 and all). Nothing is lost or
reordered; when a direction holds as much as it may, its senders are not read, and TCP tells them.

A release that is late makes the link look slower than it is. So the command sleeps with select(),
which is exact to the microsecond where epoll rounds up to milliseconds, and asks for a real-time
priority; the report says whether it got one and how late the latest release was. Beside two busy
processes on two cores the latest of 24 frames was 0.2 ms late with the priority and 13 ms without.
"""

from __future__ import annotations

import asyncio
import json
import os
import selectors
import signal
import socket
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rfcore.errors import RfedgeError
from rfcore.files import write_whole
from rfcore.link import LinkProfile
from rfcore.wire.address import Address
from rfedge.link_direction import Direction

__all__ = ["LinkProxy", "ProxySettings", "run_proxy"]

SEGMENT_BYTES = 4096
"""Bytes released at once: 8 ms at 4 Mbit/s, so that a long message does not arrive in one lump."""

SCHEDULERS = {os.SCHED_OTHER: "other", os.SCHED_FIFO: "fifo", os.SCHED_RR: "rr"}
READ_BYTES = 16 * 1024
SOCKET_BUFFER_BYTES = 64 * 1024


@dataclass(frozen=True)
class ProxySettings:
    """Where the link begins (``listen``) and ends (``to``), HOST:PORT, and what it is like.

    ``delay_ms`` is one-way, in either direction. ``report`` receives JSON after each connection and
    at the end; ``ready_file`` receives HOST:PORT once connections are accepted.
    """

    to: str
    listen: str = "127.0.0.1:0"
    uplink_bps: float = 4e6
    downlink_bps: float = 4e6
    delay_ms: float = 20.0
    report: Path | None = None
    ready_file: Path | None = None
    allow_insecure: bool = False

    def __post_init__(self) -> None:
        for field in ("listen", "to"):
            address = Address.parse(field, getattr(self, field))
            address.require_private(field, self.allow_insecure)
        for rate_bps in (self.uplink_bps, self.downlink_bps):
            self._profile(rate_bps)

    @property
    def uplink(self) -> LinkProfile:
        """The link from the accepting side to ``to``."""
        return self._profile(self.uplink_bps)

    @property
    def downlink(self) -> LinkProfile:
        """The link back."""
        return self._profile(self.downlink_bps)

    def _profile(self, rate_bps: float) -> LinkProfile:
        return LinkProfile(rate_bps, self.delay_ms / 1e3)


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
        self.go_on("peer")

    def hold(self, reason: str) -> None:
        """Stop reading until ``reason`` is gone."""
        if not self._held and self.transport is not None:
            self.transport.pause_reading()
        self._held.add(reason)

    def go_on(self, reason: str) -> None:
        """Read again if ``reason`` was the last one against it."""
        if self._held == {reason} and self.transport is not None:
            self.transport.resume_reading()
        self._held.discard(reason)

    def abort(self) -> None:
        """Close at once."""
        if self.transport is not None:
            self.transport.abort()

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
            self.peer.go_on("receiver")

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


class LinkProxy:
    """The proxy; ``start``, then ``stop``."""

    def __init__(self, settings: ProxySettings) -> None:
        self.address = Address.parse("listen", settings.listen)
        self._server_address = Address.parse("to", settings.to)
        self._settings = settings
        self._up = Direction(settings.uplink)
        self._down = Direction(settings.downlink)
        self._connections = 0
        self._tasks: set[asyncio.Task[None]] = set()
        self._listener: asyncio.Server | None = None

    async def start(self) -> Address:
        """Accept connections; return the address, with the port that was taken."""
        loop = asyncio.get_running_loop()
        try:
            self._listener = await loop.create_server(
                self._accept, self.address.host, self.address.port
            )
        except OSError as error:
            raise RfedgeError(f"cannot listen on {self.address}: {error}") from error
        sock = self._listener.sockets[0]
        self.address = Address(self.address.host, sock.getsockname()[1])
        for direction in (self._up, self._down):
            self._keep(asyncio.create_task(direction.pump()))
        if self._settings.ready_file is not None:
            write_whole(self._settings.ready_file, f"{self.address}\n")
        return self.address

    async def stop(self) -> None:
        """Close everything and write the report."""
        if self._listener is not None:
            self._listener.close()
        for sender in (*self._up.senders, *self._down.senders):
            sender.abort()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self.write_report()

    def report(self) -> dict[str, Any]:
        """Return what was measured so far."""
        return {
            "scheduler": SCHEDULERS.get(os.sched_getscheduler(0), "unknown"),
            "connections": self._connections,
            "uplink": self._up.report(),
            "downlink": self._down.report(),
        }

    def write_report(self) -> None:
        """Write the report, whole, if one was asked for."""
        if self._settings.report is not None:
            write_whole(self._settings.report, json.dumps(self.report(), indent=1) + "\n")

    def _accept(self) -> Side:
        side = Side(self._up, self.write_report)
        self._keep(asyncio.create_task(self._connect(side)))
        return side

    async def _connect(self, near: Side) -> None:
        """Open the far half of a new connection, or refuse the near one."""
        self._connections += 1
        loop = asyncio.get_running_loop()
        address = self._server_address
        try:
            _, far = await loop.create_connection(
                lambda: Side(self._down, self.write_report), address.host, address.port
            )
        except OSError:
            near.abort()
            return
        for side in (near, far):
            _bound_receive_buffer(side)
        near.join(far)
        far.join(near)

    def _keep(self, task: asyncio.Task[None]) -> None:
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)


def run_proxy(settings: ProxySettings) -> None:
    """Run the proxy until SIGTERM or SIGINT; raise ``RfedgeError`` if it cannot listen."""
    with suppress(PermissionError):  # the report names the scheduler that was granted
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    # select() sleeps to the microsecond where epoll rounds up to the next millisecond.
    loop = asyncio.SelectorEventLoop(selectors.SelectSelector())
    with asyncio.Runner(loop_factory=lambda: loop) as runner:
        runner.run(_run(settings))


async def _run(settings: ProxySettings) -> None:
    stopped = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stopped.set)
    proxy = LinkProxy(settings)
    await proxy.start()
    await stopped.wait()
    await proxy.stop()


def _bound_receive_buffer(side: Side) -> None:
    """Keep the kernel from hiding seconds of data behind the link's own queue."""
    if side.transport is not None:
        sock = side.transport.get_extra_info("socket")
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, SOCKET_BUFFER_BYTES)
