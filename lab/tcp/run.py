"""Sends over the kernel's TCP and over the model, the same bytes over the same link."""

from __future__ import annotations

import ctypes
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from random import Random
from typing import Any, TypeVar

import numpy as np
from rich.console import Console

from lab.report import Report
from lab.tcp import EvalTcp
from lab.tcp.wire import checked, wired
from rfcore.errors import RfedgeError
from rfcore.link.lossy import LossyLink, PacketLoss
from rfcore.link.shaper import Connection, Link, LinkProfile
from rfedge.report.tables import Table, columns, print_tables, shown
from rfedge.results import Result, make_result, provenance, rows_of, write_result

NEAR, FAR, SUBNET = "10.216.0.1", "10.216.0.2", "10.216.0"
LONGER = 10
"""The model is run for so many times the kernel's seconds: its figures have no noise of a run."""
CHUNK_BYTES = 16_384
CLONE_NEWNET = 0x40000000
LIBC = ctypes.CDLL(None, use_errno=True)
Made = TypeVar("Made")


@dataclass(frozen=True)
class TcpRow:
    """One link: what passed of an endless stream, and how long messages took, in ms."""

    rate_mbps: float = field(metadata=shown("link Mbit/s", "g"))
    loss_percent: float = field(metadata=shown("loss %", "g"))
    sender: str = field(metadata=shown("TCP"))
    bulk_mbps: float = field(metadata=shown("passes Mbit/s", ".2f"))
    p50_ms: float = field(metadata=shown("message p50 ms", ".0f"))
    p90_ms: float = field(metadata=shown("p90", ".0f"))
    p99_ms: float = field(metadata=shown("p99", ".0f"))
    messages: int = field(metadata=shown("messages"))


def run_tcp(job: EvalTcp) -> dict[str, Any]:
    """Measure every cell, write the result and print it."""
    made, console, rows = provenance(), Console(), list[TcpRow]()
    if os.geteuid() != 0:
        raise RfedgeError("network namespaces need root: run this command as root")
    for rate_mbps in job.rates_mbps:
        for loss_percent in job.losses:
            for sender, measure in (("kernel", _by_kernel), ("model", _by_model)):
                bulk_mbps, latencies_s = measure(job, rate_mbps, loss_percent)
                p50, p90, p99 = (1e3 * np.percentile(latencies_s, (50, 90, 99))).tolist()
                row = TcpRow(
                    rate_mbps, loss_percent, sender, bulk_mbps, p50, p90, p99, len(latencies_s)
                )
                rows.append(row)
                console.print(f"  {rate_mbps:g} Mbit/s, {loss_percent:g} %: {sender} done")
    content = {
        "rtt_ms": job.rtt_ms,
        "message_bytes": job.size,
        "hz": job.hz,
        "connections": job.connections,
        "rows": rows,
    }
    result = make_result("tcp", made, content)
    write_result(job.out, result)
    print_tables(tcp_parts(result), console)
    return result


def tcp_parts(result: Result) -> Iterator[Table | str]:
    """Yield the model beside the kernel."""
    yield (
        f"CUBIC, round trip {result['rtt_ms']:g} ms, a queue of 64 KiB, packets lost in both "
        "directions, each by itself. First an endless stream; then messages of "
        f"{result['message_bytes']} bytes at {result['hz']:g} Hz over each of "
        f"{result['connections']} connections that share the link, from writing to the last byte. "
        f"The kernel is {result['host']['os']}; its losses are nft's."
    )
    yield Table("The model beside the kernel", columns(TcpRow), rows_of(TcpRow, result["rows"]))


# --- the model


def _by_model(job: EvalTcp, rate_mbps: float, loss_percent: float) -> tuple[float, list[float]]:
    length_s = LONGER * job.seconds
    link, got_bytes, now = _model(job, rate_mbps, loss_percent, "bulk"), 0, 0.0
    while now < length_s:
        while not link.is_full(now):
            link.push(CHUNK_BYTES, CHUNK_BYTES, now)
        now = link.next_event_at() or 0.0
        got_bytes += sum(sum(delivery.item) for delivery in link.pop_due(now))
    link, latencies_s = _model(job, rate_mbps, loss_percent, "messages"), list[float]()
    connections = [Connection() for _ in range(job.connections)]

    def pass_until(now: float) -> None:
        while (due_s := link.next_event_at()) is not None and due_s <= now:
            for delivery in link.pop_due(due_s):
                latencies_s.extend(delivery.due_s - sent_s for sent_s in delivery.item)

    for number in range(round(length_s * job.hz)):
        for phase, connection in enumerate(connections):
            now = (number + phase / job.connections) / job.hz
            pass_until(now)
            link.push(now, job.size, now, connection)
    pass_until(float("inf"))
    return 8e-6 * got_bytes / length_s, latencies_s


def _model(job: EvalTcp, rate_mbps: float, loss_percent: float, name: str) -> LossyLink[Any]:
    delay_s, loss = job.rtt_ms / 2e3, PacketLoss(loss_percent)
    up, down = (loss.losses(Random(f"{name}/{way}")) for way in ("up", "down"))
    return LossyLink(Link(LinkProfile(1e6 * rate_mbps, delay_s)), up, delay_s, down)


# --- the kernel


def _by_kernel(job: EvalTcp, rate_mbps: float, loss_percent: float) -> tuple[float, list[float]]:
    with _wire(job, rate_mbps, loss_percent) as (near, far):
        listener = _within(far, lambda: socket.create_server((FAR, 0)))
        with listener:
            bulk_mbps = _bulk(near, listener, job.seconds)
            with ThreadPoolExecutor(job.connections) as threads:
                starts = [phase / job.connections / job.hz for phase in range(job.connections)]
                ends = [_connected(near, listener) for _ in starts]
                sent = threads.map(partial(_messages, job), ends, starts)
                return bulk_mbps, [latency_s for each in sent for latency_s in each]


def _connected(near: str, listener: socket.socket) -> tuple[socket.socket, socket.socket]:
    def connect() -> socket.socket:
        made = socket.socket()
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, b"cubic")
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        made.connect(listener.getsockname())
        return made

    sender = _within(near, connect)
    return sender, listener.accept()[0]


def _bulk(near: str, listener: socket.socket, seconds: float) -> float:
    """Return how much passes, in Mbit/s."""
    sender, receiver = _connected(near, listener)
    ended = threading.Event()

    def send() -> None:
        sender.settimeout(1.0)
        while not ended.is_set():
            try:
                sender.send(bytes(CHUNK_BYTES))
            except TimeoutError:
                continue

    sending = threading.Thread(target=send)
    sending.start()
    got_bytes, end_s = 0, time.monotonic() + seconds
    receiver.settimeout(1.0)
    while time.monotonic() < end_s:
        try:
            got_bytes += len(receiver.recv(CHUNK_BYTES))
        except TimeoutError:
            continue
    ended.set()
    sending.join()
    for end in (sender, receiver):
        end.close()
    return 8e-6 * got_bytes / seconds


def _messages(
    job: EvalTcp, ends: tuple[socket.socket, socket.socket], start_s: float
) -> list[float]:
    """Send messages at their rate; return from writing to the last byte of each."""
    sender, receiver = ends
    began_s, count = time.monotonic() + start_s, round(job.seconds * job.hz)
    sent_s: list[float] = []

    def send() -> None:
        for number in range(count):
            time.sleep(max(0.0, began_s + number / job.hz - time.monotonic()))
            sent_s.append(time.monotonic())
            sender.sendall(bytes(job.size))

    sending = threading.Thread(target=send)
    sending.start()
    latencies_s: list[float] = []
    for number in range(count):
        left = job.size
        while left:
            left -= len(receiver.recv(left))
        latencies_s.append(time.monotonic() - sent_s[number])
    sending.join()
    for end in ends:
        end.close()
    return latencies_s


@contextmanager
def _wire(job: EvalTcp, rate_mbps: float, loss_percent: float) -> Iterator[tuple[str, str]]:
    """Yield two new network namespaces with a wire between them, on which nft drops packets."""
    with wired(SUBNET, 0.0, job.rtt_ms, [rate_mbps]) as wire:
        for name in (wire.near, wire.far) if loss_percent else ():
            lose = f"numgen random mod 1000000 < {round(1e4 * loss_percent)} drop"
            hook = "{ type filter hook input priority 0 ; }"
            add = ("table inet loss", f"chain inet loss in {hook}", f"rule inet loss in {lose}")
            rules = "".join(f"add {each}\n" for each in add)
            checked("ip", "netns", "exec", name, "nft", rules)
        yield wire.near, wire.far


def _within(namespace: str, make: Callable[[], Made]) -> Made:
    """Call ``make`` on a thread that lives in ``namespace``; sockets made there stay there."""
    with ThreadPoolExecutor(1) as thread:
        thread.submit(_enter, namespace).result()
        return thread.submit(make).result()


def _enter(namespace: str) -> None:
    with Path(f"/run/netns/{namespace}").open("rb") as handle:
        if LIBC.setns(handle.fileno(), CLONE_NEWNET):
            raise OSError(ctypes.get_errno(), f"setns {namespace}")


REPORT = Report(
    "tcp",
    "TCP over lost packets",
    "How the model of `rfedge link` compares with a kernel's TCP: throughput and delays.",
    tcp_parts,
)
