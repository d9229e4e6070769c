"""A wire between network namespaces that loses and delays IP packets, at a limited rate.

Two TUN devices with this process between them, so the kernels' own TCP meets the loss, as it does
on a road: ``python -m lab.tcp.wire NEAR FAR SUBNET LOSS_PERCENT RTT_MS RATE_MBPS ...``. The near
end gets the address SUBNET.1, the far one SUBNET.2. Losses are independent, of a given seed; both
directions are alike; a full queue (64 KiB) drops what comes. SIGUSR1 takes the next rate, for
packets that come from then on.
"""

from __future__ import annotations

import fcntl
import os
import random
import select
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

from rfcore.errors import RfedgeError
from rfcore.link.shaper import Link, LinkParts, LinkProfile

TUNSETIFF, IFF_TUN, IFF_NO_PI = 0x400454CA, 0x1, 0x1000  # linux/if_tun.h
MTU_BYTES = 1500
SEED = 20261122


def open_tun(name: str) -> int:
    """Return the descriptor of a new TUN device; it goes with its last descriptor."""
    tun = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(tun, TUNSETIFF, struct.pack("16sH", name.encode(), IFF_TUN | IFF_NO_PI))
    return tun


def place(name: str, namespace: str, address: str, peer: str) -> None:
    """Move a device into a namespace and give it an address."""
    for command in (
        f"link set {name} netns {namespace}",
        f"-n {namespace} addr add {address} peer {peer} dev {name}",
        f"-n {namespace} link set {name} mtu {MTU_BYTES} up",
    ):
        subprocess.run(["ip", *command.split()], check=True)


class SteppedRate:
    """Transmits at the first of some rates; ``step`` takes the next."""

    def __init__(self, rates_bps: Sequence[float]) -> None:
        self._rates_bps = list(rates_bps)
        self._busy_until_s = float("-inf")

    def step(self) -> None:
        """Take the next rate; the last one stays."""
        if len(self._rates_bps) > 1:
            self._rates_bps.pop(0)

    def schedule(self, size_bytes: int, at_s: float) -> tuple[float, float]:
        """Return start and end of transmission."""
        start_s = max(at_s, self._busy_until_s)
        self._busy_until_s = start_s + 8 * size_bytes / self._rates_bps[0]
        return start_s, self._busy_until_s


class Direction:
    """Packets from one device to the other."""

    def __init__(self, ends: tuple[int, int], made: Link[bytes], loss: float, seed: str) -> None:
        self.source, self._sink = ends
        self._loss = loss
        self._rng = random.Random(seed)
        self._link = made

    def take(self, now: float) -> None:
        """Read what came; lose some."""
        while True:
            try:
                packet = os.read(self.source, MTU_BYTES)
            except BlockingIOError:
                return
            if self._rng.random() >= self._loss and not self._link.is_full(now):
                self._link.push(packet, len(packet), now)

    def give(self, now: float) -> None:
        """Write what is due."""
        for delivery in self._link.pop_due(now):
            os.write(self._sink, delivery.item)

    def next_s(self) -> float:
        """Return when the next packet is due."""
        due_s = self._link.next_event_at()
        return float("inf") if due_s is None else due_s


def forward(ways: Sequence[Direction]) -> None:
    """Forward for ever."""
    while True:
        wait_s = min(way.next_s() for way in ways) - time.monotonic()
        select.select([way.source for way in ways], [], [], min(max(0.0, wait_s), 1.0))
        for way in ways:
            way.take(time.monotonic())
            way.give(time.monotonic())


@dataclass(frozen=True)
class Wire:
    """Two network namespaces, and the process between them."""

    near: str
    far: str
    process: subprocess.Popen[bytes]

    def step(self) -> None:
        """Take the next rate."""
        self.process.send_signal(signal.SIGUSR1)

    def sent_bytes(self) -> int:
        """Return the bytes of the IP packets that the near end has sent."""
        command = (
            "ip",
            "netns",
            "exec",
            self.near,
            "cat",
            f"/sys/class/net/{self._device}/statistics/tx_bytes",
        )
        return int(checked(*command))

    @property
    def _device(self) -> str:
        return f"rfl{self.process.pid}n"


@contextmanager
def wired(
    subnet: str, loss_percent: float, rtt_ms: float, rates_mbps: Sequence[float]
) -> Iterator[Wire]:
    """Yield two new network namespaces with a wire between them; raise ``RfedgeError`` if none is.

    Needs root. The wire has real-time priority: it stands for a network.
    """
    near, far = (f"rftcp{os.getpid()}{end}" for end in "nf")
    with ExitStack() as stack:
        for name in (near, far):
            checked("ip", "netns", "add", name)
            stack.callback(checked, "ip", "netns", "del", name)
            checked("ip", "-n", name, "link", "set", "lo", "up")
        numbers = map(str, (loss_percent, rtt_ms, *rates_mbps))
        words = [sys.executable, "-m", "lab.tcp.wire", near, far, subnet, *numbers]
        process = stack.enter_context(subprocess.Popen(words, stdout=subprocess.PIPE))
        stack.callback(process.kill)
        assert process.stdout is not None
        if process.stdout.readline() != b"ready\n":
            raise RfedgeError("the wire between the namespaces could not be made")
        os.sched_setscheduler(process.pid, os.SCHED_FIFO, os.sched_param(1))
        yield Wire(near, far, process)


def checked(*command: str) -> str:
    """Run a command; return what it prints, or raise ``RfedgeError`` with what it says."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RfedgeError(f"{' '.join(command)}: {done.stderr.strip()}")
    return done.stdout


def main(
    near: str, far: str, subnet: str, loss_percent: str, rtt_ms: str, *rates_mbps: str
) -> None:
    names = [f"rfl{os.getpid()}{end}" for end in "nf"]
    ends = [open_tun(name) for name in names]
    place(names[0], near, f"{subnet}.1", f"{subnet}.2")
    place(names[1], far, f"{subnet}.2", f"{subnet}.1")
    rates_bps = [1e6 * float(each) for each in rates_mbps]
    profile = LinkProfile(rates_bps[0], float(rtt_ms) / 2e3)
    rates = (SteppedRate(rates_bps), SteppedRate(rates_bps))
    loss = float(loss_percent) / 100
    ways = [
        Direction((source, sink), Link(profile, LinkParts(rate)), loss, f"{SEED} {name}")
        for source, sink, rate, name in (
            (ends[0], ends[1], rates[0], "up"),
            (ends[1], ends[0], rates[1], "down"),
        )
    ]

    def step(*_: object) -> None:
        for rate in rates:
            rate.step()

    signal.signal(signal.SIGUSR1, step)
    print("ready", flush=True)
    forward(ways)


if __name__ == "__main__":
    main(*sys.argv[1:])
