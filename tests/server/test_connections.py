"""An address holds so many connections and no more, whoever is behind it."""

import asyncio
import os
import select
import socket
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path

import grpc
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc

from attack.connection_attacks import (
    END_HEADERS,
    HEADERS,
    PING,
    PREFACE,
    REQUEST,
    SETTINGS,
    http2_frame,
)
from mec_server.config import ServerConfig
from mec_server.connections import (
    BARRED_S,
    INTERNET,
    MOST_BARRED,
    MOST_HEADER_BYTES,
    REFUSED_CALL_BYTES,
    SILENT_S,
    UNCALLED_BYTES,
    UNEXPLAINED_BYTES,
    ClosedConnections,
    Connections,
    bar,
    keep_silent_out,
    peer_name,
    source_of,
)
from mec_server.ledger.budgets import Limit
from mec_server.server import EdgeServer


def connect(stack: ExitStack, port: int, source: str = "127.0.0.1") -> socket.socket:
    """Return the near end of a new connection from ``source``."""
    near = socket.create_connection(("127.0.0.1", port), 10, (source, 0))
    return stack.enter_context(near)


def descriptors() -> list[Path]:
    return list(Path("/proc/self/fd").iterdir())


def is_closed(near: socket.socket) -> bool:
    near.setblocking(False)
    try:
        while near.recv(1 << 12):
            pass
        return True
    except BlockingIOError:
        return False
    except ConnectionError:
        return True


class Pairs:
    """Connections to a listener, both ends, as gRPC would name their peers."""

    def __init__(self, stack: ExitStack, listener: socket.socket, source: str, count: int) -> None:
        port = listener.getsockname()[1]
        self.nears, self.fars = [], []
        for _ in range(count):
            self.nears.append(connect(stack, port, source))
            self.nears[-1].send(b"x")  # the kernel keeps those that say nothing to itself
            self.fars.append(stack.enter_context(listener.accept()[0]))
        self.peers = [peer_name(*near.getsockname()) for near in self.nears]

    def send(self, number: int, count: int) -> None:
        """Send so many bytes, which the other end reads."""
        chunk = bytes(1 << 16)
        while count > 0:
            sent = self.nears[number].send(chunk[: min(count, len(chunk))])
            count -= sent
            while sent > 0:
                sent -= len(self.fars[number].recv(sent))


class Port:
    """A port that is listened on, and the connections to it."""

    def __init__(self, stack: ExitStack) -> None:
        self.stack = stack
        self.listener = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        self.listener.settimeout(10)
        self.number: int = self.listener.getsockname()[1]

    def watched(self, of_address: int = 0, of_identity: int = 0) -> Connections:
        """Return what looks after the connections."""
        made = Connections(of_address, of_identity)
        made.listen(self.number)
        return made

    def pairs(self, count: int, source: str = "127.0.0.1") -> Pairs:
        """Return new connections from an address."""
        return Pairs(self.stack, self.listener, source, count)


@pytest.fixture
def port() -> Iterator[Port]:
    with ExitStack() as stack:
        yield Port(stack)


@pytest.mark.parametrize(
    ("address", "source"),
    [
        ("192.0.2.7", "192.0.2.7"),
        ("::ffff:192.0.2.7", "192.0.2.7"),
        ("2001:db8:1:2:3:4:5:6", "2001:db8:1:2::/64"),
        ("2001:db8:1:2::1", "2001:db8:1:2::/64"),
        ("fe80::1%eth0", "fe80::/64"),
    ],
)
def test_an_ipv6_site_counts_as_one_address(address: str, source: str) -> None:
    assert source_of(address) == source


def test_the_newest_beyond_the_cap_are_cut_and_another_address_keeps_its_own(port: Port) -> None:
    connections = port.watched(2)
    first = port.pairs(2)
    assert not connections.sweep(0.0), "as many as there may be"
    beyond = port.pairs(3)
    modest = port.pairs(1, "127.0.0.2")
    (cut,) = connections.sweep(0.25)
    assert cut == ClosedConnections("127.0.0.1", Limit.ADDRESS_CONNECTIONS, 3, barred=False)
    assert all(map(is_closed, beyond.nears))
    assert not any(map(is_closed, (*first.nears, *modest.nears)))


def test_sweeping_leaves_no_descriptor_behind_and_touches_no_other_port(port: Port) -> None:
    pairs = port.pairs(3)
    before = len(descriptors())
    assert not Connections(1, 0).sweep(0.0)  # of no port
    assert len(descriptors()) == before
    assert not any(map(is_closed, pairs.nears))


def test_bytes_that_become_no_message_end_a_connection_and_messages_do_not(port: Port) -> None:
    connections = port.watched()
    pairs = port.pairs(3)
    connections.claim(pairs.peers[2], "sender")
    connections.sweep(0.0)
    pairs.send(2, UNEXPLAINED_BYTES * 3 // 4)
    assert not connections.sweep(0.1)
    for number in range(3):
        pairs.send(number, 2 * UNEXPLAINED_BYTES)
    connections.explain(pairs.peers[0], 2 * UNEXPLAINED_BYTES)
    connections.exempt(pairs.peers[1])
    cuts = connections.sweep(0.25)
    assert cuts == [ClosedConnections("127.0.0.1", Limit.CONNECTION_BYTES, 1, barred=True)]
    assert [is_closed(near) for near in pairs.nears] == [False, False, True]


def test_a_connection_without_a_call_is_ended_for_less(port: Port) -> None:
    connections = port.watched()
    pairs = port.pairs(3)
    connections.claim(pairs.peers[0], "called")
    connections.sweep(0.0)
    pairs.send(0, 2 * UNCALLED_BYTES)
    pairs.send(1, UNCALLED_BYTES * 3 // 4)
    pairs.send(2, 2 * UNCALLED_BYTES)
    (cut,) = connections.sweep(0.05)
    assert (cut.limit, cut.count) == (Limit.CONNECTION_BYTES, 1)
    assert [is_closed(near) for near in pairs.nears] == [False, False, True]


def test_a_little_beside_the_messages_is_forgotten_with_time(port: Port) -> None:
    connections = port.watched()
    pairs = port.pairs(1)
    connections.claim(pairs.peers[0], "sender")
    connections.sweep(0.0)
    for minute in range(1, 6):
        pairs.send(0, UNEXPLAINED_BYTES * 3 // 4)
        assert not connections.sweep(60.0 * minute)
    pairs.send(0, UNEXPLAINED_BYTES * 3 // 4)
    pairs.send(0, UNEXPLAINED_BYTES * 3 // 4)
    assert connections.sweep(301.0)


def test_a_message_explains_nothing_that_comes_later(port: Port) -> None:
    connections = port.watched()
    pairs = port.pairs(1)
    connections.explain(pairs.peers[0], 100 * UNEXPLAINED_BYTES)  # compressed, it was short
    assert not connections.sweep(0.0)
    pairs.send(0, 2 * UNEXPLAINED_BYTES)
    assert connections.sweep(0.25)


def test_calls_that_a_budget_refuses_end_a_connection(port: Port) -> None:
    connections = port.watched()
    pairs = port.pairs(2)
    connections.sweep(0.0)
    for _ in range(UNEXPLAINED_BYTES // REFUSED_CALL_BYTES):
        for peer in pairs.peers:
            connections.refuse(peer, 0.1)
    assert not any(map(is_closed, pairs.nears))
    connections.refuse(pairs.peers[0], 0.2)
    assert [is_closed(near) for near in pairs.nears] == [True, False], "it waits for no sweep"
    (cut,) = connections.sweep(0.25)
    assert (cut.limit, cut.count) == (Limit.CONNECTION_BYTES, 1)
    assert [is_closed(near) for near in pairs.nears] == [True, False]


def test_an_identity_holds_so_many_connections_and_a_proxy_as_many_as_it_needs(port: Port) -> None:
    connections = port.watched(0, 2)
    greedy, modest = (port.pairs(count) for count in (4, 2))
    proxy = port.pairs(4, "127.0.0.3")
    for name, pairs in (("greedy", greedy), ("modest", modest)):
        for peer in pairs.peers:
            connections.claim(peer, name)
    for peer in proxy.peers:
        connections.claim(peer, "proxy")
        connections.exempt(peer)
    (cut,) = connections.sweep(0.0)
    assert cut == ClosedConnections("127.0.0.1", Limit.IDENTITY_CONNECTIONS, 2, barred=True)
    assert [is_closed(near) for near in greedy.nears] == [False, False, True, True]
    assert not any(is_closed(near) for near in (*modest.nears, *proxy.nears))


def test_what_a_connection_sent_before_it_was_ended_is_not_read_any_more(port: Port) -> None:
    pairs = port.pairs(1)
    pairs.nears[0].send(bytes(100_000))
    port.watched().offend(pairs.peers[0], Limit.HEADER_BYTES, 0.0)
    assert pairs.fars[0].recv(1 << 20) == b""
    assert is_closed(pairs.nears[0])


def can_connect(port: int, source: str, host: str = "127.0.0.1") -> bool:
    try:
        socket.create_connection((host, port), 0.3, (source, 0)).close()
    except TimeoutError:
        return False
    return True


def test_an_address_that_offended_is_not_answered_for_a_while_and_others_are(port: Port) -> None:
    connections = port.watched()
    guilty = port.pairs(1, "127.0.0.2")
    beside = port.pairs(1, "127.0.0.2")
    connections.sweep(0.0)
    connections.offend(guilty.peers[0], Limit.HEADER_BYTES, 0.0)
    cuts = connections.sweep(0.25)
    assert cuts == [ClosedConnections("127.0.0.2", Limit.HEADER_BYTES, 1, barred=True)]
    assert not connections.sweep(0.5), "told once"
    assert not can_connect(port.number, "127.0.0.2")
    assert can_connect(port.number, "127.0.0.1")
    beside.send(0, 10_000)  # what was there before goes on
    assert not is_closed(beside.nears[0])
    connections.sweep(0.5 + BARRED_S)
    assert can_connect(port.number, "127.0.0.2")


def test_as_many_addresses_as_there_may_be_are_barred_at_once(port: Port) -> None:
    bar(port.listener, [f"192.0.2.{i}" for i in range(MOST_BARRED - 1)] + ["127.0.0.9"])
    assert not can_connect(port.number, "127.0.0.9")
    assert can_connect(port.number, "127.0.0.8")
    bar(port.listener, [f"2001:db8:{i:x}::/64" for i in range(MOST_BARRED)])
    assert can_connect(port.number, "127.0.0.9")


@pytest.mark.skipif(not socket.has_dualstack_ipv6(), reason="needs IPv6")
def test_a_site_of_ipv6_addresses_is_barred_as_one() -> None:
    with closing(socket.create_server(("::1", 0), family=socket.AF_INET6)) as listener:
        port = listener.getsockname()[1]
        bar(listener, ["2001:db8::/64", "127.0.0.1"])
        assert can_connect(port, "::1", "::1")
        bar(listener, ["2001:db8::/64", source_of("::1")])
        assert not can_connect(port, "::1", "::1")


async def test_headers_that_no_client_sends_cost_the_connection_and_another_goes_on(
    tmp_path: Path,
) -> None:
    """A header of the table is named again and again, a byte each."""
    server = EdgeServer(ServerConfig(tmp_path, "127.0.0.1:0"))
    await server.start()
    entry, named = b"\x40\x01x\x64" + b"y" * 100, b"\xbe"
    often = MOST_HEADER_BYTES // 100 + 1
    ask = health_pb2.HealthCheckRequest()
    try:
        async with grpc.aio.insecure_channel(str(server.address)) as channel:
            health = health_pb2_grpc.HealthStub(channel)
            await health.Check(ask, timeout=30)
            with socket.create_connection(("127.0.0.1", server.address.port), 30) as raw:
                raw.send(PREFACE + http2_frame(SETTINGS, 0, 0))
                few = REQUEST + entry + named * 10
                raw.send(http2_frame(HEADERS, END_HEADERS, 1, few))
                raw.send(http2_frame(PING, 0, 0, b"still on"))
                await asyncio.to_thread(received_until, raw, b"still on")
                raw.send(http2_frame(HEADERS, END_HEADERS, 3, REQUEST + named * often))
                await asyncio.to_thread(received_until, raw, None)
            await health.Check(ask, timeout=30)
    finally:
        await server.stop()


def received_until(raw: socket.socket, wanted: bytes | None) -> None:
    """Read until something comes, or with None until the connection ends."""
    came = b""
    while wanted is None or wanted not in came:
        try:
            part = raw.recv(1 << 16)
        except ConnectionError:
            part = b""
        if not part:
            assert wanted is None, came
            return
        came += part


def is_ready(listener: socket.socket, within_s: float = 0.0) -> bool:
    return bool(select.select([listener], [], [], within_s)[0])


def test_a_connection_is_accepted_when_it_says_something(port: Port) -> None:
    stack, listener = port.stack, port.listener
    connect(stack, port.number)
    assert is_ready(listener)
    stack.enter_context(listener.accept()[0])
    assert keep_silent_out(port.number) == 1
    silent, speaking = connect(stack, port.number), connect(stack, port.number)
    assert not is_ready(listener)
    speaking.send(b"x")
    assert is_ready(listener, 10)
    accepted = stack.enter_context(listener.accept()[0])
    assert accepted.getpeername() == speaking.getsockname() != silent.getsockname()


async def test_a_server_lets_its_kernel_keep_silent_connections(tmp_path: Path) -> None:
    server = EdgeServer(ServerConfig(tmp_path, "127.0.0.1:0"))
    await server.start()
    try:
        (waits_s,) = [
            duplicate.getsockopt(socket.IPPROTO_TCP, socket.TCP_DEFER_ACCEPT)
            for duplicate in listening(server.address.port)
        ]
        assert waits_s >= SILENT_S
    finally:
        await server.stop()


def listening(port: int) -> Iterator[socket.socket]:
    """Yield duplicates of our sockets that listen on ``port``."""
    for entry in descriptors():
        with suppress(OSError), socket.socket(fileno=os.dup(int(entry.name))) as duplicate:
            is_internet = duplicate.family in INTERNET
            if not is_internet or duplicate.getsockname()[1] != port:
                continue
            if duplicate.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN):
                yield duplicate


async def test_a_server_closes_what_an_address_holds_too_many_of(tmp_path: Path) -> None:
    server = EdgeServer(ServerConfig(tmp_path, "127.0.0.1:0", address_connections=3))
    name, labels = "rfedge_server_limited_total", {"limit": "address_connections"}
    await server.start()
    try:
        with ExitStack() as stack:
            nears = [connect(stack, server.address.port) for _ in range(8)]
            for near in nears:
                near.send(b"PRI")  # the kernel keeps those that say nothing to itself
            async with asyncio.timeout(30):
                while server.registry.get_sample_value(name, labels) != 5:
                    await asyncio.sleep(0.01)
                while sum(map(is_closed, nears)) < 5:
                    await asyncio.sleep(0.01)
    finally:
        await server.stop()
