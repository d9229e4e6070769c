"""What one vehicle does wrong costs the others nothing, or a bounded amount."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from mec_server.decode_jobs import DecodeJob, OpenJob
from mec_server.reconstruction import Decoder, FieldSource, Reconstruction, Tools, open_cameras
from rfcore.wire.messages import Frame


class CountingDecoder:
    """Notes the sequence of each frame that reaches a worker, where it is rendered first."""

    def __init__(self, decoder: Decoder, reached: list[int]) -> None:
        self._decoder = decoder
        self._reached = reached

    def reconstruct(self, job: DecodeJob) -> Reconstruction:
        self._reached.append(job.frame.packet.sequence)
        return self._decoder.reconstruct(job)

    def close(self) -> None:
        self._decoder.close()


def damaged(frame: Frame) -> Frame:
    return replace(frame, packet=replace(frame.packet, crc32=frame.packet.crc32 ^ 1))


async def test_nothing_is_rendered_for_a_damaged_or_a_stale_packet(
    coded: Any, serve: Any, raw_vehicle: Any
) -> None:
    reached: list[int] = []

    def opened(job: OpenJob, fields: FieldSource, tools: Tools) -> Mapping[str, Decoder]:
        cameras = open_cameras(job, fields, tools)
        return {name: CountingDecoder(cameras[name], reached) for name in cameras}

    frames = coded.frames
    async with serve(opened) as server, raw_vehicle(server.address) as vehicle:
        await vehicle.greet(coded.hello)
        sent = [damaged(frames[0]), frames[0], frames[0], damaged(frames[1]), frames[1]]
        told = [await vehicle.told(frame) for frame in sent]
    assert [answer for answer, _ in told] == [
        "crc_mismatch", "ack", "stale_sequence", "crc_mismatch", "ack",
    ]  # fmt: skip
    assert reached == [0, 1]
