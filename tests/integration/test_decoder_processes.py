"""Decoding outside of the server: the same bytes, and a decoder's death costs one frame."""

import asyncio
import os
import signal
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from mec_server.config import DecoderKind
from mec_server.decoding.child import DECODER_NAME
from rfcore.wire.messages import Ack


def processes_of_decoders() -> list[int]:
    """Return those of servers in this process, the spare one included."""
    found, left = [], [os.getpid()]
    while left:
        for thread in Path(f"/proc/{left.pop()}/task").glob("*"):
            with suppress(OSError):  # it ended meanwhile
                children = [int(pid) for pid in (thread / "children").read_text().split()]
                left += children
                found += [pid for pid in children if is_decoder(pid)]
    return found


def is_decoder(pid: int) -> bool:
    return Path(f"/proc/{pid}/comm").read_text().strip() == DECODER_NAME


@pytest.mark.parametrize(
    "kind",
    [
        DecoderKind.CHILD,
        DecoderKind.LANDLOCK,
        pytest.param(DecoderKind.BUBBLEWRAP, marks=pytest.mark.slow),
    ],
)
async def test_where_it_is_decoded_changes_no_byte(kind: Any, serve: Any, travel: Any) -> None:
    async with serve(decoder=DecoderKind.IN_PROCESS) as server:
        here = await travel(server.address)
    async with serve(decoder=kind, sandbox_as_root=True) as server:
        there = await travel(server.address)
    assert here.counts == there.counts == {"acked": 6}
    for key in ("reconstruction_digest", "server_digest", "payload_bytes"):
        assert [line[key] for line in here.lines] == [line[key] for line in there.lines]


async def test_a_decoder_that_hangs_holds_no_worker(
    coded: Any, serve: Any, raw_vehicle: Any
) -> None:
    async with (
        serve(decoder=DecoderKind.CHILD, workers=1) as server,
        raw_vehicle(server.address) as vehicle,
    ):
        (of_vehicle,) = processes_of_decoders()
        await vehicle.greet(coded.hello)
        assert await vehicle.told(coded.frames[0]) == ("ack", 0)
        async with raw_vehicle(server.address) as other:
            await other.greet(replace(coded.hello, vehicle_id="cav-other"))
            os.kill(of_vehicle, signal.SIGSTOP)
            hung = asyncio.create_task(vehicle.told(coded.frames[1]))
            for frame in coded.frames[:3]:
                assert isinstance(await other.ask(frame), Ack)
            assert not hung.done(), "the others are served while it is waited for"
            assert await hung == ("decoder_failed", 1)
            assert await other.farewell() is not None


async def test_a_decoder_killed_between_frames_costs_the_next_one_and_no_other_vehicle(
    coded: Any, serve: Any, raw_vehicle: Any
) -> None:
    async with serve(decoder=DecoderKind.CHILD) as server, raw_vehicle(server.address) as other:
        (of_other,) = processes_of_decoders()
        await other.greet(replace(coded.hello, vehicle_id="cav-other"))
        async with raw_vehicle(server.address) as vehicle:
            await vehicle.greet(coded.hello)
            assert await vehicle.told(coded.frames[0]) == ("ack", 0)
            for pid in processes_of_decoders():  # the one that stands ready, too
                if pid != of_other:
                    os.kill(pid, signal.SIGKILL)
            told = [await vehicle.told(frame) for frame in coded.frames[1:4]]
            assert ("decoder_failed", 1) in told
            assert told[-1] == ("ack", 3)
            answer = await other.ask(coded.frames[0])
            assert isinstance(answer, Ack)
            assert await vehicle.farewell() is not None
        lost = server.registry.get_sample_value(
            "rfedge_server_decoders_lost_total", {"cause": "signal"}
        )
        assert lost == 1


async def test_a_stream_that_ends_takes_its_decoder_with_it(
    coded: Any, serve: Any, raw_vehicle: Any
) -> None:
    async with serve(decoder=DecoderKind.CHILD) as server:
        async with raw_vehicle(server.address) as vehicle:
            await vehicle.greet(coded.hello)
            vehicle.stream.cancel()
        while len(processes_of_decoders()) != 1:
            await asyncio.sleep(0)
    assert processes_of_decoders() == []
