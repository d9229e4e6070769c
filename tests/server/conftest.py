"""A session in a known state, and a vehicle's messages to feed it."""

from collections.abc import Callable

import pytest

from mec_server.session import ServerSession
from rfcore.camera import Intrinsics, Pose
from rfcore.codec.h264.bitstream import StreamHeader
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.packet import DeltaPacket
from rfcore.wire.conventions import RENDERER_CONTRACT
from rfcore.wire.messages import CameraDescription, Frame, Hello, RendererContract

FIELD = "ab" * 32


@pytest.fixture
def hello() -> Hello:
    header = StreamHeader(CodecConfig(32, 16, "default", 23.0), b"\x67" * 20, b"\x68" * 5)
    intrinsics = Intrinsics(32, 16, 20.0, 20.0, 16.0, 8.0)
    cameras = tuple(CameraDescription(name, intrinsics, header) for name in ("front", "rear"))
    return Hello("cav-1", cameras, (FIELD,), RendererContract(RENDERER_CONTRACT, exact=True))


@pytest.fixture
def make_frame() -> Callable[..., Frame]:
    def make(sequence: int, epoch: int = 0, camera_id: str = "front") -> Frame:
        payload = f"{epoch}/{sequence}".encode()
        packet = DeltaPacket(epoch, sequence, b"rr", b"c" * 64, b"digest", payload)
        return Frame(camera_id, 1000, Pose.identity(), "", packet)

    return make


@pytest.fixture
def session(hello: Hello) -> ServerSession:
    """A session that has welcomed ``hello`` at time 0 and said so."""
    session = ServerSession("s-1", [FIELD], now=0.0)
    session.receive(hello, 0.0)
    (job,) = session.jobs_to_start(0.0)
    session.opened(job, 0.0)  # type: ignore[arg-type]
    session.messages_to_send(0.0)
    return session
