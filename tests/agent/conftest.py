"""A session in a known state, pictures to offer, and packets as an encoder would make them."""

from collections.abc import Callable

import numpy as np
import pytest

from cav_agent.frames import Capture, EncodedFrame, EncodeJob
from cav_agent.session import AgentSession
from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.codec.h264.bitstream import StreamHeader
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.packet import DeltaPacket
from rfcore.views import PosedPicture
from rfcore.wire.conventions import RENDERER_CONTRACT
from rfcore.wire.messages import CameraDescription, Credit, Hello, RendererContract, Welcome

INTRINSICS = Intrinsics(32, 16, 20.0, 20.0, 16.0, 8.0)


@pytest.fixture
def hello() -> Hello:
    header = StreamHeader(CodecConfig(32, 16, "default", 23.0), b"\x67" * 20, b"\x68" * 5)
    camera = CameraDescription("front", INTRINSICS, header)
    return Hello("cav-1", (camera,), ("ab" * 32,), RendererContract(RENDERER_CONTRACT, exact=True))


@pytest.fixture
def make_capture() -> Callable[..., Capture]:
    def make(index: int, captured_s: float = 0.0) -> Capture:
        picture = PosedPicture(
            f"{index:03}.png",
            Camera(INTRINSICS, Pose.identity()),
            lambda: np.zeros((16, 32, 3), np.uint8),
        )
        return Capture("front", index, picture, captured_s, 1_000 + index)

    return make


@pytest.fixture
def encode() -> Callable[[EncodeJob], EncodedFrame]:
    """Number packets as ``DeltaEncoder`` does: from 0 in each epoch."""
    state = {"epoch": -1, "sequence": 0}

    def run(job: EncodeJob, payload_bytes: int = 100) -> EncodedFrame:
        if job.epoch != state["epoch"]:
            state.update(epoch=job.epoch, sequence=0)
        payload = b"p" * payload_bytes
        packet = DeltaPacket(
            job.epoch,
            state["sequence"],
            b"rr",
            b"c" * 64,
            b"digest",
            payload,
        )
        state["sequence"] += 1
        return EncodedFrame(packet, {"render": 0.01, "encode": 0.02}, Pose.identity())

    return run


@pytest.fixture
def session(hello: Hello) -> AgentSession:
    """A session that was welcomed at time 0 with a credit of two frames."""
    session = AgentSession(hello)
    session.connected(0.0)
    session.messages_to_send(0.0)
    session.receive(Welcome("s-1", exact=True), 0.0)
    session.receive(Credit("front", 2), 0.0)
    return session
