"""Links that go silent, and links that collapse."""

import asyncio
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from namespaces import Wire, connected, require, run, within

SILENT_S = 10.0
CALM_S = 3.0


def cut(wire: Wire) -> float:
    """Let nothing through any more, and nobody know; return when."""
    far = within(wire.far)
    run(*far, "nft", "add", "table", "inet", "cut")
    for hook, device in (("input", "iifname"), ("output", "oifname")):
        run(*far, "nft", f"add chain inet cut {hook} {{ type filter hook {hook} priority 0 ; }}")
        run(*far, "nft", f'add rule inet cut {hook} {device} "rffar" drop')
    return time.time()


def heal(wire: Wire) -> float:
    """Let everything through again; return when."""
    run(*within(wire.far), "nft", "delete", "table", "inet", "cut")
    return time.time()


@pytest.fixture
def wire() -> Iterator[Wire]:
    require("ip", "nft")
    with connected() as ends:
        yield ends


async def test_a_silent_partition(wire: Wire, site: Any, case: Any, appears: Any) -> None:
    case.about("silent partition of 10 s", "nft drop between network namespaces, both ways", "F4")
    reachable = ("--allow-insecure", "--decoder", "in-process")
    server = await site.server(*reachable, listen=f"{wire.far_address}:0", within=within(wire.far))
    bystander = await site.vehicle(
        server.address, "bystander", "--allow-insecure", within=within(wire.far)
    )
    victim = await site.vehicle(
        server.address, "cav-1", "--allow-insecure", within=within(wire.near)
    )
    await case.calm()
    cut_s = cut(wire)
    await appears(lambda: victim.entries("stream lost"))
    case.at_most("noticed", time.time() - cut_s, 1.5)
    await asyncio.sleep(max(0.0, cut_s + SILENT_S - time.time()))
    healed_s = heal(wire)
    await appears(lambda: len(victim.acked(healed_s)) >= 6)
    case.over()
    case.at_most("stream back after healing", victim.acked_at_s(healed_s)[0] - healed_s, 2)
    old = [x for x in victim.lines() if cut_s < x["capture_time_ns"] / 1e9 < healed_s - 1.0]
    case.holds("nothing from meanwhile is sent", all(x["result"] != "acked" for x in old))
    case.recovers_exactly(victim, healed_s)
    await case.spares(bystander)
    case.finish()


async def test_a_link_that_flaps(wire: Wire, site: Any, case: Any, appears: Any) -> None:
    case.about("link down for 1 s, every 3 s", "ip link set down and up, three times", "F5")
    reachable = ("--allow-insecure", "--decoder", "in-process")
    far, near = within(wire.far), within(wire.near)
    server = await site.server(*reachable, listen=f"{wire.far_address}:0", within=far)
    bystander = await site.vehicle(server.address, "bystander", "--allow-insecure", within=far)
    victim = await site.vehicle(server.address, "cav-1", "--allow-insecure", within=near)
    await case.calm()
    back_s = []
    for _ in range(3):
        run(*near, "ip", "link", "set", "rfnear", "down")
        await asyncio.sleep(1.0)
        run(*near, "ip", "link", "set", "rfnear", "up")
        up_s = time.time()
        await appears(lambda since=up_s: victim.acked(since))
        back_s.append(victim.acked_at_s(up_s)[0] - up_s)
        await asyncio.sleep(2.0)
    case.over()
    case.at_most("slowest return of the stream", max(back_s), 2)
    epochs = [x["epoch"] for x in victim.acked()]
    case.holds("epochs only grow", epochs == sorted(epochs))
    await case.spares(bystander)
    case.finish()


class Middlebox:
    """Forwards bytes until it is told to be silent; connections stay open, and look healthy."""

    def __init__(self, to: str) -> None:
        self.open = asyncio.Event()
        self.open.set()
        host, _, port = to.rpartition(":")
        self._to = (host, int(port))
        self.tasks: set[asyncio.Task[None]] = set()

    async def accept(self, near: asyncio.StreamReader, back: asyncio.StreamWriter) -> None:
        await self.open.wait()
        far, there = await asyncio.open_connection(*self._to)
        for reader, writer in ((near, there), (far, back)):
            task = asyncio.create_task(self._pump(reader, writer))
            self.tasks.add(task)

    async def _pump(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while data := await reader.read(65536):
                await self.open.wait()
                writer.write(data)
                await writer.drain()
        except OSError:
            pass
        finally:
            writer.close()


@asynccontextmanager
async def middlebox(to: str) -> AsyncIterator[tuple[Middlebox, str]]:
    box = Middlebox(to)
    listener = await asyncio.start_server(box.accept, "127.0.0.1", 0)
    port = listener.sockets[0].getsockname()[1]
    try:
        yield box, f"127.0.0.1:{port}"
    finally:
        listener.close()
        for task in box.tasks:
            task.cancel()
        await asyncio.gather(*box.tasks, return_exceptions=True)


async def test_a_middlebox_that_forwards_nothing(site: Any, case: Any, appears: Any) -> None:
    """Every byte is acknowledged here, so only frames that nobody answers tell."""
    case.about(
        "middlebox that forwards nothing for 10 s", "a TCP proxy, connections left open", "F4"
    )
    server = await site.server()
    bystander = await site.vehicle(server.address, "bystander")
    async with middlebox(server.address) as (box, address):
        victim = await site.vehicle(address, "cav-1")
        await case.calm()
        box.open.clear()
        cut_s = time.time()
        await appears(lambda: victim.entries("stream lost"))
        case.at_most("noticed", time.time() - cut_s, 1.5)
        await asyncio.sleep(max(0.0, cut_s + SILENT_S - time.time()))
        box.open.set()
        healed_s = time.time()
        await appears(lambda: len(victim.acked(healed_s)) >= 6)
        case.over()
        case.at_most("stream back after healing", victim.acked_at_s(healed_s)[0] - healed_s, 2)
        case.recovers_exactly(victim, healed_s)
        await case.spares(bystander)
    case.finish()


def write_collapse(folder: Path, good_s: float, bad_s: float) -> Path:
    """Write a link that is 10 Mbit/s, then 0.3 Mbit/s, and so on: packets of 1500 bytes, in ms."""
    good = [f"{round(i * 1.2)}" for i in range(1, round(good_s / 0.0012))]
    bad = [f"{round(good_s * 1e3 + i * 40)}" for i in range(1, round(bad_s / 0.040) + 1)]
    (folder / "collapse.up").write_text("\n".join([*good, *bad]) + "\n")
    path = folder / "collapse.toml"
    path.write_text(
        'description = "collapse"\nseed = 1\n[uplink]\ndelay_ms = 5.0\n'
        '[uplink.trace]\nfile = "collapse.up"\n[downlink]\nrate_mbps = 10.0\ndelay_ms = 5.0\n'
    )
    return path


async def test_a_collapse_of_the_rate(site: Any, case: Any, appears: Any, tmp_path: Path) -> None:
    case.about(
        "rate collapse 10 -> 0.3 Mbit/s for 6 s", "rfedge link with a trace; CRF 1, 20 Hz", "F8"
    )
    server = await site.server()
    bystander = await site.vehicle(server.address, "bystander")
    ready = tmp_path / "link-ready"
    good_s, bad_s = 8.0, 6.0
    profile = write_collapse(tmp_path, good_s, bad_s)
    link = ["link", "--to", server.address, "--profile", str(profile), "--ready-file", str(ready)]
    process = subprocess.Popen([sys.executable, "-c", "from rfedge.cli import main; main()", *link])
    try:
        await appears(ready.exists)
        began_s = time.time()
        victim = await site.vehicle(ready.read_text().strip(), "cav-1", "--crf", "1")
        period_s = good_s + bad_s
        calm_s = began_s + good_s - CALM_S - 0.2
        while calm_s < time.time():  # the trace begins again and again
            calm_s, began_s = calm_s + period_s, began_s + period_s
        await asyncio.sleep(calm_s - time.time())
        await case.calm()
        await asyncio.sleep(bad_s)
        case.over()
        up_s = began_s + period_s
        await appears(lambda: len(victim.acked(up_s + 0.5)) >= 20)
        acked = victim.acked()
        bad = [x for x in acked if 0 < x["capture_time_ns"] / 1e9 - began_s - good_s < bad_s - 1]
        size = max(x["packet_bytes"] for x in bad)
        # Two frames may be under way, and one more waits for the encoder.
        window_s = 3 * 8 * size / 0.3e6 + 0.5
        case.at_most("age of an answered frame", max(x["latency_ms"] for x in bad) / 1e3, window_s)
        case.holds("frames go on", len(bad) >= 6)
        case.holds("stream kept", victim.entries("stream lost") == [])
        after = sorted(x["latency_ms"] for x in victim.acked(up_s + 1.0))
        case.at_most("median age 1 s after", after[len(after) // 2] / 1e3, 0.1)
        lost = [x for x in victim.lines() if x["result"] in ("lost", "nacked")]
        case.holds("dropped only before encoding", lost == [])
        exact = all(x["server_digest"] == x["reconstruction_digest"] for x in acked)
        case.holds("pictures exact", exact)
        await case.spares(bystander)
    finally:
        process.kill()
        process.wait()
    case.finish()
