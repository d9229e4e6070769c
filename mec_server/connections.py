"""Limits on the connections of this process: their number, and the cost of each.

gRPC limits connections in total and the time of a handshake. It knows no limit for one address, and
reports nothing of what happens below a call (pings, settings, endless headers, calls that are
reset, headers with ten thousand names); by the time a call is seen its headers are in memory. So
the sockets of this process are examined many times a second, and closed where

* one address has too many of them, or one identity;
* more bytes came in than became messages (``explain``): what a peer sends beyond that it sends to
  keep the server busy. Before a call was seen, little is too much. A call that its budget refused
  counts as some of these bytes, and where that alone is too much, nothing waits for the next look;
* a call's headers are larger than any client's (``offend``).

Every reason but the first also *bars* the address: for some seconds the kernel drops its packets to
the listening socket, so that new attempts cost nothing; existing connections from there stay as
they are. An address is a source of packets, not an identity: vehicles that connect anew through the
same address translator wait for as long. Peers that are known proxies are exempt. A firewall
(``deploy/nftables/mec-server.nft``) does more where there is one. Linux only: it lists
``/proc/self/fd``.
"""

from __future__ import annotations

import ctypes
import ipaddress
import os
import socket
import struct
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from ipaddress import IPv4Address, IPv6Network
from pathlib import Path
from threading import Lock
from urllib.parse import quote, unquote

from mec_server.ledger.budgets import Limit

INTERNET = (socket.AF_INET, socket.AF_INET6)
SILENT_S = 5
"""Seconds for which a connection may be silent before gRPC is given it; TCP rounds up."""

V6_NETWORK_BITS = 64
"""The addresses of one such IPv6 network count as one, since a site has at least a /64 (RFC
6177)."""

MOST_HEADER_BYTES = 16_384
"""Most bytes of a call's headers, names and values; ours have a few hundred."""

UNEXPLAINED_BYTES = 4 << 20
"""Bytes that a connection may have sent without their becoming messages: more than waits to be read
from a rig of 18 cameras, two large frames each, while the server is too busy to read."""
UNCALLED_BYTES = 256 << 10
"""The same for a connection on which no call was seen yet: a Hello takes some kB."""
UNEXPLAINED_BYTES_PER_S = 64 << 10
"""Rate at which such bytes are forgiven: acknowledgements, pings, headers, consumers' requests."""
OVERHEAD = 1.1
"""Bytes of TLS and HTTP/2 per byte of a message, at most; short messages add
``MESSAGE_OVERHEAD``."""
MESSAGE_OVERHEAD = 256
REFUSED_CALL_BYTES = 128 << 10
"""Bytes that a refused call counts as: 32 of them pass, and one more every two seconds."""

BARRED_S = 10.0
MOST_BARRED = 60
"""Most addresses that are barred at once, the newest: jumps of the kernel's filter reach 255
instructions."""

BYTES_RECEIVED = struct.Struct("128xQ")
"""``tcpi_bytes_received`` in ``struct tcp_info`` (linux/tcp.h)."""
SO_ATTACH_FILTER, SO_DETACH_FILTER = 26, 27


@dataclass(frozen=True)
class Connection:
    """An accepted connection: our descriptor, the kernel's name of the socket, its source, its peer
    as gRPC names it, and how many bytes came in so far."""

    descriptor: int
    inode: str
    source: str
    peer: str
    received_bytes: int


def source_of(address: str) -> str:
    """Return the source under which connections from ``address`` are counted: the IPv4 address, or
    the /64 of the IPv6 address.

    Raises ``ValueError`` if ``address`` is no address.
    """
    ip = ipaddress.ip_address(address.partition("%")[0])
    if ip.version == 4:
        return str(ip)
    if ip.ipv4_mapped is not None:
        return str(ip.ipv4_mapped)
    return str(ipaddress.ip_network((ip, V6_NETWORK_BITS), strict=False))


@dataclass(frozen=True)
class ClosedConnections:
    """Connections of one source that were closed for one reason; ``barred``: its address is barred,
    too."""

    source: str
    limit: Limit
    count: int
    barred: bool


@dataclass
class ByteAccount:
    """The bytes of one connection that became no message."""

    inode: str
    received_bytes: int = 0
    unexplained_bytes: float = 0.0
    is_called: bool = False
    """Whether a call was seen on it."""

    @property
    def is_too_dear(self) -> bool:
        """Whether more came than may become no message."""
        most_bytes = UNEXPLAINED_BYTES if self.is_called else UNCALLED_BYTES
        return self.unexplained_bytes > most_bytes


@dataclass
class PeerNotes:
    """Reports of calls about one connection since the last sweep."""

    explained_bytes: float = 0.0
    identity: str = ""
    is_exempt: bool = False
    offences: dict[Limit, bool] = field(default_factory=dict)
    """Limits that the connection exceeded, and whether a sweep has reported each."""


class Connections:
    """Lets each address hold ``of_address`` connections, and each identity ``of_identity`` (0: no
    limit).

    The newest connections beyond are closed, as are those that cost too much. ``listen`` sets the
    port. Calls report their peer, as gRPC names it, to ``explain``, ``refuse``, ``claim``,
    ``exempt`` and ``offend``, which are cheap; one thread of its own calls ``sweep``.
    """

    def __init__(self, of_address: int, of_identity: int) -> None:
        self._of_address = of_address
        self._of_identity = of_identity
        self._port = 0
        self._accounts: dict[str, ByteAccount] = {}
        """The open connections by peer, oldest first."""
        self._notes: defaultdict[str, PeerNotes] = defaultdict(PeerNotes)
        self._absent: set[str] = set()
        self._barred_s: dict[str, float] = {}
        self._swept_s: float | None = None
        self._lock = Lock()

    def listen(self, port: int) -> None:
        """Start watching the connections to ``port``; the kernel closes silent ones by itself.

        Before this call there is nothing to sweep.
        """
        self._port = port
        keep_silent_out(port)

    def explain(self, peer: str, message_bytes: int) -> None:
        """Note that bytes of a connection became a message, or a call that was answered."""
        with self._lock:
            notes = self._notes[peer]
            notes.explained_bytes += OVERHEAD * message_bytes + MESSAGE_OVERHEAD

    def refuse(self, peer: str, now: float) -> None:
        """Note that a call was refused for a budget; close a connection of too many at once.

        By the next sweep hundreds of calls would have been answered, one by one, before others'.
        """
        with self._lock:
            notes = self._notes[peer]
            notes.explained_bytes -= REFUSED_CALL_BYTES
            is_too_dear = notes.explained_bytes < -UNEXPLAINED_BYTES
        if is_too_dear:
            self.offend(peer, Limit.CONNECTION_BYTES, now)

    def claim(self, peer: str, identity: str) -> None:
        """Note the identity of a connection."""
        with self._lock:
            self._notes[peer].identity = identity

    def exempt(self, peer: str) -> None:
        """Never close this connection: it is a proxy's, and carries others' calls."""
        with self._lock:
            self._notes[peer].is_exempt = True

    def offend(self, peer: str, limit: Limit, now: float) -> None:
        """Close a connection and bar its address at once; do nothing for an empty ``peer``.

        About 10 us a connection: not for what may happen often.
        """
        if not peer:
            return
        with self._lock:
            notes = self._notes[peer]
            if notes.is_exempt or limit in notes.offences:
                return
            notes.offences[limit] = False
            self._bar([_source_of_peer(peer)], now)
        for connection in _accepted(self._port):
            if connection.peer == peer:
                _shut(connection)

    def sweep(self, now: float) -> list[ClosedConnections]:
        """Close connections that are too many or cost too much, and bar their addresses; return
        those closed.

        Not for the event loop: it takes about 10 us a connection.
        """
        found = {connection.peer: connection for connection in _accepted(self._port)}
        with self._lock:
            reasons = self._judge(found, now)
        cut: defaultdict[tuple[str, Limit], int] = defaultdict(int)
        for peer, limit in reasons.items():
            # One that offended may be gone by now; its source is still to be barred.
            cut[_source_of_peer(peer), limit] += peer not in found or _shut(found[peer])
        cuts = [
            ClosedConnections(source, limit, count, limit is not Limit.ADDRESS_CONNECTIONS)
            for (source, limit), count in cut.items()
            if count
        ]
        with self._lock:
            self._bar([each.source for each in cuts if each.barred], now)
        return cuts

    def _judge(self, found: dict[str, Connection], now: float) -> dict[str, Limit]:
        """Update the accounts; return the connections to close, and the reasons."""
        passed_s = 0.0 if self._swept_s is None else now - self._swept_s
        self._swept_s = now
        offended: dict[str, Limit] = {}
        for peer, notes in self._notes.items():
            for limit, is_told in notes.offences.items():
                if not is_told:
                    offended[peer] = limit
            notes.offences = dict.fromkeys(notes.offences, True)
        absent = self._notes.keys() - found.keys()
        for peer in absent & self._absent:  # twice: a new one may not have been listed yet
            del self._notes[peer]
        self._absent = absent
        known = {
            peer: account
            for peer, account in self._accounts.items()
            if peer in found and found[peer].inode == account.inode
        }
        self._accounts = known | {
            peer: known.get(peer) or ByteAccount(each.inode) for peer, each in found.items()
        }
        for peer, account in self._accounts.items():
            self._update(account, found[peer], self._notes.get(peer), passed_s)
        exempt = {peer for peer, notes in self._notes.items() if notes.is_exempt}
        reasons = {**self._too_many(found), **self._too_dear(), **offended}
        return {peer: limit for peer, limit in reasons.items() if peer not in exempt}

    @staticmethod
    def _update(
        account: ByteAccount, connection: Connection, notes: PeerNotes | None, passed_s: float
    ) -> None:
        came = connection.received_bytes - account.received_bytes
        explained = 0.0
        if notes is not None:
            explained, notes.explained_bytes = notes.explained_bytes, 0.0
            account.is_called = True
        allowed = UNEXPLAINED_BYTES_PER_S * passed_s
        left = account.unexplained_bytes + came - explained - allowed
        account.received_bytes = connection.received_bytes
        account.unexplained_bytes = max(0.0, left)

    def _too_dear(self) -> dict[str, Limit]:
        return {
            peer: Limit.CONNECTION_BYTES
            for peer, account in self._accounts.items()
            if account.is_too_dear
        }

    def _too_many(self, found: dict[str, Connection]) -> dict[str, Limit]:
        of_address: defaultdict[str, int] = defaultdict(int)
        of_identity: defaultdict[str, int] = defaultdict(int)
        reasons = {}
        for peer in self._accounts:
            notes = self._notes.get(peer)
            if notes is not None and notes.identity:
                of_identity[notes.identity] += 1
                if 0 < self._of_identity < of_identity[notes.identity]:
                    reasons[peer] = Limit.IDENTITY_CONNECTIONS
            of_address[found[peer].source] += 1
            if 0 < self._of_address < of_address[found[peer].source]:
                reasons[peer] = Limit.ADDRESS_CONNECTIONS
        return reasons

    def _bar(self, sources: list[str], now: float) -> None:
        """Have the kernel drop packets from ``sources``, and accept earlier ones again."""
        barred_s = {source: s for source, s in self._barred_s.items() if s > now}
        for source in sources:
            barred_s.pop(source, None)
            barred_s[source] = now + BARRED_S
        barred_s = dict(list(barred_s.items())[-MOST_BARRED:])
        if barred_s.keys() != self._barred_s.keys():
            for listening in _listening(self._port):
                bar(listening, barred_s)
        self._barred_s = barred_s


def bar(listening: socket.socket, sources: Iterable[str]) -> None:
    """Have the kernel drop packets for a listening socket that come from ``sources``.

    Sources are as ``source_of`` names them. Connections that were accepted before keep what was in
    force then. Needs no privilege (socket(7), SO_ATTACH_FILTER).
    """
    networks = [ipaddress.ip_network(source) for source in sources]
    if not networks:
        with suppress(FileNotFoundError):  # nobody was barred before
            listening.setsockopt(socket.SOL_SOCKET, SO_DETACH_FILTER, 0)
        return
    program = _program(
        [network.network_address for network in networks if network.version == 4],
        [network for network in networks if network.version == 6],
    )
    code = ctypes.create_string_buffer(b"".join(struct.pack("=HBBI", *each) for each in program))
    filter_ = struct.pack("HP", len(program), ctypes.addressof(code))
    listening.setsockopt(socket.SOL_SOCKET, SO_ATTACH_FILTER, filter_)


Instruction = tuple[int, int, int, int]
"""An instruction of the classic BPF machine: operation, jump if true, jump if false, operand."""
LOAD_WORD, LOAD_BYTE, SHIFT_RIGHT, JUMP_IF_EQUAL, RETURN = 0x20, 0x30, 0x74, 0x15, 0x06
NETWORK_HEADER = 0xFFF00000
"""``SKF_NET_OFF``: offsets from here on are into the IP header (linux/filter.h)."""
WHOLE, NOTHING = 0xFFFFFFFF, 0


def _program(fours: list[IPv4Address], sixes: list[IPv6Network]) -> list[Instruction]:
    """Return the filter that drops packets of these sources: at most 60 of each."""
    drop_4 = [_drop_unless_other(int(each)) for each in fours]
    four = [(LOAD_WORD, 0, 0, NETWORK_HEADER + 12), *(x for pair in drop_4 for x in pair)]
    six: list[Instruction] = []
    for each in sixes:
        high, low = divmod(int(each.network_address) >> 64, 1 << 32)
        six += [
            (LOAD_WORD, 0, 0, NETWORK_HEADER + 8),
            (JUMP_IF_EQUAL, 0, 3, high),
            (LOAD_WORD, 0, 0, NETWORK_HEADER + 12),
            *_drop_unless_other(low),
        ]
    kept = (RETURN, 0, 0, WHOLE)
    return [
        (LOAD_BYTE, 0, 0, NETWORK_HEADER),
        (SHIFT_RIGHT, 0, 0, 4),
        (JUMP_IF_EQUAL, 0, len(four) + 1, 4),
        *four,
        kept,
        *six,
        kept,
    ]


def _drop_unless_other(word: int) -> tuple[Instruction, Instruction]:
    return (JUMP_IF_EQUAL, 0, 1, word), (RETURN, 0, 0, NOTHING)


def keep_silent_out(port: int) -> int:
    """Have the kernel keep connections to ``port`` to itself until their peer says something.

    A client that speaks TLS or HTTP/2 speaks first. Returns how many listening sockets there are.
    """
    listening = 0
    for each in _listening(port):
        each.setsockopt(socket.IPPROTO_TCP, socket.TCP_DEFER_ACCEPT, SILENT_S)
        listening += 1
    return listening


def _listening(port: int) -> Iterator[socket.socket]:
    for descriptor in _descriptors():
        with suppress(OSError), _duplicate(descriptor) as duplicate:
            is_own = duplicate.family in INTERNET and duplicate.getsockname()[1] == port
            if is_own and duplicate.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN):
                yield duplicate


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
            if duplicate.getsockname()[1] == port:
                host, source_port = duplicate.getpeername()[:2]  # of a listening socket: OSError
                info = duplicate.getsockopt(
                    socket.IPPROTO_TCP, socket.TCP_INFO, BYTES_RECEIVED.size
                )
                (received,) = BYTES_RECEIVED.unpack(info)
                yield Connection(
                    descriptor, inode, source_of(host), peer_name(host, source_port), received
                )


def peer_name(host: str, port: int) -> str:
    """Return the peer of a connection as gRPC's contexts name it: ``ipv4:192.0.2.7:4711``, or
    ``ipv6:%5B2001:db8::1%5D:4711``."""
    ip = ipaddress.ip_address(host.partition("%")[0])
    mapped = ip if isinstance(ip, IPv4Address) else ip.ipv4_mapped
    return f"ipv6:%5B{quote(host, ':')}%5D:{port}" if mapped is None else f"ipv4:{mapped}:{port}"


def _source_of_peer(peer: str) -> str:
    host = unquote(peer).partition(":")[2].rpartition(":")[0]
    return source_of(host.strip("[]"))


def _shut(connection: Connection) -> bool:
    """End a connection, unless its descriptor is another socket's by now; say whether it was.

    What came in and was not read yet is thrown away: the kernel would still hand it out.
    """
    is_ended = False
    with suppress(OSError), _duplicate(connection.descriptor) as duplicate:
        if _inode(duplicate.fileno()) == connection.inode:
            duplicate.shutdown(socket.SHUT_RDWR)
            is_ended = True
            while duplicate.recv(UNEXPLAINED_BYTES, socket.MSG_DONTWAIT | socket.MSG_TRUNC):
                pass
    return is_ended


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
