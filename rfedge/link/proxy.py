"""``rfedge link``: a throughput-limited link between a real vehicle and a real server.

An asyncio TCP proxy around two ``rfcore.link`` machines, one a direction, shared by all
connections as one radio link would be. Sizes are wire bytes (HTTP/2 and all). Nothing is reordered;
when a direction holds as much as it may, its senders are not read, so TCP slows them. Where packets
are lost, TCP's sending of them is modelled, each connection's by itself (``rfcore.link.lossy``).

A release that is late makes the link look slower than it is. So the command sleeps with select(),
which is exact to the microsecond where epoll rounds up to milliseconds, and requests a real-time
priority; the report says whether it was granted and how late the latest release was. Beside two
busy processes on two cores the latest of 24 frames was 0.2 ms late with the priority and 13 ms
without.
"""

from __future__ import annotations

import asyncio
import json
import os
import selectors
import signal
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from prometheus_client import CollectorRegistry

from rfcore.errors import RfedgeError
from rfcore.files import write_whole
from rfcore.wire.address import Address
from rfcore.wire.instruments import MetricsEndpoint
from rfedge.link import LinkSettings
from rfedge.link.direction import Direction, LinkMetrics, Side

SCHEDULERS = {os.SCHED_OTHER: "other", os.SCHED_FIFO: "fifo", os.SCHED_RR: "rr"}


class LinkProxy:
    """The proxy; ``start``, then ``stop``. Raises ``InvalidInput`` for a setting."""

    def __init__(self, settings: LinkSettings) -> None:
        settings.check()
        self.addresses = [listen for listen, _ in settings.paths()]
        self._settings = settings
        plan = settings.plan()
        self.described = plan.described()
        self._lives = plan.connection_lives_s()
        self.registry = CollectorRegistry()
        self._metrics = LinkMetrics(self.registry)
        up, down, now = plan.uplink, plan.downlink, time.perf_counter()
        machines = (
            (up.lossy_link(down, now), down.lossy_link(up, now))
            if plan.is_lossy
            else (up.link(now), down.link(now))
        )
        self._up = Direction(machines[0], self._metrics.transit("up"), settings.spin_s)
        self._down = Direction(machines[1], self._metrics.transit("down"), settings.spin_s)
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


def run_proxy(settings: LinkSettings) -> None:
    """Run the proxy until SIGTERM or SIGINT; raise ``RfedgeError`` if it cannot listen."""
    with suppress(PermissionError):  # the report names the scheduler that was granted
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    with _runner() as runner:
        runner.run(_run(settings))


def _runner() -> asyncio.Runner:
    """Return a runner that waits by select(): epoll rounds up to the next millisecond."""
    loop = asyncio.SelectorEventLoop(selectors.SelectSelector())
    return asyncio.Runner(loop_factory=lambda: loop)


async def _run(settings: LinkSettings) -> None:
    stopped = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stopped.set)
    proxy = LinkProxy(settings)
    await proxy.start()
    for address, (_, to) in zip(proxy.addresses, settings.paths(), strict=True):
        print(f"listening on {address}, to {to}", flush=True)
    print(proxy.described, flush=True)
    await stopped.wait()
    await proxy.stop()


def _ignore() -> None:
    """Do nothing: the near side reports for both."""


async def run_links(profile: Path, count: int, server: str, report: Path, ready: Path) -> None:
    """Forward over ``count`` links until SIGTERM; ``ready`` gets one address a line."""
    stopped = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, stopped.set)
    settings = LinkSettings(to=server, profile=profile, spin_s=0.0)
    proxies = [LinkProxy(settings) for _ in range(count)]
    addresses = [await proxy.start() for proxy in proxies]
    write_whole(ready, "".join(f"{address}\n" for address in addresses))
    await stopped.wait()
    for proxy in proxies:
        await proxy.stop()
    lines = (json.dumps(proxy.report()) + "\n" for proxy in proxies)
    write_whole(report, "".join(lines))


def main(arguments: Sequence[str]) -> None:
    """Run a link for each vehicle of a load test: PROFILE COUNT SERVER REPORT --ready-file FILE.

    The report has one link's measurements a line.
    """
    profile, count, server, report, _, ready = arguments
    with _runner() as runner:
        runner.run(run_links(Path(profile), int(count), server, Path(report), Path(ready)))


if __name__ == "__main__":
    main(sys.argv[1:])
