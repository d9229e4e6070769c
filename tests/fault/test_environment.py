"""Trouble from outside the server: disks, files, certificates, consumers, a crowd of vehicles."""

import asyncio
import signal
import subprocess
import time
from collections import Counter
from contextlib import AsyncExitStack
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import grpc
import pytest

from live_server import tls_options
from rfcore.wire.conventions import CHANNEL_OPTIONS, STREAM_METHOD
from rfcore.wire.convert import hello_to_bytes
from rfcore.wire.twin import PictureEncoding, Subscription, subscription_to_wire
from rfcore.wire.v1 import twin_pb2_grpc
from rfedge.certs import Members, certify, write_certificates

STORM = 200
ADMITTED = 64
LISTED_S = 20.0
STORM_S = 6.0
"""Long enough for a 99th percentile, with those who were admitted staying."""


@pytest.mark.usefixtures("as_root")
async def test_a_full_disk(site: Any, case: Any, appears: Any, tmp_path: Path) -> None:
    case.about("disk full", "recording to a tmpfs of 64 KiB", "F19")
    small = tmp_path / "small"
    small.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", small], check=True)
    try:
        server = await site.server("--record", str(small))
        bystander = site.start_vehicle(server.address, "bystander", "--allow-recording")
        await appears(lambda: server.entries("recording stopped, streaming goes on"))
        full_s = time.time()
        await appears(lambda: len(bystander.acked(full_s)) >= 10)
        case.holds("streaming goes on", True)
        case.holds(
            "recording stops, once in the log",
            len(server.entries("recording stopped, streaming goes on")) == 1,
        )
        case.holds("metric says so", server.value("rfedge_server_recording") == 0)
        whole = [p for p in small.rglob("*.png") if p.stat().st_size == 0]
        case.holds("no half picture is left", whole == [])
        lines = bystander.lines()
        case.holds("no frame lost or refused", {x["result"] for x in lines} <= {"acked", "dropped"})
        case.holds(
            "pictures exact",
            all(x["server_digest"] == x["reconstruction_digest"] for x in bystander.acked()),
        )
    finally:
        site.close()
        subprocess.run(["umount", small], check=True)
    case.finish()


async def test_a_damaged_field(
    site: Any, street: Any, case: Any, coded: Any, raw_vehicle: Any, tmp_path: Path
) -> None:
    case.about("field file damaged", "a bit flipped, cut in half, under a server that runs", "F20")
    store = tmp_path / "store"
    store.mkdir()
    for path in street.store.glob("*.rff"):
        (store / path.name).write_bytes(path.read_bytes())
    server = await site.server("--fields", str(store))
    bystander = await site.vehicle(server.address, "bystander")
    await case.calm()
    good = bytearray(next(street.other_store.glob("*.rff")).read_bytes())
    flipped = bytearray(good)
    flipped[len(good) // 2] ^= 1
    statuses, told = [], []
    before_bytes = server.rss_bytes()
    for damaged in (bytes(flipped), bytes(good[: len(good) // 2])):
        (store / f"{street.other_id}.rff").write_bytes(damaged)
        async with asyncio.timeout(LISTED_S):
            while True:  # a new file is listed by the second look that finds it the same
                async with raw_vehicle(server.address) as vehicle:
                    await vehicle.say(replace(coded.hello, field_ids=(street.other_id,)))
                    status, said = await vehicle.end(), await vehicle.stream.details()
                if status is not grpc.StatusCode.NOT_FOUND:
                    break
                await asyncio.sleep(0.2)
        statuses.append(status)
        told.append(said)
    case.over()
    case.holds("DATA_LOSS, naming the sum", set(statuses) == {grpc.StatusCode.DATA_LOSS})
    case.holds("and the file's", all(street.other_id in text for text in told))
    case.at_most("memory grows by", (server.rss_bytes("VmHWM") - before_bytes) / 1e6, 32, "MB")
    errors = [str(entry["error"]) for entry in server.entries("stream closed")]
    case.holds("log says it", all(any(text in error for error in errors) for text in told))
    await case.spares(bystander)
    case.finish()


async def test_a_viewer_that_does_not_read(streaming: Any, case: Any) -> None:
    server, bystander = streaming
    case.about("viewer that does not read", "Watch, and nothing taken from the stream", "F7")
    await case.calm()
    async with AsyncExitStack() as stack:
        for _ in range(4):
            channel = await stack.enter_async_context(
                grpc.aio.insecure_channel(server.address, options=CHANNEL_OPTIONS)
            )
            call = twin_pb2_grpc.TwinServiceStub(channel).Watch(
                subscription_to_wire(Subscription(encoding=PictureEncoding.I420))
            )
            await call.initial_metadata()
        before_bytes = server.rss_bytes()
        await asyncio.sleep(4.0)
        grown_mb = (server.rss_bytes() - before_bytes) / 1e6
        case.over()
    case.at_most("server's memory grows by", grown_mb, 16, "MB")
    while server.value("rfedge_twin_consumers") > 0:
        await asyncio.sleep(0.01)
    case.holds("metric counts what they missed", server.value("rfedge_twin_pictures_missed_total"))
    await case.spares(bystander)
    case.finish()


async def test_an_expired_certificate(site: Any, case: Any, tmp_path: Path) -> None:
    case.about("certificate expired", "a vehicle's certificate of 60 days ago, good for 30", "F24")
    members = Members(("cav-1", "bystander"))
    now = datetime.now(UTC)
    for folder, age in (("old", timedelta(days=60)), ("new", timedelta())):
        write_certificates(tmp_path / folder, certify(members, now - age, days=30))
    both = tmp_path / "both.pem"
    both.write_bytes(b"".join((tmp_path / f / "ca.pem").read_bytes() for f in ("old", "new")))

    def tls(folder: str, name: str) -> tuple[str, ...]:
        return tls_options(tmp_path / folder, name, both)

    server = await site.server(*tls("new", "server"))
    bystander = await site.vehicle(server.address, "bystander", *tls("new", "vehicle-bystander"))
    await case.calm()
    late = site.start_vehicle(server.address, "cav-1", *tls("old", "vehicle-cav-1"))
    while late.process.poll() is None:
        await asyncio.sleep(0.01)
    ready = datetime.fromisoformat(late.entries("ready")[0]["timestamp"])
    case.at_most("told within", time.time() - ready.timestamp(), 3)
    await asyncio.sleep(1.0)
    case.over()
    said = late.log.read_text().splitlines()[-1]
    case.holds("exit 2", late.process.returncode == 2)
    case.holds("one line says why", said.endswith("certificate has expired"))
    case.holds("no session of it", server.value("rfedge_server_sessions") == 1)
    await case.spares(bystander)
    case.finish()


async def test_a_revoked_certificate(site: Any, case: Any, appears: Any, tmp_path: Path) -> None:
    case.about(
        "certificate revoked, and let in again", "a line in the server's --access file", "F24"
    )
    root, access = tmp_path / "certs", tmp_path / "access.toml"
    members = Members(("cav-1", "bystander"))
    write_certificates(root, certify(members, datetime.now(UTC), days=2))
    access.write_text("")

    tls = partial(tls_options, root)
    server = await site.server(*tls("server"), "--access", str(access))
    bystander = await site.vehicle(server.address, "bystander", *tls("vehicle-bystander"))
    victim = await site.vehicle(server.address, "cav-1", *tls("vehicle-cav-1"))
    await case.calm()
    access.write_text('revoked = ["spiffe://rfedge/vehicle/cav-1"]')
    revoked_s = time.time()
    await appears(lambda: server.entries("call ended"))
    case.at_most("its open stream is ended", time.time() - revoked_s, 2)
    await appears(lambda: victim.entries("stream given up for now"))
    (told, *_) = victim.entries("stream given up for now")
    case.holds("vehicle's log says revoked", "revoked" in told["problem"])
    case.holds("no frame of it is taken any more", victim.acked(revoked_s + 2) == [])
    await asyncio.sleep(1.0)  # long enough for the bystander to send some pictures
    access.write_text("")
    again_s = time.time()
    await appears(lambda: victim.acked(again_s))
    case.over()
    case.at_most("back after it is let in again", victim.acked_at_s(again_s)[0] - again_s, 10)
    counted = server.value("rfedge_server_refused_certificates_total")
    case.holds("metric counts it", counted >= 1)
    await case.spares(bystander)
    case.finish()


def held(server: Any, kind: str) -> int:
    """Return how many descriptors ("fd") or threads ("task") a server has."""
    return len(list(Path(f"/proc/{server.process.pid}/{kind}").iterdir()))


async def test_a_storm_of_connections(site: Any, case: Any, coded: Any) -> None:
    case.about(
        f"{STORM} vehicles at once", f"{STORM} connections, {ADMITTED} streams allowed", "F22 L5"
    )
    server = await site.server("--max-streams", str(ADMITTED))
    bystander = await site.vehicle(server.address, "bystander")
    descriptors, threads = held(server, "fd"), held(server, "task")
    await case.calm()
    async with AsyncExitStack() as stack:
        channels = [
            await stack.enter_async_context(
                grpc.aio.insecure_channel(server.address, options=CHANNEL_OPTIONS)
            )
            for _ in range(STORM)
        ]

        async def knock(number: int) -> tuple[str, float]:
            began_s = time.monotonic()
            call = channels[number].stream_stream(STREAM_METHOD)(wait_for_ready=True)
            hello = replace(coded.hello, vehicle_id=f"storm-{number}")
            try:
                await call.write(hello_to_bytes(hello))
                answer = await call.read()
                ended = "welcome" if answer is not grpc.aio.EOF else (await call.code()).name
            except grpc.aio.AioRpcError as error:
                ended = error.code().name
            except asyncio.InvalidStateError:
                ended = (await call.code()).name
            return ended, time.monotonic() - began_s

        began_s = time.monotonic()
        told = await asyncio.gather(*map(knock, range(STORM)))
        await asyncio.sleep(max(0.0, began_s + STORM_S - time.monotonic()))
        case.over()
        counts = Counter(ended for ended, _ in told)
        refused = STORM - counts["welcome"]
        told_what = ", ".join(f"{status} {n}" for status, n in sorted(counts.items()))
        case.tells("statuses", told_what)
        case.holds(
            f"some admitted, at most {ADMITTED - 1}, all others RESOURCE_EXHAUSTED",
            0 < counts["welcome"] < ADMITTED and counts["RESOURCE_EXHAUSTED"] == refused,
        )
        case.at_most("slowest answer", max(spent_s for _, spent_s in told), 5)
        limits = ("server_streams", "capacity")
        counted = [server.value("rfedge_server_limited_total", limit=limit) for limit in limits]
        case.holds("metric counts the refused", sum(counted) == refused)
        closed = [entry for entry in server.entries("stream closed") if entry["error"]]
        # A stream beyond the budget is refused before it is one, and counted; others are logged.
        unlogged = server.value("rfedge_server_log_lines_suppressed_total") + counted[0]
        case.holds("log has those refused at their Hello", len(closed) + unlogged >= refused)
    while server.value("rfedge_server_sessions") > 1:
        await asyncio.sleep(0.01)
    await case.spares(bystander)
    case.at_most("descriptors left behind", held(server, "fd") - descriptors, 2, "")
    case.at_most("threads left behind", held(server, "task") - threads, 8, "")
    server.send(signal.SIGTERM)
    case.finish()
