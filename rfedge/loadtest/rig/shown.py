"""What the server shows while the vehicles drive: a consumer of the twin that keeps every picture.

``PSNR`` needs the pictures and the spread of an instant the times at which they are shown; both are
taken from ``TwinService`` as any consumer sees them.
"""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import grpc

from rfcore.wire.conventions import CHANNEL_OPTIONS
from rfcore.wire.twin import (
    PictureEncoding,
    Subscription,
    TwinPicture,
    subscription_to_wire,
    twin_message_from_wire,
)
from rfcore.wire.v1 import twin_pb2_grpc

__all__ = ["Spread", "TwinKeeper", "instants_apart", "spreads_of"]

LONGEST_MESSAGE_BYTES = 64 << 20


class TwinKeeper:
    """Keeps the pictures of a server, in the order in which they were shown, inside ``with``."""

    def __init__(self, address: str) -> None:
        length = "grpc.max_receive_message_length"
        options = [*(o for o in CHANNEL_OPTIONS if o[0] != length), (length, LONGEST_MESSAGE_BYTES)]
        self._channel = grpc.insecure_channel(address, options=options)
        self._thread = threading.Thread(target=self._run, name="twin")
        self.pictures: list[TwinPicture] = []

    def __enter__(self) -> TwinKeeper:
        request = subscription_to_wire(Subscription(encoding=PictureEncoding.I420))
        stub = twin_pb2_grpc.TwinServiceStub(self._channel)
        self._call = stub.Watch(request, wait_for_ready=True)
        self._call.initial_metadata()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._call.cancel()
        self._thread.join()
        self._channel.close()

    def _run(self) -> None:
        try:
            for response in self._call:
                message = twin_message_from_wire(response)
                if isinstance(message, TwinPicture):
                    self.pictures.append(message)
        except grpc.RpcError as error:
            if self._call.code() is not grpc.StatusCode.CANCELLED:
                raise error


@dataclass(frozen=True)
class Spread:
    """The milliseconds from the first to the last picture of each instant that is whole."""

    whole: int
    milliseconds: tuple[float, ...]


def spreads_of(pictures: Sequence[TwinPicture], cameras: int) -> Spread:
    """Return the spreads of the instants that ``cameras`` cameras have shown."""
    shown_ns: dict[int, dict[str, int]] = defaultdict(dict)
    for picture in pictures:
        shown_ns[picture.instant][picture.camera_id] = picture.capture_time_ns + picture.age_ns
    whole = [times.values() for times in shown_ns.values() if len(times) == cameras]
    return Spread(len(whole), tuple((max(times) - min(times)) / 1e6 for times in whole))


def instants_apart(pictures: Sequence[TwinPicture], cameras: int) -> int | None:
    """Return how many instants the newest pictures of two cameras were apart at most.

    Counted once every camera has shown one; ``None`` if that never was. Instants that no camera
    has shown, since they were superseded before they were coded, do not count.
    """
    ranks = {n: rank for rank, n in enumerate(sorted({p.instant for p in pictures}))}
    newest: dict[str, int] = {}
    most = None
    for picture in pictures:
        newest[picture.camera_id] = ranks[picture.instant]
        if len(newest) == cameras:
            most = max(most or 0, max(newest.values()) - min(newest.values()))
    return most
