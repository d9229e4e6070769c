"""An address holds so many connections and no more, whoever is behind it."""

import asyncio
import os
import select
import socket
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path

import pytest

from mec_server.config import ServerConfig
from mec_server.connection_cap import INTERNET, SILENT_S, ConnectionCap, keep_silent_out, source_of
from mec_server.server import EdgeServer


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    with closing(socket.create_server(("127.0.0.1", 0))) as made:
        made.settimeout(10)
        yield made


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


def test_the_newest_beyond_the_cap_are_cut_and_another_address_keeps_its_own(
    listener: socket.socket,
) -> None:
    port = listener.getsockname()[1]
    cap = ConnectionCap(port, 2)
    with ExitStack() as stack:
        greedy = []
        for _ in range(2):
            greedy.append(connect(stack, port))
            stack.enter_context(listener.accept()[0])
        assert not cap.sweep(), "as many as there may be"
        for _ in range(3):
            greedy.append(connect(stack, port))
            stack.enter_context(listener.accept()[0])
        modest = connect(stack, port, "127.0.0.2")
        stack.enter_context(listener.accept()[0])
        assert cap.sweep() == {"127.0.0.1": 3}
        assert [is_closed(near) for near in greedy] == [False, False, True, True, True]
        assert not is_closed(modest)


def test_sweeping_leaves_no_descriptor_behind_and_touches_no_other_port(
    listener: socket.socket,
) -> None:
    other = ConnectionCap(1, 1)
    with ExitStack() as stack:
        nears = [connect(stack, listener.getsockname()[1]) for _ in range(3)]
        for _ in nears:
            stack.enter_context(listener.accept()[0])
        before = len(descriptors())
        assert not other.sweep()
        assert len(descriptors()) == before
        assert not any(map(is_closed, nears))


def is_ready(listener: socket.socket, within_s: float = 0.0) -> bool:
    return bool(select.select([listener], [], [], within_s)[0])


def test_a_connection_is_accepted_when_it_says_something(listener: socket.socket) -> None:
    port = listener.getsockname()[1]
    with ExitStack() as stack:
        connect(stack, port)
        assert is_ready(listener)
        stack.enter_context(listener.accept()[0])
        assert keep_silent_out(port) == 1
        silent, speaking = connect(stack, port), connect(stack, port)
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
