"""Hostile and broken packets, while another vehicle drives on."""

import asyncio
import itertools
import random
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import Any

import grpc
import pytest

from fault.conftest import FAULT_S
from frames import far_away, message_of
from rfcore.codec.h264.bitstream import StreamHeader
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.sender.encoder import DeltaEncoder
from rfcore.errors import RejectReason
from rfcore.wire.conventions import CHANNEL_OPTIONS, STREAM_METHOD
from rfcore.wire.messages import Ack, FieldNotice, Frame, Nack, Welcome

PACE_S = 0.02
"""A hostile vehicle is as fast as a quick camera; what more it may do, quotas say."""

SEED = 20261121
DECIDED_S = 5.0


def nacked(server: Any, reason: str) -> float:
    value = server.value("rfedge_server_frames_total", result="nacked", reason=reason)
    return float(value)


def numbered(frames: list[Frame]) -> Iterator[Frame]:
    """Yield frames for ever, in sequence; each needs its render alone."""
    for sequence, frame in enumerate(itertools.cycle(frames)):
        packet = replace(frame.packet, epoch=1, sequence=sequence)
        yield replace(frame, packet=packet)


async def paced(frames: list[Frame], seconds: float = FAULT_S) -> AsyncIterator[Frame]:
    """Yield frames as ``numbered``, ``PACE_S`` apart, for that long."""
    until_s = time.monotonic() + seconds
    for frame in numbered(frames):
        if time.monotonic() > until_s:
            return
        await asyncio.sleep(PACE_S)
        yield frame


def flipped(data: bytes, rng: random.Random) -> bytes:
    """Flip one bit of the payload's second half."""
    where = rng.randrange(len(data) // 2, len(data))
    return data[:where] + bytes([data[where] ^ 1 << rng.randrange(8)]) + data[where + 1 :]


def truncated(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(1, len(data))]


async def decided(vehicle: Any, frame: Frame) -> Ack | Nack:
    """Send a frame and return the answer; again, a camera's while later, if there is no time for
    it: on a slow machine its vehicle is granted less than what is sent here."""
    until_s = time.monotonic() + DECIDED_S
    while True:
        answer = await vehicle.ask(frame)
        is_late = time.monotonic() > until_s
        if is_late or isinstance(answer, Ack) or answer.reason is not RejectReason.OVERLOADED:
            return answer  # type: ignore[no-any-return]
        await asyncio.sleep(0.1)


@pytest.mark.fault_core
@pytest.mark.parametrize("damage", [flipped, truncated], ids=lambda f: f.__name__)
async def test_damaged_packets(
    damage: Callable[[bytes, random.Random], bytes],
    streaming: Any,
    case: Any,
    coded: Any,
    raw_vehicle: Any,
) -> None:
    server, bystander = streaming
    rng = random.Random(SEED)
    case.about(f"{damage.__name__} packets", f"every other message of 50 Hz, seed {SEED}", "F9 F10")
    answers: Counter[str] = Counter()
    wrong, sent = 0, 0
    async with raw_vehicle(server.address) as vehicle:
        await vehicle.greet(coded.hello)
        frames = numbered(coded.frames)
        await case.calm()
        until_s = time.monotonic() + case.lasting(FAULT_S)
        while time.monotonic() < until_s or sent < 100:
            frame = next(frames)
            await asyncio.sleep(PACE_S)
            answer = await vehicle.ask(damage(message_of(coded.hello, frame), rng))
            while isinstance(answer, Welcome):  # at another rate, as frames take longer here
                answer = await vehicle.hear()
            sent += 1
            answers[str(answer.reason) if isinstance(answer, Nack) else "ack"] += 1
            good = await decided(vehicle, frame) if isinstance(answer, Nack) else answer
            exact = frame.packet.reconstruction_digest
            wrong += not isinstance(good, Ack) or good.reconstruction_digest != exact
        case.over()
    refused = sent - answers["ack"]
    case.at_most("silently wrong or lost pictures afterwards", wrong, 0, f"of {sent}")
    case.holds("damage refused", refused >= 0.9 * sent)
    case.holds("reasons in the metrics", sum(nacked(server, r) for r in answers) >= refused)
    case.tells("reasons given", ", ".join(f"{reason} {n}" for reason, n in sorted(answers.items())))
    await case.spares(bystander)
    case.finish()


async def test_replayed_packets(streaming: Any, case: Any, coded: Any, raw_vehicle: Any) -> None:
    server, bystander = streaming
    case.about("replayed packets", "each frame again, and those of an older epoch", "F11")
    told: Counter[tuple[str, str]] = Counter()
    async with raw_vehicle(server.address) as vehicle:
        await vehicle.greet(coded.hello)
        assert await vehicle.told(coded.frames[0]) == ("ack", 0)
        await case.calm()
        async for frame in paced(coded.frames):
            told["new", (await vehicle.told(frame))[0]] += 1
            told["again", (await vehicle.told(frame))[0]] += 1
            told["old", (await vehicle.told(coded.frames[1]))[0]] += 1
        case.over()
    case.holds("what is new is taken", set(told) & {("new", "ack")} and told["new", "ack"] > 0)
    kinds = {("new", "ack"), ("again", "stale_sequence"), ("old", "stale_epoch")}
    case.holds("repeats are stale_sequence, older epochs stale_epoch", set(told) == kinds)
    case.holds("metric counts them", nacked(server, "stale_epoch") == told["old", "stale_epoch"])
    await case.spares(bystander)
    case.finish()


async def test_reordered_packets(streaming: Any, case: Any, coded: Any, raw_vehicle: Any) -> None:
    server, bystander = streaming
    case.about("reordered packets", "pairs sent the wrong way round", "F11")
    told: Counter[str] = Counter()
    exact = True
    async with raw_vehicle(server.address) as vehicle:
        await vehicle.greet(coded.hello)
        frames = numbered(coded.frames)
        await case.calm()
        until_s = time.monotonic() + FAULT_S
        while time.monotonic() < until_s:
            await asyncio.sleep(PACE_S)
            first, second = next(frames), next(frames)
            await vehicle.say(second)
            await vehicle.say(first)
            for _ in range(3):
                answer = await vehicle.hear()
                if isinstance(answer, Nack):
                    told[str(answer.reason)] += 1
                    continue
                told["ack"] += 1
                digest = second.packet.reconstruction_digest
                exact = exact and answer.reconstruction_digest == digest
        case.over()
    case.holds("the later is shown, the earlier told as a gap", told["ack"] == told["sequence_gap"])
    case.holds("and refused when it comes", told["stale_sequence"] == told["ack"])
    case.holds("pictures byte-equal to a fault-free run", exact and told["ack"] > 0)
    await case.spares(bystander)
    case.finish()


async def test_a_wrong_field_version(
    street: Any, streaming: Any, case: Any, coded: Any, raw_vehicle: Any
) -> None:
    server, bystander = streaming
    case.about(
        "wrong field version", "Hello with another field's id; frames of another Hello", "F12"
    )
    await case.calm()
    async with raw_vehicle(server.address) as vehicle:
        notice = await vehicle.ask(replace(coded.hello, field_ids=(street.other_id,)))
        case.holds("told which field is held", notice == FieldNotice((street.field_id,)))
        case.holds("NOT_FOUND", await vehicle.end() is grpc.StatusCode.NOT_FOUND)
    async with raw_vehicle(server.address) as vehicle:
        await vehicle.greet(coded.hello)
        refused = taken = 0
        async for frame in paced(coded.frames):
            foreign = replace(coded.hello, field_ids=(street.other_id,))
            answer = await vehicle.told(message_of(foreign, frame))
            refused += answer[0] == "crc_mismatch"
            taken += (await vehicle.told(frame))[0] == "ack"
        case.over()
    case.holds("no frame mixed", refused == taken > 0)
    case.holds("metric counts them", nacked(server, "crc_mismatch") == refused)
    errors = [str(entry["error"]) for entry in server.entries("stream closed")]
    case.holds("log names both fields", any(street.other_id in error for error in errors))
    await case.spares(bystander)
    case.finish()


async def test_poses_that_cannot_be(
    streaming: Any, case: Any, coded: Any, raw_vehicle: Any
) -> None:
    server, bystander = streaming
    case.about("poses 450,000 km from the tile", "every other frame", "F14")
    refused = taken = 0
    async with raw_vehicle(server.address) as vehicle:
        await vehicle.greet(coded.hello)
        await case.calm()
        async for frame in paced(coded.frames):
            answer = await vehicle.ask(far_away(coded.hello, frame, 900_000.0))
            refused += isinstance(answer, Nack) and str(answer.reason) == "invalid_argument"
            taken += (await vehicle.told(frame))[0] == "ack"
        case.over()
    case.holds("each refused by the name of the field, the next frame taken", refused == taken > 0)
    case.holds("metric counts them", nacked(server, "invalid_argument") == refused)
    entries = server.entries("frame rejected")
    unwritten = server.value("rfedge_server_log_lines_suppressed_total")
    case.holds(
        "log names the value",
        len(entries) + unwritten >= refused and all("pose" in x["problem"] for x in entries),
    )
    await case.spares(bystander)
    case.finish()


@asynccontextmanager
async def compressing(address: str) -> AsyncIterator[Any]:
    async with grpc.aio.insecure_channel(
        address, options=CHANNEL_OPTIONS, compression=grpc.Compression.Gzip
    ) as channel:
        yield channel.stream_stream(STREAM_METHOD)()


async def test_a_gzip_bomb(streaming: Any, case: Any) -> None:
    server, bystander = streaming
    case.about("gzip bomb", "messages of 64 MiB of zeros, compressed to 64 KiB", "F15")
    before_bytes = server.rss_bytes()
    await case.calm()
    bomb, statuses = bytes(64 << 20), []
    for _ in range(3):
        async with compressing(server.address) as stream:
            await stream.write(bomb)
            statuses.append(await stream.code())
    case.over()
    case.holds("RESOURCE_EXHAUSTED", set(statuses) == {grpc.StatusCode.RESOURCE_EXHAUSTED})
    grown_mb = (server.rss_bytes("VmHWM") - before_bytes) / 1e6
    case.at_most("server's memory grows by", grown_mb, 16, "MB")
    await case.spares(bystander)
    case.finish()


async def test_a_resolution_bomb(streaming: Any, case: Any, coded: Any, raw_vehicle: Any) -> None:
    server, bystander = streaming
    case.about(
        "resolution bomb", "SPS of 4096x2304 for a 76x52 stream: in Hello, in a payload", "F16"
    )
    large = DeltaEncoder(CodecConfig(4096, 2304, "fast")).header
    (camera,) = coded.hello.cameras
    small = camera.codec
    header = StreamHeader(small.config, large.sps, large.pps)
    before_bytes = server.rss_bytes()
    async with raw_vehicle(server.address) as vehicle:
        await case.calm()
        bad = replace(coded.hello, cameras=(replace(camera, codec=header),))
        nack = await vehicle.ask(bad)
        case.holds("Hello refused by stream_header.sps", "stream_header.sps" in str(nack.problem))
        await vehicle.greet(coded.hello)
        told: Counter[str] = Counter()
        async for frame in paced(coded.frames):
            payload = large.sps + b"\x00\x00\x00\x01" + frame.packet.payload
            packet = replace(frame.packet, payload=payload)
            told[(await vehicle.told(replace(frame, packet=packet)))[0]] += 1
            told[(await vehicle.told(frame))[0]] += 1
        case.over()
    case.holds("payloads refused before the decoder", told["malformed_payload"] == told["ack"] > 0)
    case.holds("metric counts them", nacked(server, "malformed_payload") == told["ack"])
    grown_mb = (server.rss_bytes("VmHWM") - before_bytes) / 1e6
    case.at_most("server's memory grows by", grown_mb, 32, "MB")
    await case.spares(bystander)
    case.finish()


@pytest.mark.parametrize("skew_s", [300, -300])
async def test_a_clock_that_is_wrong(
    skew_s: int, streaming: Any, case: Any, coded: Any, raw_vehicle: Any
) -> None:
    server, bystander = streaming
    case.about(f"clock {skew_s:+} s off", "capture times of one vehicle", "F18")
    taken = 0
    async with raw_vehicle(server.address) as vehicle:
        await vehicle.greet(coded.hello)
        await case.calm()
        exact = True
        async for frame in paced(coded.frames):
            skewed_ns = time.time_ns() + skew_s * 10**9
            answer = await vehicle.ask(replace(frame, capture_time_ns=skewed_ns))
            assert isinstance(answer, Ack)
            exact = exact and answer.reconstruction_digest == frame.packet.reconstruction_digest
            taken += 1
        age_s = server.value("rfedge_twin_age_seconds")
        case.over()
        case.holds("every frame taken, exact", exact and taken > 0)
        total = server.value("rfedge_server_capture_to_picture_seconds_sum")
        case.holds("no latency or age below 0", total >= 0 and age_s >= 0)
    await case.spares(bystander)
    case.finish()
