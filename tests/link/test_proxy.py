"""The proxy on real sockets: what goes in comes out, on time, both ways."""

import asyncio
import errno
import json
import re
import socket
import subprocess
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rfcore.errors import InvalidInput, RfedgeError
from rfcore.link.lossy import PacketLoss
from rfcore.link.plan import Arrival, delivery_times
from rfcore.link.shaper import Link, LinkProfile
from rfedge.link import LinkSettings
from rfedge.link.direction import Direction, Side
from rfedge.link.proxy import LinkProxy
from rfedge.processes import command_of

Handler = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]
FAST: dict[str, float] = {"uplink_bps": 1e9, "downlink_bps": 1e9, "delay_ms": 0.0}


async def echo(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    while data := await reader.read(65536):
        writer.write(data)
        await writer.drain()
    writer.write_eof()
    await writer.drain()
    writer.close()


@asynccontextmanager
async def linked(handler: Handler, **changes: Any) -> AsyncIterator[LinkProxy]:
    server = await asyncio.start_server(handler, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    link = changes if "profile" in changes else FAST | changes
    proxy = LinkProxy(LinkSettings(f"127.0.0.1:{port}", **link))
    await proxy.start()
    try:
        yield proxy
    finally:
        await proxy.stop()
        server.close()


async def exchange(proxy: LinkProxy, data: bytes) -> bytes:
    """Send ``data`` and the end; return everything that comes back."""
    reader, writer = await asyncio.open_connection(proxy.address.host, proxy.address.port)
    writer.write(data)
    writer.write_eof()
    got = await reader.read(-1)
    writer.close()
    await writer.wait_closed()
    return got


async def test_bytes_come_back_whole_and_in_order() -> None:
    data = bytes(i % 251 for i in range(300_000))
    async with linked(echo) as proxy:
        got = await asyncio.gather(*(exchange(proxy, data[i:]) for i in range(3)))
    assert got == [data[i:] for i in range(3)]
    report = proxy.report()
    assert report["connections"] == 3
    assert report["uplink"]["bytes"] == report["downlink"]["bytes"] == 900_000 - 3


async def test_a_transfer_takes_bytes_over_rate_and_the_report_measures_it() -> None:
    """0.4 s of uplink; a late pump may only make it longer, and the report has to say so."""
    clock = asyncio.get_running_loop().time
    async with linked(echo, uplink_bps=4e6, delay_ms=20.0) as proxy:
        started_s = clock()
        await exchange(proxy, bytes(200_000))
        took_s = clock() - started_s
    uplink = proxy.report()["uplink"]
    assert uplink["expected_s"] == pytest.approx(0.4)
    assert took_s >= 0.42
    assert uplink["busy_s"] >= uplink["expected_s"] - 1e-6, "a link is never faster than its rate"
    assert uplink["busy_s"] - uplink["expected_s"] <= 10 * uplink["largest_lateness_s"] + 1e-6


async def test_a_full_link_holds_the_sender_back() -> None:
    """The server's side of a slow link takes nothing; what was read is bounded by the queue."""
    async with linked(echo, uplink_bps=8e3) as proxy:
        _, writer = await asyncio.open_connection(proxy.address.host, proxy.address.port)
        writer.transport.set_write_buffer_limits(0)
        writer.write(bytes(8_000_000))
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.3):
                await writer.drain()
        assert proxy._up.held_bytes <= 65_536
        writer.transport.abort()


async def test_the_reports_are_written_whole(tmp_path: Path) -> None:
    report, ready = tmp_path / "link.json", tmp_path / "ready"
    async with linked(echo, report=report, ready_file=ready) as proxy:
        assert ready.read_text().strip() == str(proxy.address)
        await exchange(proxy, b"x" * 1000)
    written = json.loads(report.read_text())
    assert written["uplink"]["bytes"] == 1000
    assert written["uplink"]["rate_bps"] == 1e9
    assert sorted(p.name for p in tmp_path.iterdir()) == ["link.json", "ready"]


async def test_a_connection_is_refused_while_the_server_is_away() -> None:
    proxy = LinkProxy(LinkSettings("127.0.0.1:1"))
    await proxy.start()
    with pytest.raises(ConnectionError):
        await exchange(proxy, b"hello")
    await proxy.stop()


async def test_a_server_that_closes_closes_the_vehicle_s_end_behind_its_last_bytes() -> None:
    async def farewell(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"goodbye" * 1000)
        writer.close()

    async with linked(farewell, downlink_bps=4e6) as proxy:
        reader, writer = await asyncio.open_connection(proxy.address.host, proxy.address.port)
        assert await reader.read(-1) == b"goodbye" * 1000
        writer.close()


async def test_an_end_that_vanished_unheard_leaves_the_link_to_the_others() -> None:
    class Vanished(asyncio.Transport):
        def can_write_eof(self) -> bool:
            return True

        def is_closing(self) -> bool:
            return False

        def write_eof(self) -> None:
            raise OSError(errno.ENOTCONN, "Transport endpoint is not connected")

    direction = Direction(Link(LinkProfile(1e9)))
    here, gone = (Side(direction, lambda: None) for _ in range(2))
    here.peer, gone.transport = gone, Vanished()
    pump = asyncio.create_task(direction.pump())
    here.eof_received()
    arrived = asyncio.Event()
    direction.push(arrived.set, 1)
    await asyncio.wait_for(arrived.wait(), 10)
    pump.cancel()


async def test_a_taken_port_is_one_clear_error() -> None:
    async with linked(echo) as proxy:
        again = LinkSettings("127.0.0.1:1", listen=str(proxy.address))
        with pytest.raises(RfedgeError, match=r"cannot listen on 127\.0\.0\.1:"):
            await LinkProxy(again).start()


@pytest.mark.parametrize(
    ("listen", "to", "named"),
    [
        ("127.0.0.1", "127.0.0.1:1", "listen: '127.0.0.1' must be HOST:PORT"),
        ("127.0.0.1:1", "127.0.0.1:99999", "to: port '99999'"),
        ("0.0.0.0:1", "127.0.0.1:1", "listen: 0.0.0.0:1 is not a loopback address"),
        ("[::1]:1", "example.org:1", "to: example.org:1 is not a loopback address"),
    ],
)
def test_addresses_are_checked_by_name(listen: str, to: str, named: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        LinkSettings(to, listen).check()
    assert str(caught.value).startswith(named)


def test_another_machine_is_reached_when_plaintext_is_allowed() -> None:
    LinkSettings("example.org:1", "0.0.0.0:1", allow_insecure=True).check()


async def test_a_profile_s_outage_holds_what_comes_during_it(profile: Callable[..., Path]) -> None:
    """The link is out from the beginning on, so that no test has to hit a moment."""
    path = profile("rate_mbps = 100.0\n[uplink.outage]\nat_s = [[0.0, 0.4]]")
    clock = asyncio.get_running_loop().time
    started_s = clock()
    async with linked(echo, profile=path) as proxy:
        assert await exchange(proxy, b"through") == b"through"
        assert clock() - started_s >= 0.4


async def test_connections_are_lost_as_the_profile_says_and_counted(
    profile: Callable[..., Path],
) -> None:
    path = profile(end="[connection_loss]\nmean_life_s = 0.05")
    async with linked(echo, profile=path) as proxy:
        reader, writer = await asyncio.open_connection(proxy.address.host, proxy.address.port)
        with suppress(ConnectionResetError):
            assert await reader.read() == b"", "nothing was sent; the end comes when it is cut"
        writer.close()
    assert proxy.report()["connections_cut"] == 1
    assert proxy.registry.get_sample_value("rfedge_link_connections_cut_total") == 1


async def test_the_metrics_of_the_link_are_what_its_report_says() -> None:
    async with linked(echo) as proxy:
        await exchange(proxy, bytes(50_000))
        value = proxy.registry.get_sample_value
        for direction, reported in (("up", "uplink"), ("down", "downlink")):
            label = {"direction": direction}
            report = proxy.report()[reported]
            assert value("rfedge_link_bytes_total", label) == report["bytes"] == 50_000
            assert value("rfedge_link_busy_seconds_total", label) == report["busy_s"]
            assert value("rfedge_link_rate_bytes_per_second", label) == 1e9 / 8
            assert value("rfedge_link_held_bytes", label) == 0
            assert value("rfedge_link_transit_seconds_count", label) >= 50_000 / 4096
    assert value("rfedge_link_connections") == 0


def test_a_rate_beside_a_profile_is_refused(profile: Callable[..., Path]) -> None:
    with pytest.raises(InvalidInput, match="uplink_bps: is given beside the profile"):
        LinkSettings("127.0.0.1:1", uplink_bps=1e6, profile=profile()).check()


async def test_two_paths_share_one_link() -> None:
    """Traffic to two servers shares one radio: both count as one uplink."""
    other = await asyncio.start_server(echo, "127.0.0.1", 0)
    port = other.sockets[0].getsockname()[1]
    async with linked(echo, also=(f"127.0.0.1:0=127.0.0.1:{port}",)) as proxy:
        assert await exchange(proxy, b"first") == b"first"
        second = proxy.addresses[1]
        reader, writer = await asyncio.open_connection(second.host, second.port)
        writer.write(b"second")
        writer.write_eof()
        assert await reader.read(-1) == b"second"
        writer.close()
        await writer.wait_closed()
        assert proxy.report()["uplink"]["bytes"] == len(b"firstsecond")
    other.close()


async def test_lost_packets_cost_time_and_no_byte() -> None:
    data = bytes(i % 251 for i in range(60_000))
    async with linked(echo, uplink_bps=8e6, downlink_bps=8e6, delay_ms=5.0, loss=5.0) as proxy:
        assert await exchange(proxy, data) == data
    report = proxy.report()
    sent_again = (
        report["uplink"]["bytes"] + report["downlink"]["bytes"] - 2 * len(data) * 1500 / 1448
    )
    assert sent_again > 1448


def test_loss_goes_with_a_profile(profile: Callable[..., Path]) -> None:
    plan = LinkSettings("127.0.0.1:1", profile=profile(), loss=2.0, loss_burst=3.0).plan()
    assert plan.uplink.loss == plan.downlink.loss == PacketLoss(2.0, 3.0)


@pytest.mark.parametrize("with_profile", [False, True])
def test_jitter_delays_by_up_to_its_spread(
    profile: Callable[..., Path], with_profile: bool
) -> None:
    asked = {"profile": profile()} if with_profile else {}
    plain, jittery = (
        LinkSettings("127.0.0.1:1", jitter_ms=ms, **asked).plan().uplink for ms in (None, 30.0)
    )
    packets = [Arrival(float(second), 100) for second in range(200)]
    late_s = np.subtract(*(delivery_times(way, packets) for way in (jittery, plain)))
    assert 0 <= late_s.min() < 0.002
    assert 0.028 < late_s.max() <= 0.03
    with pytest.raises(InvalidInput, match="jitter"):
        LinkSettings("127.0.0.1:1", jitter_ms=-1.0).check()


def test_the_command_says_at_once_where_it_listens_also_through_a_pipe() -> None:
    """The form of the guides, --to alone; what connects there reaches the server."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        to = f"127.0.0.1:{server.getsockname()[1]}"
        command = [*command_of("rfedge"), "link", "--to", to]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as link:
            try:
                assert link.stdout is not None
                listening, address, end = re.split(r"on |,", link.stdout.readline().strip())
                assert (listening, end) == ("listening ", f" to {to}")
                near = socket.create_connection(address.split(":"), 10)
                near.sendall(b"through")
                near.shutdown(socket.SHUT_WR)
                far, _ = server.accept()
                with near, far:
                    assert far.recv(100) == b"through"
            finally:
                link.kill()


def test_a_path_needs_both_its_ends() -> None:
    with pytest.raises(InvalidInput, match="HOST:PORT"):
        LinkSettings("127.0.0.1:1", also=("127.0.0.1:2",)).check()
