"""The target of attacks, and their parts: channels, messages, repetition."""

from __future__ import annotations

import asyncio
import random
import ssl
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import grpc

from rfcore.camera import Intrinsics, Pose
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.packet import DeltaPacket
from rfcore.codec.sender.encoder import DeltaEncoder
from rfcore.wire.conventions import CHANNEL_OPTIONS, RENDERER_CONTRACT, STREAM_METHOD
from rfcore.wire.messages import CameraDescription, Frame, Hello, RendererContract
from rfcore.wire.tls import TlsFiles

ROOT = Path(__file__).parents[2]
SEED = 20261122
VEHICLE = "attacker"


@dataclass(frozen=True)
class Target:
    """The server to attack, or a decoy beside it: an attack on that costs the server nothing but
    the machine's time."""

    address: str
    """HOST:PORT of the services."""
    metrics: str
    """HOST:PORT of the metrics."""
    certificates: str
    field_id: str
    fields: str
    """Folder that the fields are served from."""
    access: str
    """The file of ``--access``."""
    pid: int

    def tls(self, name: str) -> TlsFiles:
        """Return the files of an identity."""
        root = Path(self.certificates)
        return TlsFiles(root / f"{name}.pem", root / f"{name}.key", root / "ca.pem")

    @asynccontextmanager
    async def channel(self, name: str = f"vehicle-{VEHICLE}") -> AsyncIterator[grpc.aio.Channel]:
        """Open a connection of an identity, of its own."""
        credentials = self.tls(name).channel_credentials()
        options = (*CHANNEL_OPTIONS, ("grpc.primary_user_agent", str(random.random())))
        async with grpc.aio.secure_channel(self.address, credentials, options) as channel:
            yield channel

    def tls_context(self, name: str = "") -> ssl.SSLContext:
        """Return the context of an identity, or of somebody without a certificate."""
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        context.set_alpn_protocols(["h2"])
        if name:
            context.load_cert_chain(self.tls(name).certificate, self.tls(name).key)
        return context

    @property
    def endpoint(self) -> tuple[str, int]:
        """Return host and port."""
        return endpoint(self.address)


def endpoint(address: str) -> tuple[str, int]:
    host, _, port = address.rpartition(":")
    return host, int(port)


def hello(target: Target, width: int, height: int, cameras: int = 1, rate_hz: float = 0.0) -> Hello:
    header = DeltaEncoder(CodecConfig(width, height, "fast")).header
    k = Intrinsics(width, height, width / 2, width / 2, width / 2, height / 2)
    named = tuple(CameraDescription(f"c{i}", k, header, rate_hz) for i in range(cameras))
    contract = RendererContract(RENDERER_CONTRACT, exact=True)
    return Hello(VEHICLE, named, (target.field_id,), contract)


def frame(sequence: int, payload: bytes = b"", captured_ns: int = 1000) -> Frame:
    pose = Pose((0.0, 0.0, 1.6), (0.5, -0.5, 0.5, -0.5))
    packet = DeltaPacket(0, sequence, b"rr", b"", b"digest", payload)
    return Frame("c0", captured_ns, pose, "", packet)


async def for_ever(work: Callable[[], Awaitable[object]], pause_s: float = 0.0) -> None:
    """Do ``work`` again and again, whatever becomes of it."""
    while True:
        with suppress(
            grpc.aio.AioRpcError, asyncio.InvalidStateError, grpc.aio.UsageError, OSError
        ):
            await work()
        await asyncio.sleep(pause_s)


async def all_of(*works: Awaitable[object]) -> None:
    await asyncio.gather(*works)


async def stream_of(channel: grpc.aio.Channel, messages: AsyncIterator[bytes]) -> None:
    """Send messages as fast as they are taken, and read nothing."""
    call = channel.stream_stream(STREAM_METHOD)()
    async for data in messages:
        await call.write(data)
