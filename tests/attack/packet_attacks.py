"""Attacks by packets that are nearly right: a real picture of the street, and harm done to it."""

from __future__ import annotations

import asyncio
import os
import random
import signal
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from attack.target import (
    ROOT,
    SEED,
    VEHICLE,
    Target,
    all_of,
    for_ever,
    frame,
    hello,
    stream_of,
)
from cav_agent.pipeline import Pipeline
from frames import message_of
from mec_server.decoding.child import DECODER_NAME
from rfcore.codec.h264.config import CodecConfig
from rfcore.dataset import read_dataset
from rfcore.field import load_field
from rfcore.wire.conventions import RENDERER_CONTRACT
from rfcore.wire.convert import hello_to_bytes
from rfcore.wire.head import FrameWriter
from rfcore.wire.messages import CameraDescription, Frame, Hello, RendererContract
from rfcore.wire.v1.edge_pb2 import StreamRequest

ATTACKERS_CRF = 24.0
"""No other vehicle of the suite codes so, and no slice of theirs is equal to one of the attacker's.
"""
SEARCHED_BYTES = 1 << 20
"""Size of the searched part of a decoder's memory: a render of 640x360 as I_PCM takes 354 kB, and
the slice stands behind it."""


def picture(target: Target, cameras: int = 1) -> tuple[Hello, Frame]:
    """Return a Hello, and a frame of its first camera that needs its render alone."""
    shown = read_dataset(ROOT / "samples/street/transforms_drive_vehicles.json").pictures[0]
    k = shown.camera.intrinsics
    shown = replace(shown, camera=shown.camera.rounded())
    field = load_field(ROOT / "samples/fields/street.rff")
    config = CodecConfig(k.width_px, k.height_px, "fast", ATTACKERS_CRF)
    pipeline = Pipeline(field, config, time.perf_counter_ns)
    packet = pipeline.encode_picture(shown)
    named = tuple(CameraDescription(f"c{i}", k, pipeline.header) for i in range(cameras))
    contract = RendererContract(RENDERER_CONTRACT, exact=True)
    greeting = Hello(VEHICLE, named, (target.field_id,), contract)
    return greeting, Frame("c0", 0, shown.camera.world_from_cam, "", packet)


async def flipped_slices(target: Target) -> None:
    """Pictures of the street with one bit of the slice flipped and the CRC made right again."""
    greeting, good = picture(target)
    rng = random.Random(SEED)

    async def messages() -> AsyncIterator[bytes]:
        yield hello_to_bytes(greeting)
        for sequence in range(100_000):
            data = bytearray(good.packet.payload)
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
            packet = replace(good.packet, epoch=1, sequence=sequence, payload=bytes(data))
            captured_ns = time.time_ns()
            yield message_of(greeting, replace(good, packet=packet, capture_time_ns=captured_ns))
            await asyncio.sleep(0.02)

    async def stream() -> None:
        async with target.channel() as channel:
            await stream_of(channel, messages())

    await for_ever(stream, 0.05)


async def poses_for_nothing(target: Target) -> None:
    """Poses ahead of frames that never come, of one camera, as fast as the server takes them."""
    await _poses(target, hello(target, 640, 360))


async def poses_of_large_renders(target: Target) -> None:
    """Poses ahead of frames that never come, of 4 cameras of 1920x1080."""
    await _poses(target, hello(target, 1920, 1080, cameras=4))


async def _poses(target: Target, greeting: Hello) -> None:
    writer = FrameWriter(greeting)

    async def messages() -> AsyncIterator[bytes]:
        yield hello_to_bytes(greeting)
        await asyncio.sleep(0.5)  # before Welcome they are of no use
        for sequence in range(1, 1_000_000):
            for camera in greeting.cameras:
                one = replace(frame(sequence), camera_id=camera.camera_id)
                yield writer.ahead(one.ahead, None)
            await asyncio.sleep(0)

    async def stream() -> None:
        async with target.channel() as channel:
            await stream_of(channel, messages())

    await for_ever(stream, 0.05)


async def poses_of_other_places(target: Target) -> None:
    """Pictures of the street, each after a pose of another place: it is rendered twice."""
    greeting, good = picture(target)
    away = replace(good.pose, translation_m=(good.pose.translation_m[0] + 5.0, 0.0, 1.5)).rounded()

    async def messages() -> AsyncIterator[bytes]:
        yield hello_to_bytes(greeting)
        for sequence in range(100_000):
            packet = replace(good.packet, epoch=1, sequence=sequence)
            shown = replace(good, packet=packet, capture_time_ns=time.time_ns())
            yield FrameWriter(greeting).ahead(replace(shown, pose=away).ahead, None)
            await asyncio.sleep(0.02)
            yield message_of(greeting, shown)

    async def stream() -> None:
        async with target.channel() as channel:
            await stream_of(channel, messages())

    await for_ever(stream, 0.05)


async def junk_poses(target: Target) -> None:
    """Poses of random bytes."""
    greeting, rng = hello(target, 640, 360), random.Random(SEED)

    async def messages() -> AsyncIterator[bytes]:
        yield hello_to_bytes(greeting)
        while True:
            junk = rng.randbytes(rng.randrange(1, 40))
            yield StreamRequest(pose_ahead=junk).SerializeToString()

    async def stream() -> None:
        async with target.channel() as channel:
            await stream_of(channel, messages())

    await for_ever(stream, 0.05)


async def hung_decoders(target: Target) -> None:
    """Pictures of the street for 4 cameras, whose own decoders are stopped (SIGSTOP) after one."""
    greeting, good = picture(target, 4)

    async def messages() -> AsyncIterator[bytes]:
        yield hello_to_bytes(greeting)
        for sequence in range(100_000):
            packet = replace(good.packet, epoch=1, sequence=sequence)
            for camera in greeting.cameras:
                shown = replace(good, camera_id=camera.camera_id, capture_time_ns=time.time_ns())
                yield message_of(greeting, replace(shown, packet=packet))
            await asyncio.sleep(0.1)

    async def stream() -> None:
        async with target.channel() as channel:
            await stream_of(channel, messages())

    async def stop() -> None:
        while True:
            for pid in decoders(target.pid):
                if was_given(pid, good.packet.payload):
                    with suppress(ProcessLookupError):
                        os.kill(pid, signal.SIGSTOP)
            await asyncio.sleep(0.1)

    await all_of(for_ever(stream, 0.05), stop())


def decoders(pid: int) -> set[int]:
    """Return the decoder processes of a server."""
    found, left = set(), [pid]
    while left:
        of = left.pop()
        for children in Path(f"/proc/{of}/task").glob("*/children"):
            with suppress(OSError):
                left += [int(child) for child in children.read_text().split()]
        with suppress(OSError):
            if Path(f"/proc/{of}/comm").read_text().strip() == DECODER_NAME:
                found.add(of)
    return found - {pid}


def was_given(pid: int, slice_: bytes) -> bool:
    """Whether a decoder process was given a slice to decode (``mec_server.decoding.child``)."""
    return any(slice_ in memory for memory in _shared_memory(pid))


def _shared_memory(pid: int) -> Iterator[bytes]:
    """Yield what stands in the memory that a decoder process shares with its server."""
    with suppress(OSError):  # the process has ended
        for descriptor in Path(f"/proc/{pid}/fd").iterdir():
            with suppress(OSError):  # the process has closed that one since
                if str(descriptor.readlink()).startswith(f"/memfd:{DECODER_NAME}"):
                    with descriptor.open("rb") as memory:
                        yield memory.read(SEARCHED_BYTES)
