"""Messages between a server's twin and its consumers: plain values, to and from protobuf.

What comes from a peer is checked here: a request that is wrong raises ``InvalidInput``, a response
that is wrong ``ProtocolError``.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, Generic, TypeVar

from rfcore.camera import Intrinsics, Pose
from rfcore.codec.references import References
from rfcore.errors import InvalidInput, ProtocolError
from rfcore.image import I420, Rgb, jpeg_bytes, png_bytes, rgb_from_bytes
from rfcore.localise.estimate import LocalisationState
from rfcore.native.yuv import i420_from_rgb, rgb_from_i420
from rfcore.perception.objects import CameraKey
from rfcore.wire.v1 import twin_pb2
from rfcore.wire.values import (
    ClockKind,
    check_name,
    check_range,
    clock_from_wire,
    clock_to_wire,
    intrinsics_from_wire,
    intrinsics_to_wire,
    localisation_from_wire,
    localisation_to_wire,
    pose_from_wire,
    pose_to_wire,
    references_from_wire,
    references_to_wire,
    same_named,
)

MAX_WATCHED_VEHICLES: Final = 256
"""Vehicles one consumer may name; without naming any it sees all."""


class PictureEncoding(StrEnum):
    """The encoding of a picture on the wire: see twin.proto."""

    NONE = "none"
    I420 = "i420"
    JPEG = "jpeg"
    PNG = "png"


@dataclass(frozen=True)
class Subscription:
    """The vehicles whose pictures a consumer wants (all if none is named), and their encoding."""

    vehicle_ids: frozenset[str] = frozenset()
    encoding: PictureEncoding = PictureEncoding.JPEG

    def includes(self, vehicle_id: str) -> bool:
        """Return whether pictures of this vehicle are asked for."""
        return not self.vehicle_ids or vehicle_id in self.vehicle_ids


@dataclass(frozen=True)
class TwinPicture:
    """One reconstructed picture.

    ``pose``: world_from_cam, relative to the tile's origin; None while the vehicle is lost.
    ``age_ns``: from capture until the server sent it. ``decoding_ns``: from the last byte of its
    frame until the server had it. ``skipped``: pictures of this camera that
    this consumer has missed. ``payload_bytes``: length of the slice that it was decoded from.
    ``clock``: where a live camera's capture time comes from. ``localisation``: state of a vehicle
    that finds its camera in the field; None if its poses are given. ``instant``: pictures of one
    session with the same number were taken together; 0 if the camera is not part of a rig.
    """

    vehicle_id: str
    camera_id: str
    session_id: str
    epoch: int
    sequence: int
    capture_time_ns: int
    age_ns: int
    pose: Pose | None
    intrinsics: Intrinsics
    field_id: str
    reconstruction_digest: bytes
    encoding: PictureEncoding
    picture: bytes
    skipped: int = 0
    payload_bytes: int = 0
    references: References = ()
    clock: ClockKind | None = None
    localisation: LocalisationState | None = None
    instant: int = 0
    decoding_ns: int = 0

    @property
    def key(self) -> CameraKey:
        """The vehicle and camera that it is of."""
        return (self.vehicle_id, self.camera_id)

    @property
    def planes(self) -> I420:
        """The planes of a picture that was asked for as I420: those of the vehicle, to the bit."""
        return I420.unpacked(_size_px(self.intrinsics), self.picture)

    @property
    def rgb(self) -> Rgb:
        """The picture as uint8 [H, W, 3]; raises ``DatasetError`` for one that did not travel."""
        return decoded_picture(self.encoding, _size_px(self.intrinsics), self.picture)


def encoded_picture(picture: I420 | Rgb, encoding: PictureEncoding) -> bytes:
    """Return a picture, planes or uint8 [H, W, 3], as bytes: see ``PictureEncoding``."""
    if encoding is PictureEncoding.NONE:
        return b""
    if encoding is PictureEncoding.I420:
        planes = picture if isinstance(picture, I420) else i420_from_rgb(picture)
        return planes.packed()
    rgb = rgb_from_i420(picture) if isinstance(picture, I420) else picture
    return jpeg_bytes(rgb) if encoding is PictureEncoding.JPEG else png_bytes(rgb)


def decoded_picture(encoding: PictureEncoding, size_px: tuple[int, int], data: bytes) -> Rgb:
    """Return a picture that a server sent, uint8 [H, W, 3]; raise ``DatasetError`` for none."""
    if encoding is PictureEncoding.I420:
        return rgb_from_i420(I420.unpacked(size_px, data))
    return rgb_from_bytes(data, "the server's picture")


def _size_px(k: Intrinsics) -> tuple[int, int]:
    return (k.width_px, k.height_px)


@dataclass(frozen=True)
class Departure:
    """Notice that a vehicle's camera sends no more pictures."""

    vehicle_id: str
    camera_id: str

    @property
    def key(self) -> CameraKey:
        """The vehicle and camera that it is of."""
        return (self.vehicle_id, self.camera_id)


def subscription_to_wire(subscription: Subscription) -> twin_pb2.WatchRequest:
    """Return a consumer's request as protobuf."""
    return twin_pb2.WatchRequest(
        vehicle_ids=sorted(subscription.vehicle_ids),
        encoding=encoding_to_wire(subscription.encoding),
    )


def subscription_from_wire(request: twin_pb2.WatchRequest) -> Subscription:
    """Return what a consumer asks for; raise ``InvalidInput`` for a value outside its limits."""
    check_range("vehicle_ids", len(request.vehicle_ids), 0, MAX_WATCHED_VEHICLES)
    names = (check_name(f"vehicle_ids[{i}]", name) for i, name in enumerate(request.vehicle_ids))
    if request.encoding == twin_pb2.PICTURE_ENCODING_UNSPECIFIED:
        return Subscription(frozenset(names))
    return Subscription(frozenset(names), encoding_from_wire(request.encoding))


def twin_message_to_wire(message: TwinPicture | Departure) -> twin_pb2.WatchResponse:
    """Return a server's message as protobuf."""
    if isinstance(message, Departure):
        departure = twin_pb2.Departure(vehicle_id=message.vehicle_id, camera_id=message.camera_id)
        return twin_pb2.WatchResponse(departure=departure)
    return twin_pb2.WatchResponse(picture=_picture_to_wire(message))


def twin_message_from_wire(response: twin_pb2.WatchResponse) -> TwinPicture | Departure:
    """Return a server's message; raise ``ProtocolError`` for one no server of ours would send."""
    try:
        match response.WhichOneof("message"):
            case "picture":
                return _picture_from_wire(response.picture)
            case "departure":
                gone = response.departure
                return Departure(
                    check_name("departure.vehicle_id", gone.vehicle_id),
                    check_name("departure.camera_id", gone.camera_id),
                )
    except InvalidInput as error:
        raise ProtocolError(f"the server sent an impossible picture: {error}") from error
    raise ProtocolError("the server sent a message this program does not know; update it")


def _picture_to_wire(message: TwinPicture) -> twin_pb2.TwinPicture:
    values = {
        **vars(message),
        "pose": None if message.pose is None else pose_to_wire(message.pose),
        "intrinsics": intrinsics_to_wire(message.intrinsics),
        "encoding": encoding_to_wire(message.encoding),
        "references": references_to_wire(message.references),
        "capture_clock": clock_to_wire(message.clock),
        "localisation": localisation_to_wire(message.localisation),
    }
    del values["clock"]
    return twin_pb2.TwinPicture(**values)


def _picture_from_wire(picture: twin_pb2.TwinPicture) -> TwinPicture:
    return same_named(
        TwinPicture,
        picture,
        vehicle_id=check_name("picture.vehicle_id", picture.vehicle_id),
        camera_id=check_name("picture.camera_id", picture.camera_id),
        pose=pose_from_wire(picture.pose) if picture.HasField("pose") else None,
        intrinsics=intrinsics_from_wire(picture.intrinsics),
        encoding=encoding_from_wire(picture.encoding),
        references=references_from_wire("picture.references", tuple(picture.references)),
        clock=clock_from_wire(picture.capture_clock),
        localisation=localisation_from_wire(picture.localisation),
    )


def encoding_to_wire(encoding: PictureEncoding) -> twin_pb2.PictureEncoding.ValueType:
    """Return an encoding as protobuf."""
    return twin_pb2.PictureEncoding.Value(f"PICTURE_ENCODING_{encoding.name}")


def encoding_from_wire(number: int) -> PictureEncoding:
    """Return an encoding; raise ``InvalidInput`` for a number that is none."""
    for encoding in PictureEncoding:
        if encoding_to_wire(encoding) == number:
            return encoding
    raise InvalidInput("encoding", f"{number} is no picture encoding this program knows")


K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


class NewestQueue(Generic[K, V]):
    """Entries that wait for one reader: at most one of each key, the longest waiting first.

    A reader that takes entries slowly misses older ones of a key, but never the newest, and takes
    bounded memory. ``missed`` counts the entries that were replaced; ``arrived`` is called for
    each entry. Not thread-safe.
    """

    def __init__(self, arrived: Callable[[], None]) -> None:
        self.missed = 0
        self._arrived = arrived
        self._waiting: OrderedDict[K, V] = OrderedDict()

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, key: K, entry: V) -> bool:
        """Add ``entry``; return whether it replaced one of its key, whose turn it then has."""
        replaced = key in self._waiting
        self.missed += replaced
        self._waiting[key] = entry
        self._arrived()
        return replaced

    def discard(self, key: K) -> None:
        """Remove the entry of ``key``, if one waits; it does not count as missed."""
        self._waiting.pop(key, None)

    def take(self) -> V | None:
        """Remove and return the entry that waits longest; None if there is none."""
        return self._waiting.popitem(last=False)[1] if self._waiting else None
