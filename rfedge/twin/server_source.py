"""Fields and pictures from a mec-server: a consumer of TwinService and FieldService like any other.

Survives restarts of the server: what was shown stays, and says that it waits.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import grpc
import structlog

from cav_agent.field_cache import fetch_field
from rfcore.errors import AccessDenied, InvalidInput, ProtocolError, RfedgeError
from rfcore.field import FieldStore
from rfcore.wire.address import Address
from rfcore.wire.conventions import CONSUMER_OPTIONS
from rfcore.wire.tls import TlsFiles
from rfcore.wire.twin import (
    Departure,
    PictureEncoding,
    Subscription,
    TwinPicture,
    subscription_to_wire,
    twin_message_from_wire,
)
from rfcore.wire.v1 import field_pb2, twin_pb2_grpc
from rfcore.wire.v1.field_pb2_grpc import FieldServiceStub
from rfedge.twin.scene import CameraKey, PlacedField, SeenPicture, TwinScene

__all__ = ["ServerSource", "ServerTarget", "seen_picture"]

log = structlog.get_logger()

REFUSED = (
    grpc.StatusCode.PERMISSION_DENIED,
    grpc.StatusCode.UNAUTHENTICATED,
    grpc.StatusCode.UNIMPLEMENTED,
)
"""What does not pass by waiting."""
RETRY_S = 0.5
FIELDS_EVERY_S = 5.0


@dataclass(frozen=True)
class ServerTarget:
    """Which server, and how to speak to it. Raises ``InvalidInput`` for plaintext that would leave
    the machine without permission."""

    address: str
    fields: Path
    """Where fields are kept once they are fetched."""
    tls: TlsFiles | None = None
    allow_insecure: bool = False

    def __post_init__(self) -> None:
        address = Address.parse("address", self.address)
        if self.tls is None:
            address.require_private("address", self.allow_insecure)

    def channel(self) -> grpc.aio.Channel:
        """Return a channel to the server."""
        if self.tls is None:
            return grpc.aio.insecure_channel(self.address, options=CONSUMER_OPTIONS)
        return grpc.aio.secure_channel(
            self.address, self.tls.channel_credentials(), options=CONSUMER_OPTIONS
        )


class ServerSource:
    """Tells ``scene`` what a server shows. ``threads`` render each field that is fetched."""

    def __init__(
        self,
        target: ServerTarget,
        scene: TwinScene,
        threads: int = 1,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._target = target
        self._scene = scene
        self._threads = threads
        self._clock = clock
        self._store = FieldStore(target.fields)
        self._cameras: set[CameraKey] = set()

    async def run(self) -> None:
        """Watch until cancelled; raises ``AccessDenied`` where the server does not let us."""
        async with self._target.channel() as channel:
            fields = asyncio.create_task(self._follow_fields(channel))
            try:
                while True:
                    problem = await self._watch(channel)
                    self._say("waiting", problem)
                    await asyncio.sleep(RETRY_S)
            finally:
                fields.cancel()

    def _say(self, state: str, detail: str) -> None:
        self._scene.connection(state, detail, self._clock())

    async def _watch(self, channel: grpc.aio.Channel) -> str:
        """Show pictures until the stream ends; return why it did."""
        self._say("waiting", f"connecting to {self._target.address}")
        request = subscription_to_wire(Subscription(encoding=PictureEncoding.JPEG))
        call = twin_pb2_grpc.TwinServiceStub(channel).Watch(request, wait_for_ready=True)
        try:
            await call.initial_metadata()
            self._say("connected", self._target.address)
            async for response in call:
                self._take(twin_message_from_wire(response))
        except grpc.aio.AioRpcError as error:
            return _problem(error, "TwinService.Watch")
        except (ProtocolError, InvalidInput) as error:
            log.warning("the server sent what cannot be shown", problem=str(error))
            return str(error)
        finally:
            call.cancel()
            self._depart_all()
        return "the server ended the stream"

    def _take(self, message: TwinPicture | Departure) -> None:
        key = (message.vehicle_id, message.camera_id)
        if isinstance(message, Departure):
            self._cameras.discard(key)
            self._scene.leave(key, self._clock())
            return
        self._cameras.add(key)
        self._scene.show(seen_picture(message), self._clock())

    def _depart_all(self) -> None:
        for key in self._cameras:
            self._scene.leave(key, self._clock())
        self._cameras.clear()

    async def _follow_fields(self, channel: grpc.aio.Channel) -> None:
        """Fetch each field that the server publishes, and those that replace them."""
        stub = FieldServiceStub(channel)
        while True:
            try:
                request = field_pb2.ListFieldsRequest()
                listed = await stub.ListFields(request, wait_for_ready=True)
                tiles = {tile.name: tile.field_id for tile in listed.tiles}
                for tile, field_id in (tiles or {i[:8]: i for i in listed.field_ids}).items():
                    await self._bring(channel, tile, field_id)
            except grpc.aio.AioRpcError as error:
                log.info("fields cannot be listed", problem=error.details())
            await asyncio.sleep(FIELDS_EVERY_S)

    async def _bring(self, channel: grpc.aio.Channel, tile: str, field_id: str) -> None:
        if self._scene.field(field_id) is not None:
            return
        self._scene.note(tile, "being fetched", self._clock())
        try:
            if field_id not in await asyncio.to_thread(self._store.ids):
                await fetch_field(channel, self._store, field_id, self._target.fields)
            placed = await asyncio.to_thread(self._placed, tile, field_id)
        except (RfedgeError, OSError) as error:
            log.warning("field cannot be shown", field=field_id, problem=str(error))
            self._scene.note(tile, str(error), self._clock())
            return
        self._scene.place(placed, self._clock())

    def _placed(self, tile: str, field_id: str) -> PlacedField:
        return PlacedField.of(self._store.load(field_id, threads=self._threads), tile)


def seen_picture(picture: TwinPicture) -> SeenPicture:
    """Return a server's picture as the page shows it."""
    return SeenPicture(
        key=(picture.vehicle_id, picture.camera_id),
        sequence=picture.sequence,
        pose=picture.pose,
        intrinsics=picture.intrinsics,
        field_id=picture.field_id,
        jpeg=picture.picture,
        age_ms=picture.age_ns / 1e6,
        capture_time_ns=picture.capture_time_ns,
        payload_bytes=picture.payload_bytes,
        references=tuple(r.name.lower() for r in picture.references),
        skipped=picture.skipped,
        clock=picture.clock,
        localisation=picture.localisation,
        instant=picture.instant,
    )


def _problem(error: grpc.aio.AioRpcError, call: str) -> str:
    if error.code() in REFUSED:
        raise AccessDenied(f"{call}: {error.details()}") from error
    return f"{error.code().name.lower()}: {error.details()}"
