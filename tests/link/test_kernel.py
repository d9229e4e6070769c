"""The link against the kernel's own: token buckets (tc tbf) between network namespaces.

Needs root, ``ip`` and ``tc`` (make test-system-packages). The kernel counts Ethernet frames, so a
datagram of n bytes is n + 42 long on its wire; its bucket lets a burst of 1600 bytes ahead, which
the machine, an exact serialiser, does not.
"""

import asyncio
import ctypes
import json
import math
import os
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from typing import TypeVar

import numpy as np
import pytest

from namespaces import Wire, connected, require, run, within
from rfcore.link.plan import Arrival, delivery_times
from rfcore.link.shaper import LinkProfile
from rfedge.link import LinkSettings
from rfedge.link.proxy import LinkProxy

pytestmark = [pytest.mark.slow, pytest.mark.netns]

RATE_BPS = 2e6
BURST_BYTES = 1600
OVERHEAD_BYTES = 14 + 20 + 8
CLONE_NEWNET = 0x40000000
SO_TIMESTAMPNS = 35
LIBC = ctypes.CDLL(None, use_errno=True)
Result = TypeVar("Result")


def made_within(namespace: str, make: Callable[[], Result]) -> Result:
    """Call ``make`` on a thread that lives in ``namespace``; sockets made there stay there."""
    made: list[Result | BaseException] = []

    def enter() -> None:
        handle = os.open(f"/run/netns/{namespace}", os.O_RDONLY)
        try:
            if LIBC.setns(handle, CLONE_NEWNET):
                raise OSError(ctypes.get_errno(), "setns")
            made.append(make())
        except BaseException as error:  # carried to the thread that asked
            made.append(error)
        finally:
            os.close(handle)

    thread = threading.Thread(target=enter)
    thread.start()
    thread.join()
    if isinstance(made[0], BaseException):
        raise made[0]
    return made[0]


def sent_bytes(wire: Wire) -> int:
    """Return what left the near end so far, as the kernel counts it."""
    shown = run(*within(wire.near), *["tc", "-s", "-j", "qdisc", "show", "dev", "rfnear"])
    return int(next(q for q in json.loads(shown) if q["kind"] == "tbf")["bytes"])


@pytest.fixture
def wire() -> Iterator[Wire]:
    """Two namespaces; from the near one on the wire is shaped."""
    require("ip", "tc")
    with connected() as ends:
        bucket = f"rate {RATE_BPS:.0f}bit burst {BURST_BYTES} limit 10000000"
        run(*within(ends.near), *f"tc qdisc add dev rfnear root tbf {bucket}".split())
        yield ends


def udp(address: str) -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
    made.bind((address, 0))
    made.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    made.settimeout(20.0)
    return made


def stamp_s(sock: socket.socket) -> float:
    """Receive a datagram; return when the kernel did, in seconds of the Unix epoch."""
    _, ancillary, _, _ = sock.recvmsg(2048, 64)
    seconds, nanoseconds = struct.unpack("qq", ancillary[0][2])
    return float(seconds + nanoseconds / 1e9)


def test_datagrams_leave_the_kernels_bucket_when_the_machine_says(wire: Wire) -> None:
    """Bursts with rests between; the bucket's head start is the only difference allowed.

    A token bucket lets burst bytes through at once, so the kernel may lead by burst / rate, and
    never by more. A busy machine can only make it later (a sender put aside between reading the
    clock and sending delays its whole burst), so the least disturbed burst is the one to compare.
    """
    bursts = 10
    heard_s, sent = _send_bursts(wire, bursts, every_s=0.3)
    predicted_s = delivery_times(LinkProfile(RATE_BPS), sent)
    lead_s = BURST_BYTES * 8 / RATE_BPS
    late_s = np.subtract(heard_s, predicted_s).reshape(bursts, -1)
    assert late_s.min() >= -lead_s - 0.001
    quietest = int(np.argmin(np.median(late_s, axis=1)))
    assert np.median(late_s[quietest]) <= 0.002
    heard, predicted = (
        np.reshape(times, (bursts, -1))[quietest] for times in (heard_s, predicted_s)
    )
    slope = (heard[-1] - heard[4]) / (predicted[-1] - predicted[4])
    assert slope == pytest.approx(1.0, abs=0.02)


def _send_bursts(wire: Wire, count: int, every_s: float) -> tuple[list[float], list[Arrival]]:
    """Send ``count`` bursts of 40 datagrams; return when each was heard, and what was sent when."""
    near = made_within(wire.near, lambda: udp(wire.near_address))
    far = made_within(wire.far, lambda: udp(wire.far_address))
    near.connect(far.getsockname())
    heard_s: list[float] = []

    def hear() -> None:
        while len(heard_s) < count * 40:
            heard_s.append(stamp_s(far))

    listener = threading.Thread(target=hear)
    listener.start()
    begin_s, sent = time.time(), []
    for burst in range(count):
        time.sleep(max(0.0, begin_s + every_s * burst - time.time()))
        for size_bytes in (200, 1000, 1400, 600) * 10:
            sent.append(Arrival(time.time() - begin_s, size_bytes + OVERHEAD_BYTES))
            near.send(bytes(size_bytes))
    listener.join()
    near.close()
    far.close()
    return [heard - begin_s for heard in heard_s], sent


async def test_the_proxy_takes_as_long_as_the_kernel_for_the_same_bytes(wire: Wire) -> None:
    """Seconds a byte on the wire, of TCP transfers through each; the least disturbed of three."""
    size_bytes = 200_000
    kernel_s_per_byte = proxy_s_per_byte = math.inf
    for _ in range(3):
        before_bytes = sent_bytes(wire)
        kernel_s = await asyncio.to_thread(_transfer, wire, size_bytes)
        kernel_s_per_byte = min(kernel_s_per_byte, kernel_s / (sent_bytes(wire) - before_bytes))
        proxy_s_per_byte = min(proxy_s_per_byte, await _through_proxy(size_bytes) / size_bytes)
    assert kernel_s_per_byte == pytest.approx(8 / RATE_BPS, rel=0.03)
    assert proxy_s_per_byte == pytest.approx(kernel_s_per_byte, rel=0.05)


def _transfer(wire: Wire, size_bytes: int) -> float:
    """Return how long TCP takes through the kernel's bucket, from the first byte on."""
    listener = made_within(wire.far, lambda: socket.create_server((wire.far_address, 0)))
    near = made_within(wire.near, lambda: socket.create_connection(listener.getsockname(), 10))
    far, _ = listener.accept()
    sender = threading.Thread(target=near.sendall, args=(bytes(size_bytes),))
    begin_s = time.perf_counter()
    sender.start()
    left = size_bytes
    while left:
        left -= len(far.recv(65536))
    took_s = time.perf_counter() - begin_s
    sender.join()
    for open_socket in (near, far, listener):
        open_socket.close()
    return took_s


async def _through_proxy(size_bytes: int) -> float:
    loop = asyncio.get_running_loop()
    done: asyncio.Future[float] = loop.create_future()

    async def sink(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readexactly(size_bytes)
        done.set_result(loop.time())
        writer.close()

    server = await asyncio.start_server(sink, "127.0.0.1", 0)
    address = f"127.0.0.1:{server.sockets[0].getsockname()[1]}"
    proxy = LinkProxy(LinkSettings(address, uplink_bps=RATE_BPS, delay_ms=0.0))
    await proxy.start()
    _, writer = await asyncio.open_connection(proxy.address.host, proxy.address.port)
    begin_s = loop.time()
    writer.write(bytes(size_bytes))
    took_s = await done - begin_s
    writer.close()
    await proxy.stop()
    server.close()
    return took_s
