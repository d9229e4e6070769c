"""How many connections one address may hold, counted in the server's own process.

gRPC limits connections in total and the time of a handshake, and knows no limit by address; a
kernel's firewall does (``deploy/nftables/mec-server.nft``), where there is one. Here the sockets of
this process are looked at a few times a second, and those that one address has too many of are shut
down, whatever they are about: TCP, TLS or HTTP/2. That bounds what is held, not how many come and
go in between. Linux only: it lists ``/proc/self/fd``.
"""

from __future__ import annotations

import ipaddress
import os
import socket
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

__all__ = ["ConnectionCap", "keep_silent_out", "source_of"]

INTERNET = (socket.AF_INET, socket.AF_INET6)
SILENT_S = 5
"""For how long a connection may be silent before gRPC is given it; TCP rounds up."""

V6_NETWORK_BITS = 64
"""What a site has of IPv6 addresses at least, so its addresses count as one (RFC 6177)."""


@dataclass(frozen=True)
class Connection:
    """An accepted connection: our descriptor, the kernel's name of the socket, and its source."""

    descriptor: int
    inode: str
    source: str


def source_of(address: str) -> str:
    """Return what connections from ``address`` are counted under: an IPv4 address, or the /64 of
    an IPv6 address.

    Raises ``ValueError`` for what is no address.
    """
    ip = ipaddress.ip_address(address.partition("%")[0])
    if ip.version == 4:
        return str(ip)
    if ip.ipv4_mapped is not None:
        return str(ip.ipv4_mapped)
    return str(ipaddress.ip_network((ip, V6_NETWORK_BITS), strict=False))


class ConnectionCap:
    """Lets each address hold ``most`` connections to ``port``; the newest ones beyond are cut."""

    def __init__(self, port: int, most: int) -> None:
        self._port = port
        self._most = most
        self._seen: dict[str, None] = {}
        """Sockets by their kernel's names, oldest first."""

    def sweep(self) -> Counter[str]:
        """Cut what is too much; return how many connections of each address were cut.

        Not for the event loop: it takes about 10 us a connection.
        """
        found = {connection.inode: connection for connection in _accepted(self._port)}
        known = {inode: None for inode in self._seen if inode in found}
        self._seen = known | dict.fromkeys(found)
        held, cut = Counter[str](), Counter[str]()
        for inode in self._seen:
            connection = found[inode]
            held[connection.source] += 1
            if held[connection.source] > self._most and _shut(connection):
                cut[connection.source] += 1
        return cut


def keep_silent_out(port: int) -> int:
    """Have the kernel keep connections to ``port`` to itself until their peer says something.

    A client that speaks TLS or HTTP/2 speaks first. Returns how many listening sockets there are.
    """
    listening = 0
    for descriptor in _descriptors():
        with suppress(OSError), _duplicate(descriptor) as duplicate:
            is_own = duplicate.family in INTERNET and duplicate.getsockname()[1] == port
            if is_own and duplicate.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN):
                duplicate.setsockopt(socket.IPPROTO_TCP, socket.TCP_DEFER_ACCEPT, SILENT_S)
                listening += 1
    return listening


def _descriptors() -> Iterator[int]:
    return (int(entry.name) for entry in Path("/proc/self/fd").iterdir())


def _accepted(port: int) -> Iterator[Connection]:
    for descriptor in _descriptors():
        inode = _inode(descriptor)
        if not inode:
            continue
        with suppress(OSError, ValueError), _duplicate(descriptor) as duplicate:
            if duplicate.family not in INTERNET:
                continue
            if duplicate.getsockname()[1] == port:  # a listening socket has no peer: OSError
                yield Connection(descriptor, inode, source_of(duplicate.getpeername()[0]))


def _shut(connection: Connection) -> bool:
    """End a connection, unless its descriptor is another socket's by now; say whether it was."""
    with suppress(OSError), _duplicate(connection.descriptor) as duplicate:
        if _inode(duplicate.fileno()) == connection.inode:
            duplicate.shutdown(socket.SHUT_RDWR)
            return True
    return False


def _inode(descriptor: int) -> str:
    """Return the kernel's name of the socket ("socket:[4711]"); empty for what is none."""
    with suppress(OSError):
        name = str(Path(f"/proc/self/fd/{descriptor}").readlink())
        return name if name.startswith("socket:") else ""
    return ""


def _duplicate(descriptor: int) -> socket.socket:
    """Return the socket under a descriptor of our own: closing it closes nothing of gRPC's."""
    own = os.dup(descriptor)
    try:
        return socket.socket(fileno=own)
    except OSError:
        os.close(own)
        raise
