"""A wire between network namespaces that loses and delays IP packets, at a limited rate.

Two TUN devices with this process between them, so the kernels' own TCP meets the loss, as it does
on a road: ``python -m lab.tcp.wire NEAR FAR SUBNET LOSS_PERCENT RTT_MS RATE_MBPS``. The near
end gets the address SUBNET.1, the far one SUBNET.2. Losses are independent, of a given seed; both
directions are alike; a full queue (64 KiB) drops what comes.
"""

from __future__ import annotations

import fcntl
import os
import random
import select
import struct
import subprocess
import sys
import time

from rfcore.link.shaper import Link, LinkProfile

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


class Direction:
    """Packets from one device to the other."""

    def __init__(self, source: int, sink: int, profile: LinkProfile, loss: float, seed: str):
        self.source = source
        self._sink = sink
        self._loss = loss
        self._rng = random.Random(seed)
        self._link: Link[bytes] = Link(profile)

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


def forward(near: int, far: int, loss: float, profile: LinkProfile) -> None:
    """Forward for ever."""
    ways = (
        Direction(near, far, profile, loss, f"{SEED} up"),
        Direction(far, near, profile, loss, f"{SEED} down"),
    )
    while True:
        wait_s = min(way.next_s() for way in ways) - time.monotonic()
        select.select([near, far], [], [], min(max(0.0, wait_s), 1.0))
        for way in ways:
            way.take(time.monotonic())
            way.give(time.monotonic())


def main(near: str, far: str, subnet: str, loss_percent: str, rtt_ms: str, rate_mbps: str) -> None:
    names = [f"rfl{os.getpid()}{end}" for end in "nf"]
    ends = [open_tun(name) for name in names]
    place(names[0], near, f"{subnet}.1", f"{subnet}.2")
    place(names[1], far, f"{subnet}.2", f"{subnet}.1")
    print("ready", flush=True)
    profile = LinkProfile(1e6 * float(rate_mbps), float(rtt_ms) / 2e3)
    forward(ends[0], ends[1], float(loss_percent) / 100, profile)


if __name__ == "__main__":
    main(*sys.argv[1:])
