"""``rfedge link``: a throughput-limited link between a real vehicle and a real server.

An asyncio TCP proxy around two ``rfcore.link`` machines, one a direction, shared by all
connections as one radio link would be. Sizes are wire bytes (HTTP/2 and all). Nothing is lost or
reordered; when a direction holds as much as it may, its senders are not read, so TCP slows them.

A release that is late makes the link look slower than it is. So the command sleeps with select(),
which is exact to the microsecond where epoll rounds up to milliseconds, and requests a real-time
priority; the report says whether it was granted and how late the latest release was. Beside two
busy processes on two cores the latest of 24 frames was 0.2 ms late with the priority and 13 ms
without.

``Side`` is one end of one connection through the link, as an asyncio protocol.
"""

from __future__ import annotations

import asyncio
import json
import os
import selectors
import signal
import socket
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from prometheus_client import CollectorRegistry

from rfcore.errors import InvalidInput, RfedgeError
from rfcore.files import write_whole
from rfcore.link.plan import DirectionPlan, LinkPlan, read_link
from rfcore.link.shaper import LinkProfile
from rfcore.wire.address import Address
from rfcore.wire.instruments import MetricsEndpoint
from rfedge.link.direction import SPIN_S, Direction, LinkMetrics

__all__ = ["LinkProxy", "ProxySettings", "Side", "run_proxy"]

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
        """Return whether the socket is connected and not being closed."""
        return self.transport is not None and not self.transport.is_closing()

    def bound_receive_buffer(self) -> None:
        """Limit the kernel's buffer, which would hide seconds of data behind the link's queue."""
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
        """Stop the other end, since our socket takes no more."""
        if self.peer is not None:
            self.peer.hold("receiver")

    def resume_writing(self) -> None:
        """Let the other end go on, since our socket takes data again."""
        if self.peer is not None:
            self.peer.resume("receiver")

    def _deliver(self, data: bytes) -> None:
        if self.peer is not None and self.peer.transport is not None:
            self.peer.transport.write(data)

    def _deliver_end(self) -> None:
        transport = self.peer.transport if self.peer is not None else None
        if transport is not None and transport.can_write_eof() and not transport.is_closing():
            with suppress(OSError):  # the other end is gone, and the event loop did not hear of it
                transport.write_eof()

    def _close_peer(self) -> None:
        if self.peer is not None and self.peer.transport is not None:
            self.peer.transport.close()


DEFAULT_BPS = 4e6
DEFAULT_DELAY_MS = 20.0

SCHEDULERS = {os.SCHED_OTHER: "other", os.SCHED_FIFO: "fifo", os.SCHED_RR: "rr"}


@dataclass(frozen=True)
class ProxySettings:
    """The ends of the link (``listen`` and ``to``), HOST:PORT, and its properties.

    ``also`` has further paths over the same link, LISTEN=TO each. ``profile`` is a link profile in
    a file; without it a constant rate and ``delay_ms`` one way, in either direction. ``report``
    receives JSON after each connection and at the end; ``ready_file`` receives HOST:PORT (of the
    first path) once connections are accepted. ``metrics_port``: port 0 takes a free one; no metrics
    are served without it. ``spin_s``: see ``rfedge.link.direction``.
    """

    to: str
    listen: str = "127.0.0.1:0"
    also: tuple[str, ...] = ()
    uplink_bps: float | None = None
    downlink_bps: float | None = None
    delay_ms: float | None = None
    profile: Path | None = None
    metrics_port: int | None = None
    metrics_host: str = "127.0.0.1"
    report: Path | None = None
    ready_file: Path | None = None
    allow_insecure: bool = False
    spin_s: float = SPIN_S

    def __post_init__(self) -> None:
        for listen, to in self.paths():
            listen.require_private("listen", self.allow_insecure)
            to.require_private("to", self.allow_insecure)
        if self.metrics_port is not None and not 0 <= self.metrics_port <= 65535:
            raise InvalidInput("metrics_port", f"{self.metrics_port} is outside 0..65535")
        if self.profile is None:
            self.plan()
        for name in ("uplink_bps", "downlink_bps", "delay_ms"):
            if self.profile is not None and getattr(self, name) is not None:
                raise InvalidInput(name, f"is given beside the profile {self.profile}; give one")

    def paths(self) -> list[tuple[Address, Address]]:
        """Return where to listen for what, the path of ``listen`` and ``to`` first."""
        paths = [(Address.parse("listen", self.listen), Address.parse("to", self.to))]
        for text in self.also:
            listen, _, to = text.partition("=")
            paths.append((Address.parse("also", listen), Address.parse("also", to)))
        return paths

    def plan(self) -> LinkPlan:
        """Return what the link is made of; raise what reading ``profile`` raises."""
        if self.profile is not None:
            return read_link(self.profile)
        return LinkPlan(self._constant(self.uplink_bps), self._constant(self.downlink_bps))

    def _constant(self, rate_bps: float | None) -> DirectionPlan:
        rate_bps = DEFAULT_BPS if rate_bps is None else rate_bps
        delay_ms = DEFAULT_DELAY_MS if self.delay_ms is None else self.delay_ms
        return DirectionPlan(LinkProfile(rate_bps, delay_ms / 1e3))


class LinkProxy:
    """The proxy; ``start``, then ``stop``."""

    def __init__(self, settings: ProxySettings) -> None:
        self.addresses = [listen for listen, _ in settings.paths()]
        self._settings = settings
        plan = settings.plan()
        self._lives = plan.connection_lives_s()
        self.registry = CollectorRegistry()
        self._metrics = LinkMetrics(self.registry)
        self._up = Direction(plan.uplink, self._metrics.transit("up"), settings.spin_s)
        self._down = Direction(plan.downlink, self._metrics.transit("down"), settings.spin_s)
        self._metrics.observe({"up": self._up, "down": self._down})
        self._connections = 0
        self._connections_cut = 0
        self._tasks: set[asyncio.Task[None]] = set()
        self._listeners: list[asyncio.Server] = []

    @property
    def address(self) -> Address:
        """Return the address at which the first path begins."""
        return self.addresses[0]

    async def start(self) -> Address:
        """Accept connections; return the address, with the port that was taken."""
        for number, (listen, to) in enumerate(self._settings.paths()):
            self.addresses[number] = await self._listen(listen, to)
        for direction in (self._up, self._down):
            self._keep(asyncio.create_task(direction.pump()))
        self._serve_metrics()
        if self._settings.ready_file is not None:
            write_whole(self._settings.ready_file, f"{self.address}\n")
        return self.address

    async def _listen(self, address: Address, to: Address) -> Address:
        loop = asyncio.get_running_loop()
        try:
            listener = await loop.create_server(
                partial(self._accept, to), address.host, address.port
            )
        except OSError as error:
            raise RfedgeError(f"cannot listen on {address}: {error}") from error
        self._listeners.append(listener)
        return Address(address.host, listener.sockets[0].getsockname()[1])

    async def stop(self) -> None:
        """Close everything and write the report."""
        for listener in self._listeners:
            listener.close()
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
            "connections_cut": self._connections_cut,
            "uplink": self._up.report(),
            "downlink": self._down.report(),
        }

    def write_report(self) -> None:
        """Write the report, whole, if one was asked for."""
        if self._settings.report is not None:
            write_whole(self._settings.report, json.dumps(self.report(), indent=1) + "\n")

    def _serve_metrics(self) -> None:
        port = self._settings.metrics_port
        if port is not None:
            endpoint = MetricsEndpoint(self.registry, self._settings.metrics_host, port)
            print(f"rfedge link: metrics on port {endpoint.port}", file=sys.stderr)

    def _accept(self, to: Address) -> Side:
        side = Side(self._up, self._ended)
        self._keep(asyncio.create_task(self._connect(side, to)))
        return side

    async def _connect(self, near: Side, address: Address) -> None:
        """Open the far half of a new connection, or refuse the near one."""
        self._connections += 1
        self._metrics.connections.inc()
        loop = asyncio.get_running_loop()
        try:
            _, far = await loop.create_connection(
                lambda: Side(self._down, _ignore), address.host, address.port
            )
        except OSError:
            near.abort()
            return
        for side in (near, far):
            side.bound_receive_buffer()
        near.join(far)
        far.join(near)
        if self._lives is not None:
            await asyncio.sleep(next(self._lives))
            self._cut(near, far)

    def _cut(self, *sides: Side) -> None:
        """Break a connection, unless it has ended by itself."""
        if all(side.is_open for side in sides):
            self._connections_cut += 1
            self._metrics.cut.inc()
            for side in sides:
                side.abort()

    def _ended(self) -> None:
        self._metrics.connections.dec()
        self.write_report()

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


def _ignore() -> None:
    """Do nothing: the near side reports for both."""
