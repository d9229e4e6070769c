"""Poses ahead of their frames: the server works before the frame comes, and shows the same."""

import itertools
from dataclasses import replace
from typing import Any

import pytest

from integration.conftest import RawVehicle
from mec_server.reconstruction import Tools, open_cameras
from mec_server.session import DecodeJob, OpenJob, PrepareJob
from rfcore.codec.h264.ffmpeg import H264Decoder
from rfcore.codec.packet import CheckedPacket, DeltaPacket
from rfcore.errors import RejectReason
from rfcore.wire.head import FrameWriter
from rfcore.wire.messages import Ack, Frame, FrameAddress


async def test_with_poses_ahead_pictures_are_the_same_for_a_few_bytes(
    serve: Any, travel: Any
) -> None:
    async with serve() as server:
        plain = await travel(server.address, pose_with_frame=True)
        value = server.registry.get_sample_value
        assert value("rfedge_server_poses_ahead_total", {"result": "taken"}) == 0
        ahead = await travel(server.address)
        assert value("rfedge_server_poses_ahead_total", {"result": "taken"}) >= 4
        assert value("rfedge_server_poses_ahead_total", {"result": "refused"}) == 0
        assert value("rfedge_server_poses_prepared_total") >= 1
    assert plain.counts == ahead.counts == {"acked": 6}
    for line, other in zip(ahead.lines, plain.lines, strict=True):
        assert line["server_digest"] == line["reconstruction_digest"] == other["server_digest"]
        assert other["stage_ms"]["server_ahead"] == 0
        assert line["packet_bytes"] <= other["packet_bytes"] + 16


class CountingField:
    """A field that counts how often it was rendered."""

    def __init__(self, field: Any) -> None:
        self._field, self.renders = field, 0

    def open(self, _field_id: str) -> Any:
        return self

    def render(self, camera: Any, quality: Any) -> Any:
        self.renders += 1
        return self._field.render(camera, quality)


def test_what_was_rendered_before_a_frame_came_is_not_rendered_again(
    street: Any, coded: Any
) -> None:
    field, ticks = CountingField(street.field), itertools.count()
    tools = Tools(lambda: next(ticks), H264Decoder)
    (decoder,) = open_cameras(OpenJob(coded.hello, exact=True), field, tools).values()
    for sequence, frame in enumerate(coded.frames):
        packet = replace(frame.packet, epoch=1, sequence=sequence)
        job = DecodeJob(frame, CheckedPacket(packet, 0), street.field_id, 0.0, 0.0)
        ahead, is_other = replace(frame.ahead), sequence % 3 == 2
        if sequence % 3:
            other = coded.frames[0].pose if is_other else frame.pose
            decoder.prepare(PrepareJob(replace(ahead, pose=other), street.field_id))
        before = field.renders
        made = decoder.reconstruct(job)
        assert made.digest.startswith(packet.reconstruction_digest)
        is_prepared = sequence % 3 == 1
        assert field.renders == before + (not is_prepared)
        assert (made.times.ahead_ns > 0) is is_prepared
    decoder.close()


class AheadVehicle:
    """A raw vehicle that may send poses ahead; each frame needs its render alone."""

    def __init__(self, vehicle: RawVehicle, coded: Any) -> None:
        self._vehicle, self._coded = vehicle, coded
        self._writer = FrameWriter(coded.hello)
        self._last: FrameAddress | None = None
        self.value = vehicle.server.registry.get_sample_value

    def frame(self, sequence: int, epoch: int = 1) -> Frame:
        frames = self._coded.frames
        frame = frames[sequence % len(frames)]
        packet: DeltaPacket = replace(frame.packet, epoch=epoch, sequence=sequence)
        return replace(frame, packet=packet, capture_time_ns=10**8 * (1 + sequence))

    async def pose(self, frame: Frame) -> bytes:
        message = self._writer.ahead(frame.ahead, self._last)
        await self._vehicle.say(message)
        return message

    async def told(self, frame: Frame) -> tuple[str, int]:
        told = await self._vehicle.told(self._writer.message(frame, self._last))
        if told[0] == "ack":
            self._last = frame.address
        return told


@pytest.fixture
def ahead(welcomed: RawVehicle, coded: Any) -> AheadVehicle:
    return AheadVehicle(welcomed, coded)


async def test_a_frame_without_its_pose_or_after_another_is_refused_and_costs_one(
    ahead: AheadVehicle,
) -> None:
    await ahead.pose(ahead.frame(0))
    assert await ahead.told(ahead.frame(0)) == ("ack", 0)
    ahead._writer.ahead(ahead.frame(1).ahead, ahead._last)  # lost on the way
    assert await ahead.told(ahead.frame(1)) == (RejectReason.UNKNOWN_STATE, 1)
    assert await ahead.told(ahead.frame(0, epoch=2)) == ("ack", 0)


async def test_a_pose_twice_damaged_or_never_followed_has_no_answer_and_harms_nothing(
    ahead: AheadVehicle, welcomed: RawVehicle
) -> None:
    assert await ahead.told(ahead.frame(0)) == ("ack", 0)
    for sequence in (1, 2, 3):
        message = await ahead.pose(ahead.frame(sequence))
        await welcomed.say(message)
        await welcomed.say(message[:-1] + bytes((message[-1] ^ 1,)))
    assert await ahead.told(ahead.frame(3)) == ("sequence_gap", 1)
    assert isinstance(await welcomed.hear(), Ack)
    assert ahead.value("rfedge_server_poses_ahead_total", {"result": "taken"}) == 3
    assert ahead.value("rfedge_server_poses_ahead_total", {"result": "refused"}) == 6


async def test_a_frame_that_differs_from_its_pose_is_decoded_at_its_own(
    ahead: AheadVehicle, welcomed: RawVehicle
) -> None:
    first = ahead.frame(0)
    await ahead.pose(replace(first, pose=ahead.frame(3).pose))
    answer = await welcomed.ask(ahead._writer.message(first, None))
    assert isinstance(answer, Ack)
    assert answer.reconstruction_digest == first.packet.reconstruction_digest
    assert answer.times.ahead_ns == 0


async def test_a_pose_of_an_unknown_camera_or_field_is_refused(
    ahead: AheadVehicle, welcomed: RawVehicle, coded: Any
) -> None:
    (camera,) = coded.hello.cameras
    more = replace(
        coded.hello,
        cameras=(camera, replace(camera, camera_id="rear")),
        field_ids=(*coded.hello.field_ids, "ef" * 32),
    )
    for other in ({"camera_id": "rear"}, {"field_id": "ef" * 32}):
        frame = replace(ahead.frame(0), **other)
        await welcomed.say(FrameWriter(more).ahead(frame.ahead, None))
    assert await ahead.told(ahead.frame(0)) == ("ack", 0)
    assert ahead.value("rfedge_server_poses_ahead_total", {"result": "refused"}) == 2
