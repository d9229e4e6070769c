"""Helpers for tests that talk to a server: metrics, certificates, consumers, watched decoders."""

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import grpc

from mec_server.reconstruction import Decoder, FieldSource, Reconstruction, Tools, open_cameras
from mec_server.session import DecodeJob, OpenJob, PrepareJob
from rfcore.wire.conventions import CHANNEL_OPTIONS, CONSUMER_OPTIONS, STREAM_METHOD
from rfcore.wire.convert import hello_to_bytes
from rfcore.wire.convert_answers import AnswerReader
from rfcore.wire.messages import Hello, Welcome
from rfcore.wire.tls import TlsFiles
from rfcore.wire.twin import Subscription, subscription_to_wire
from rfcore.wire.v1 import twin_pb2_grpc
from rfedge.certs import Members, certify, write_certificates

Files = Callable[[str], TlsFiles]
"""Returns the files of a certificate by its name."""


def counted(server: Any, name: str, **labels: str) -> float:
    """Return a sample of the server's metrics, 0 where it is not there yet."""
    return float(server.registry.get_sample_value(name, labels) or 0.0)


def limited(server: Any, limit: str) -> float:
    return counted(server, "rfedge_server_limited_total", limit=limit)


def held(server: Any, resource: str) -> float:
    return counted(server, "rfedge_server_held", resource=resource)


async def until(condition: Callable[[], Any], within_s: float = 60.0) -> Any:
    """Return the first true value of ``condition``."""
    async with asyncio.timeout(within_s):
        while not (value := condition()):
            await asyncio.sleep(0.002)
    return value


def certificates(root: Path, members: Members, age_days: int = 0) -> Files:
    """Make certificates in ``root``; return what finds them."""
    now = datetime.now(UTC) - timedelta(days=age_days)
    write_certificates(root, certify(members, now, days=30))
    return lambda name: TlsFiles(root / f"{name}.pem", root / f"{name}.key", root / "ca.pem")


def tls_options(root: Path, name: str, authority: Path | None = None) -> tuple[str, ...]:
    """Return the options of a service or a vehicle with a certificate of ``root``."""
    files = {"cert": root / f"{name}.pem", "key": root / f"{name}.key"}
    files["ca"] = authority or root / "ca.pem"
    return tuple(str(part) for end, file in files.items() for part in (f"--tls-{end}", file))


async def port_opens(address: str) -> float:
    """Return the second of the Unix epoch at which a connection to the address succeeds."""
    host, _, port = address.rpartition(":")
    while True:
        try:
            _, writer = await asyncio.open_connection(host, int(port))
        except OSError:
            await asyncio.sleep(0.005)
        else:
            writer.close()
            return time.time()


def channel_to(address: object, tls: TlsFiles) -> grpc.aio.Channel:
    """Return a connection of its own: channels of one certificate share none."""
    credentials = tls.channel_credentials()
    return grpc.aio.secure_channel(str(address), credentials, options=CHANNEL_OPTIONS)


async def open_stream(channel: grpc.aio.Channel, hello: Hello, metadata: Any = ()) -> Any:
    """Open a vehicle's stream and expect its Welcome, and credit for each camera.

    gRPC tells how a stream ended only when all its messages were read.
    """
    stream = channel.stream_stream(STREAM_METHOD)(metadata=metadata)
    await stream.write(hello_to_bytes(hello))
    reader = AnswerReader(camera.camera_id for camera in hello.cameras)
    answers = list(reader.messages(await stream.read()))
    assert isinstance(answers[0], Welcome)
    while len(answers) <= len(hello.cameras):
        answers += reader.messages(await stream.read())
    return stream


def watch_call(channel: grpc.aio.Channel, subscription: Subscription | None = None) -> Any:
    """Return a call of ``TwinService.Watch``."""
    request = subscription_to_wire(subscription or Subscription())
    return twin_pb2_grpc.TwinServiceStub(channel).Watch(request)


@asynccontextmanager
async def consumer(address: object, subscription: Subscription | None = None) -> AsyncIterator[Any]:
    """Watch over a connection of its own; yield the call once the server has accepted it."""
    async with grpc.aio.insecure_channel(str(address), options=CONSUMER_OPTIONS) as channel:
        call = watch_call(channel, subscription)
        await call.initial_metadata()
        yield call


class WatchedDecoder:
    """Calls ``before`` on the worker for each frame, then has ``decoder`` render and decode it."""

    def __init__(self, decoder: Decoder, before: Callable[[DecodeJob], None]) -> None:
        self._decoder = decoder
        self._before = before

    def prepare(self, job: PrepareJob) -> None:
        self._decoder.prepare(job)

    def reconstruct(self, job: DecodeJob) -> Reconstruction:
        self._before(job)
        return self._decoder.reconstruct(job)

    def close(self) -> None:
        self._decoder.close()


def watched(before: Callable[[str, DecodeJob], None]) -> Callable[..., dict[str, Decoder]]:
    """Return ``open_cameras`` with decoders that call ``before`` with vehicle and frame."""

    def opened(job: OpenJob, fields: FieldSource, tools: Tools) -> dict[str, Decoder]:
        vehicle_id = job.hello.vehicle_id
        return {
            name: WatchedDecoder(decoder, lambda frame: before(vehicle_id, frame))
            for name, decoder in open_cameras(job, fields, tools).items()
        }

    return opened
