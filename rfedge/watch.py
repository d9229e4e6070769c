"""A consumer of the twin: reads the stream, prints a line a picture, and keeps what it is told to.

One thread that blocks: if the disk is slow, this consumer misses pictures and says how many.

What a consumer of the twin keeps on disk: pictures in folders, or one camera as a video.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import TracebackType

import av
import grpc
import numpy as np

from rfcore.errors import InvalidInput, RfedgeError
from rfcore.files import write_whole
from rfcore.image import I420, png_bytes
from rfcore.native.yuv import rgb_from_i420
from rfcore.wire.address import Address, check_handshake
from rfcore.wire.checks import check_name
from rfcore.wire.conventions import CHANNEL_OPTIONS
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

__all__ = ["PictureFolder", "PictureVideo", "WatchSettings", "watch"]


TICKS_PER_S = 90_000
"""Of a video's clock, as in MPEG systems."""


class PictureFolder:
    """FOLDER/VEHICLE/CAMERA/SESSION-EPOCH-SEQUENCE.png or .jpg, with a line each in index.jsonl."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def keep(self, picture: TwinPicture) -> None:
        """Write a picture; one that travelled as I420 becomes PNG."""
        folder = self._folder / picture.vehicle_id / picture.camera_id
        folder.mkdir(parents=True, exist_ok=True)
        is_jpeg = picture.encoding is PictureEncoding.JPEG
        name = f"{picture.session_id}-e{picture.epoch:04}-{picture.sequence:06}"
        name += ".jpg" if is_jpeg else ".png"
        data = picture.picture
        if picture.encoding is PictureEncoding.I420:
            data = png_bytes(rgb_from_i420(_planes(picture)))
        write_whole(folder / name, data)
        line = {
            "file": name,
            "session": picture.session_id,
            "epoch": picture.epoch,
            "sequence": picture.sequence,
            "capture_time_ns": picture.capture_time_ns,
            "age_ms": picture.age_ns / 1e6,
            "translation_m": picture.pose.translation_m,
            "rotation_wxyz": picture.pose.rotation,
            "field": picture.field_id,
            "digest": picture.reconstruction_digest.hex(),
            "missed": picture.skipped,
        }
        with (folder / "index.jsonl").open("a") as index:
            index.write(json.dumps(line) + "\n")


class PictureVideo:
    """One camera as H.264 in MP4; pictures of others, or of another size, are left out.

    A picture's time is its capture, so a gap in the stream is a still in the video.
    """

    def __init__(self, path: Path) -> None:
        self._container = av.open(str(path), "w", format="mp4")
        self._stream: av.VideoStream | None = None
        self._first: TwinPicture | None = None
        self._last_tick = -1

    def __enter__(self) -> PictureVideo:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._stream is not None:
            self._container.mux(self._stream.encode(None))
        self._container.close()

    def keep(self, picture: TwinPicture) -> None:
        """Append a picture, unless it is of another camera or not later than the last one."""
        first = self._first = self._first or picture
        if _camera(picture) != _camera(first):
            return
        tick = (picture.capture_time_ns - first.capture_time_ns) * TICKS_PER_S // 10**9
        if tick <= self._last_tick:
            return
        self._last_tick = tick
        stream = self._stream = self._stream or self._open(picture)
        frame = av.VideoFrame.from_ndarray(_even(_planes(picture)), format="yuv420p")
        frame.pts, frame.time_base = tick, Fraction(1, TICKS_PER_S)
        self._container.mux(stream.encode(frame))

    def _open(self, picture: TwinPicture) -> av.VideoStream:
        stream = self._container.add_stream(
            "libx264", options={"crf": "18", "preset": "veryfast", "bf": "0"}
        )
        k = picture.intrinsics
        stream.width, stream.height = k.width_px // 2 * 2, k.height_px // 2 * 2
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = Fraction(1, TICKS_PER_S)
        return stream


def _camera(picture: TwinPicture) -> tuple[str, str, int, int]:
    k = picture.intrinsics
    return (picture.vehicle_id, picture.camera_id, k.width_px, k.height_px)


def _planes(picture: TwinPicture) -> I420:
    k = picture.intrinsics
    return I420.unpacked((k.width_px, k.height_px), picture.picture)


def _even(picture: I420) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    """Return the planes as PyAV wants them, [3/2 H, W], an odd row or column cut off."""
    height, width = (n // 2 * 2 for n in picture.y.shape)
    chroma = (plane[: height // 2, : width // 2].reshape(-1) for plane in (picture.u, picture.v))
    flat = np.concatenate([picture.y[:height, :width].reshape(-1), *chroma])
    return flat.reshape(height * 3 // 2, width)


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
