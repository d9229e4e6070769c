"""Input of a careless or hostile peer is refused by name, and the next frame is right again."""

import asyncio
from dataclasses import replace
from typing import Any

import grpc

from frames import far_away, flipped, message_of
from rfcore.codec.h264.bitstream import StreamHeader
from rfcore.codec.h264.config import CodecConfig
from rfcore.wire.messages import Ack, Frame, Nack


def flipped_slice(frame: Frame, bit: int) -> Frame:
    """Return the frame as if its check had been made right after a bit was flipped."""
    payload = bytearray(frame.packet.payload)
    payload[(bit // 8) % len(payload)] ^= 1 << (bit % 8)
    return replace(frame, packet=replace(frame.packet, payload=bytes(payload)))


async def test_damaged_packets_are_refused_and_the_next_is_right_again(
    coded: Any, welcomed: Any
) -> None:
    """Every frame of this list is answered; what is acknowledged is what the vehicle meant."""
    f = coded.frames
    moved = replace(f[5], pose=f[0].pose)
    said = [
        (f[0], "ack"),
        (f[0], "stale_sequence"),
        (flipped(message_of(coded.hello, f[1]), 100), "crc_mismatch"),
        (flipped(message_of(coded.hello, f[1]), 8 * len(f[1].packet.payload)), "crc_mismatch"),
        (f[1], "ack"),
        (f[2], "ack"),
        (f[1], "stale_sequence"),
        (moved, "render_mismatch"),
        (far_away(coded.hello, f[3], 900_000.0), "invalid_argument"),
        (replace(f[3], packet=replace(f[3].packet, sequence=99)), "invalid_argument"),
        (b"\xffgarbage", "invalid_argument"),
        (b"", "invalid_argument"),
        (f[3], "ack"),
    ]
    heard = [(await welcomed.told(message))[0] for message, _ in said]
    assert heard == [reason for _, reason in said]
    await welcomed.say(f[5])
    gap, ack = await welcomed.hear(), await welcomed.hear()
    assert isinstance(gap, Nack)
    assert (str(gap.reason), gap.address.sequence, gap.count) == ("sequence_gap", 4, 1)
    assert isinstance(ack, Ack)
    assert ack.reconstruction_digest == f[5].packet.reconstruction_digest
    assert await welcomed.farewell() is grpc.StatusCode.OK


async def test_no_flipped_bit_becomes_a_wrong_picture_even_when_its_crc_was_repaired(
    coded: Any, welcomed: Any
) -> None:
    right = coded.frames[0].packet.reconstruction_digest
    for number, bit in enumerate(range(0, 8 * len(coded.frames[0].packet.payload), 997)):
        frame = coded.frames[0]
        frame = replace(frame, packet=replace(frame.packet, epoch=number))
        answer = await welcomed.ask(flipped_slice(frame, bit))
        if isinstance(answer, Ack):
            assert answer.reconstruction_digest == right
        else:
            assert isinstance(answer, Nack)


async def test_a_hello_of_another_resolution_is_refused_by_name_and_may_be_corrected(
    coded: Any, serve: Any, raw_vehicle: Any
) -> None:
    camera = coded.hello.cameras[0]
    header = camera.codec
    codecs = [
        (replace(header.config, width_px=640), "hello.cameras[0].codec.width_px: 640 px, but"),
        (replace(header.config, height_px=2), "hello.cameras[0].codec.height_px: 2 px, but"),
    ]
    async with serve() as server, raw_vehicle(server.address) as vehicle:
        for config, named in codecs:
            bad = replace(camera, codec=replace(header, config=config))
            nack = await vehicle.ask(replace(coded.hello, cameras=(bad,)))
            assert isinstance(nack, Nack)
            assert nack.problem.startswith(named)
        large = replace(camera.intrinsics, width_px=152)
        config = CodecConfig(152, 52, "fast")
        bad = replace(camera, intrinsics=large, codec=StreamHeader(config, header.sps, header.pps))
        nack = await vehicle.ask(replace(coded.hello, cameras=(bad,)))
        assert isinstance(nack, Nack)
        assert nack.problem.startswith("hello.cameras[0].stream_header.sps"), "of another size"
        await vehicle.greet(coded.hello)
        assert await vehicle.told(coded.frames[0]) == ("ack", 0)


async def test_an_oversize_message_ends_its_stream_and_no_other(
    coded: Any, serve: Any, raw_vehicle: Any
) -> None:
    async with serve() as server, raw_vehicle(server.address) as other:
        await other.greet(replace(coded.hello, vehicle_id="cav-other"))
        async with raw_vehicle(server.address) as vehicle:
            await vehicle.greet(coded.hello)
            await vehicle.say(bytes(2 << 20))
            assert await vehicle.end() is grpc.StatusCode.RESOURCE_EXHAUSTED
        assert await other.told(coded.frames[0]) == ("ack", 0)


async def test_a_draining_server_answers_what_it_has_taken(coded: Any, welcomed: Any) -> None:
    await welcomed.say(coded.frames[0])
    await welcomed.say(coded.frames[1])
    first = await welcomed.hear()
    draining = asyncio.create_task(welcomed.server.stop())
    second = await welcomed.hear()
    assert [a.address.sequence for a in (first, second) if isinstance(a, Ack)] == [0, 1]
    assert await welcomed.end() is grpc.StatusCode.OK
    await draining
