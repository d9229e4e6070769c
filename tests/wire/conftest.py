"""A plain Hello and a plain Frame, for the tests to vary."""

import pytest

from rfcore.camera import Intrinsics, Pose
from rfcore.codec.h264.bitstream import StreamHeader
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.packet import DeltaPacket
from rfcore.wire.conventions import RENDERER_CONTRACT
from rfcore.wire.messages import CameraDescription, Frame, Hello, RendererContract

INTRINSICS = Intrinsics(32, 16, 20.0, 20.0, 16.0, 8.0)
PAYLOAD = bytes(range(200))


@pytest.fixture
def hello() -> Hello:
    header = StreamHeader(CodecConfig(32, 16, "default", 23.0), b"\x67" * 20, b"\x68" * 5)
    return Hello(
        "cav-1",
        (CameraDescription("front", INTRINSICS, header),),
        ("ab" * 32,),
        RendererContract(RENDERER_CONTRACT, exact=True),
    )


@pytest.fixture
def frame() -> Frame:
    packet = DeltaPacket(
        epoch=3,
        sequence=41,
        render_digest=b"rr",
        render_block_means=b"c" * 64,
        reconstruction_digest=b"digest",
        payload=PAYLOAD,
    )
    pose = Pose((1.5, -2.25, 1.6), (0.5, 0.5, -0.5, 0.5))
    return Frame("front", 1_700_000_000_000_000_000, pose, "", packet)
