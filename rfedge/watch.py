"""A consumer of the twin: reads the stream, prints a line a picture, and keeps what it is told to.

One thread that blocks: if the disk is slow, this consumer misses pictures and says how many.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import grpc

from rfcore.errors import InvalidInput, RfedgeError
from rfcore.wire.address import Address
from rfcore.wire.checks import check_name
from rfcore.wire.conventions import CHANNEL_OPTIONS
from rfcore.wire.handshake import check_handshake
from rfcore.wire.tls import TlsFiles
from rfcore.wire.twin import (
    Departure,
    PictureEncoding,
    TwinPicture,
    Wish,
    watch_request,
    watched,
)
from rfcore.wire.v1 import twin_pb2_grpc
from rfedge.watch_files import PictureFolder, PictureVideo

__all__ = ["WatchSettings", "watch"]

LONGEST_MESSAGE_BYTES = 64 << 20
"""A raw picture of 8192x4320 px and its header."""

CONNECT_S = 10.0


@dataclass(frozen=True)
class WatchSettings:
    """What to watch and what to keep; see ``rfedge watch --help``."""

    address: str
    vehicle_ids: frozenset[str] = frozenset()
    folder: Path | None = None
    video: Path | None = None
    encoding: str | None = None
    pictures: int | None = None
    tls: TlsFiles | None = None
    allow_insecure: bool = False

    def __post_init__(self) -> None:
        address = Address.parse("address", self.address)
        if self.tls is None:
            address.require_private("address", self.allow_insecure)
        for name in self.vehicle_ids:
            check_name("vehicle", name)
        if self.pictures is not None and self.pictures < 1:
            raise InvalidInput("pictures", f"{self.pictures} must be at least 1")
        if self.video is not None and self.wish.encoding is not PictureEncoding.I420:
            raise InvalidInput("encoding", f"{self.encoding} makes no video; leave it out")
        if self.folder is not None and self.wish.encoding is PictureEncoding.NONE:
            raise InvalidInput("encoding", "none leaves nothing to keep; leave it out")

    @property
    def wish(self) -> Wish:
        """What to ask the server for."""
        encoding = PictureEncoding.NONE
        if self.encoding is not None:
            encoding = PictureEncoding(self.encoding)
        elif self.video is not None:
            encoding = PictureEncoding.I420
        elif self.folder is not None:
            encoding = PictureEncoding.JPEG
        return Wish(self.vehicle_ids, encoding)


def watch(settings: WatchSettings) -> None:
    """Watch to the end; raise ``RfedgeError`` when the server cannot be reached or refuses."""
    with ExitStack() as stack:
        folder = PictureFolder(settings.folder) if settings.folder else None
        video = stack.enter_context(PictureVideo(settings.video)) if settings.video else None
        messages = stack.enter_context(_Stream(settings))
        pictures = 0
        for message in messages:
            print(_line(message), flush=True)
            if isinstance(message, Departure):
                continue
            if folder is not None:
                folder.keep(message)
            if video is not None:
                video.keep(message)
            pictures += 1
            if pictures == settings.pictures:
                return


class _Stream:
    """The server's messages, as an iterator that is closed by leaving the context."""

    def __init__(self, settings: WatchSettings) -> None:
        self._settings = settings
        options = (
            *(o for o in CHANNEL_OPTIONS if o[0] != "grpc.max_receive_message_length"),
            ("grpc.max_receive_message_length", LONGEST_MESSAGE_BYTES),
        )
        if settings.tls is None:
            self._channel = grpc.insecure_channel(settings.address, options=options)
        else:
            credentials = settings.tls.channel_credentials()
            self._channel = grpc.secure_channel(settings.address, credentials, options=options)

    def __enter__(self) -> Iterator[TwinPicture | Departure]:
        try:
            grpc.channel_ready_future(self._channel).result(timeout=CONNECT_S)
        except grpc.FutureTimeoutError as error:
            self._channel.close()
            check_handshake(Address.parse("address", self._settings.address), self._settings.tls)
            raise RfedgeError(
                f"no server at {self._settings.address} within {CONNECT_S:g} s"
            ) from error
        return self._messages()

    def __exit__(self, *exception: object) -> None:
        self._channel.close()

    def _messages(self) -> Iterator[TwinPicture | Departure]:
        stub = twin_pb2_grpc.TwinServiceStub(self._channel)
        try:
            for response in stub.Watch(watch_request(self._settings.wish)):
                yield watched(response)
        except grpc.RpcError as error:
            raise RfedgeError(_said(error)) from error


def _said(error: grpc.RpcError) -> str:
    if not isinstance(error, grpc.Call):
        return str(error)
    return f"{error.code().name.lower()}: {error.details()}"


def _line(message: TwinPicture | Departure) -> str:
    if isinstance(message, Departure):
        return f"{message.vehicle_id}/{message.camera_id} left"
    x_m, y_m, z_m = message.pose.translation_m
    return (
        f"{message.vehicle_id}/{message.camera_id} {message.epoch}:{message.sequence:<6} "
        f"age {message.age_ns / 1e6:6.1f} ms  at {x_m:.2f} {y_m:.2f} {z_m:.2f} m  "
        f"{len(message.picture)} bytes  missed {message.skipped}"
    )
