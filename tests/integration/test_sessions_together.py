"""Both ends' sessions on a channel that loses, repeats and damages; no socket, no clock, no codec.

The channel follows a list of faults, then behaves. Whatever the list: every picture ends exactly
once, nothing damaged is acknowledged, and afterwards pictures are acknowledged again.
"""

import zlib
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cav_agent.frames import Capture, EncodedFrame, EncodeJob, FrameResult, Outcome
from cav_agent.session import AgentSession
from mec_server.session import DecodeJob, OpenJob, ServerSession
from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.codec.h264.bitstream import StreamHeader
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.packet import DeltaPacket
from rfcore.errors import InvalidInput
from rfcore.views import PosedPicture
from rfcore.wire.conventions import RENDERER_CONTRACT
from rfcore.wire.convert import client_message_from_bytes
from rfcore.wire.head import FrameReader, FrameRefused
from rfcore.wire.messages import (
    CameraDescription,
    Frame,
    Hello,
    PoseAhead,
    RendererContract,
    StageTimes,
)

FIELD = "ab" * 32
INTRINSICS = Intrinsics(32, 16, 20.0, 20.0, 16.0, 8.0)
HEADER = StreamHeader(CodecConfig(32, 16), b"\x67" * 20, b"\x68" * 5)
HELLO = Hello(
    "cav-1",
    (CameraDescription("front", INTRINSICS, HEADER),),
    (FIELD,),
    RendererContract(RENDERER_CONTRACT, exact=True),
)

WON = StageTimes(ahead_ns=10_000_000)
faults = st.sampled_from(["deliver", "lose", "repeat", "delay", "flip", "cut", "answer lost"])


class World:
    """A vehicle, a server, and a channel between them."""

    def __init__(self, plan: list[str]) -> None:
        self.now = 0.0
        self.plan: Iterator[str] = iter(plan)
        self.agent = AgentSession(HELLO)
        self.results: list[FrameResult] = []
        self.delayed: list[bytes] = []
        self.encoder = (-1, 0)
        self.prepared = 0
        self.connect()

    def connect(self) -> None:
        self.server = ServerSession("s", [FIELD], self.now)
        self.decoded = (0, -1)
        self.delayed.clear()
        self.agent.connected(self.now)
        self.exchange()

    def step(self, index: int) -> None:
        """Capture a picture and let everything happen that can."""
        self.now += 1.0
        picture = PosedPicture(
            str(index), Camera(INTRINSICS, Pose.identity()), lambda: np.zeros((16, 32, 3), np.uint8)
        )
        self.agent.offer(Capture("front", index, picture, self.now, index))
        self.agent.handle_timer(self.now)
        if self.agent.broken is not None:
            self.agent.connection_lost(self.agent.broken, self.now)
            self.connect()
        while (job := self.agent.job_to_start(0.0)) is not None:
            encoded, capture = self.encode(job), job.capture
            address = ("front", encoded.packet.epoch, encoded.packet.sequence)
            ahead = PoseAhead(*address, capture.capture_time_ns, encoded.pose)
            self.agent.located(job, ahead)
            self.exchange()
            self.agent.encoded(encoded, self.now)
            self.exchange()
        self.results += self.agent.take_results()

    def encode(self, job: EncodeJob) -> EncodedFrame:
        sequence = self.encoder[1] + 1 if self.encoder[0] == job.epoch else 0
        self.encoder = (job.epoch, sequence)
        payload = f"picture {job.capture.index}".encode()
        digest = zlib.crc32(payload).to_bytes(6, "big")
        packet = DeltaPacket(job.epoch, sequence, digest[-2:], b"c" * 64, digest, payload)
        return EncodedFrame(packet, {}, Pose.identity())

    def exchange(self) -> None:
        for outgoing in self.agent.messages_to_send(self.now):
            is_frame = isinstance(outgoing.message, (Frame, PoseAhead))
            fault = next(self.plan, "deliver") if is_frame else "deliver"
            for arrived in self.through(outgoing.data, fault):
                self.serve(arrived)
            answers = self.server.messages_to_send(self.now)
            for answer in answers if fault != "answer lost" else []:
                self.agent.receive(answer, self.now)

    def through(self, data: bytes, fault: str) -> list[bytes]:
        late, self.delayed = self.delayed, []
        match fault:
            case "lose":
                return late
            case "repeat":
                return [data, data, *late]
            case "delay":
                self.delayed = [data]
                return late
            case "flip":
                where = len(data) // 2
                return [data[:where] + bytes([data[where] ^ 4]) + data[where + 1 :], *late]
            case "cut":
                return [data[: len(data) // 2], *late]
        return [data, *late]

    def serve(self, data: bytes) -> None:
        try:
            is_ahead = False
            message = client_message_from_bytes(data)
            if isinstance(message, Hello):
                self.reader = FrameReader(message)
            else:
                is_ahead = message.is_ahead
                message = self.reader.read(message)
            self.server.receive(message, self.now)
        except (InvalidInput, FrameRefused) as error:
            if is_ahead:
                self.server.refuse_ahead()
            else:
                self.server.refuse(error, self.now)
        for prepared in self.server.poses_to_prepare():
            self.prepared += 1
            self.server.prepared(prepared)
        while jobs := self.server.jobs_to_start(self.now):
            for job in jobs:
                self.work(job)

    def work(self, job: OpenJob | DecodeJob) -> None:
        if isinstance(job, OpenJob):
            self.server.opened(job, self.now)
            return
        packet = job.frame.packet
        assert (packet.epoch, packet.sequence) > self.decoded, "handed out in order"
        self.decoded = (packet.epoch, packet.sequence)
        self.server.decoded(job, packet.reconstruction_digest, WON, self.now)


@settings(max_examples=300)
@given(st.lists(faults, max_size=25))
def test_every_picture_ends_once_and_the_stream_recovers_from_anything(plan: list[str]) -> None:
    world = World(plan)
    trouble, calm = 2 * len(plan) + 2, 12
    for index in range(trouble + calm):
        world.step(index)
    ended = [result.capture.index for result in world.results]
    assert len(ended) == len(set(ended)), "no picture ends twice"
    assert set(ended) | {trouble + calm - 1} == set(range(trouble + calm)), "and none is forgotten"
    assert [r.outcome for r in world.results[-4:]] == [Outcome.ACKED] * 4
    for result in world.results:
        if result.outcome is Outcome.ACKED:
            assert result.packet is not None
            assert result.packet.payload == f"picture {result.capture.index}".encode()
            assert result.server_digest == result.packet.reconstruction_digest


def test_without_faults_every_picture_is_acknowledged_in_one_epoch() -> None:
    world = World([])
    for index in range(20):
        world.step(index)
    assert [result.outcome for result in world.results] == [Outcome.ACKED] * 20
    assert {result.packet.epoch for result in world.results if result.packet} == {0}
    assert world.prepared == 20


@pytest.mark.parametrize("fault", ["flip", "cut"])
@pytest.mark.parametrize("before", [4, 5], ids=["pose", "frame"])
def test_a_damaged_pose_or_frame_costs_one_picture(fault: str, before: int) -> None:
    world = World(["deliver"] * before + [fault])
    for index in range(8):
        world.step(index)
    outcomes = [str(result.outcome) for result in world.results]
    assert outcomes.count("nacked") + outcomes.count("lost") == 1
    assert outcomes.count("acked") == 7
