"""Radiance fields on the vehicle: fetched from a server, opened, made ready, and kept.

A frame can be coded once the field of its tile is prepared. A field that is not in the local store
is fetched from the server that publishes the tile: resumable, and its digest is checked before
anything of it is parsed.
"""

from __future__ import annotations

import asyncio
import hashlib
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import grpc
import structlog

from cav_agent.config import AgentConfig
from cav_agent.deadline import DeadlineController, DeadlineRungs, FixedRung, Rungs
from cav_agent.frame_log import DriveObserver
from cav_agent.handover import ServedTile
from cav_agent.server_connection import ServerConnection
from rfcore.camera import TileOrigin
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.sender.ladder import Rung, read_ladder
from rfcore.codec.sender.steering import Steering
from rfcore.dataset import read_dataset
from rfcore.errors import FieldFormatError, InvalidInput, RfedgeError, UnknownField
from rfcore.field import FieldStore, RadianceField
from rfcore.views import PosedPicture
from rfcore.wire.v1 import field_pb2 as pb
from rfcore.wire.v1.field_pb2_grpc import FieldServiceStub

if TYPE_CHECKING:
    from rfcore.wire.v1.field_pb2_grpc import FieldServiceAsyncStub

__all__ = [
    "MAX_FIELD_BYTES",
    "FieldCache",
    "PreparedField",
    "Store",
    "fetch_field",
    "read_drive",
]

log = structlog.get_logger()

MAX_FIELD_BYTES = 4 << 30
"""Longest archive the agent takes; more than any vehicle renders in time."""

MAX_RESUMES = 5
RETRIED = (grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.INTERNAL, grpc.StatusCode.CANCELLED)


MAX_PREPARED = 3
"""Fields kept ready: the previous tile's, the present one's and the next one's."""


class Store(Protocol):
    """A directory of field archives, as ``rfcore.field.FieldStore``."""

    def ids(self) -> tuple[str, ...]:
        """Return the ids of the fields there."""

    def add(self, source: bytes | Path, field_id: str | None = None) -> str:
        """Add an archive, checked against ``field_id`` before it is parsed."""


@dataclass(frozen=True)
class PreparedField:
    """A field that is ready to code against, and the drive as seen in its tile."""

    field: RadianceField
    pictures: tuple[PosedPicture, ...]
    """Posed relative to the field's tile origin."""
    codec: CodecConfig
    rungs: Rungs
    steering: Steering


class FieldCache:
    """Prepares fields by tile and keeps the last ``MAX_PREPARED``; tiles of one field share it.

    ``servers[i]`` is asked for a field of its tiles that is not in the local store.
    """

    def __init__(
        self, config: AgentConfig, servers: Sequence[ServerConnection], observer: DriveObserver
    ) -> None:
        self._config = config
        self._servers = tuple(servers)
        self._observer = observer
        self._prepared: OrderedDict[str, asyncio.Task[PreparedField]] = OrderedDict()

    async def prepared(self, served: ServedTile) -> PreparedField:
        """Return the tile's field, ready to code against; raise ``RfedgeError`` if it cannot be.

        A failure is not kept: the next call tries again.
        """
        tasks, field_id = self._prepared, served.tile.field_id
        task = tasks.get(field_id)
        if task is None or (task.done() and (task.cancelled() or task.exception())):
            task = tasks[field_id] = asyncio.create_task(self._load(served))
        tasks.move_to_end(field_id)
        while len(tasks) > MAX_PREPARED and next(iter(tasks.values())).done():
            tasks.popitem(last=False)
        return await asyncio.shield(task)

    async def close(self) -> None:
        """Stop what is being fetched or prepared."""
        for task in self._prepared.values():
            task.cancel()
        await asyncio.gather(*self._prepared.values(), return_exceptions=True)

    async def _load(self, served: ServedTile) -> PreparedField:
        config, field_id = self._config, served.tile.field_id
        folder, render = config.fields.expanduser(), config.render
        store = FieldStore(folder)
        if field_id not in store.ids():
            server = self._servers[served.server]
            channel = await server.require(config.limits.give_up_s or None)
            await fetch_field(channel, store, field_id, folder)
        field = await asyncio.to_thread(
            store.load, field_id, threads=render.threads, isa=render.isa
        )
        return await asyncio.to_thread(self._prepare, field)

    def _prepare(self, field: RadianceField) -> PreparedField:
        config = self._config
        pictures = read_drive(config, field.metadata.tile_origin)
        k = pictures[0].camera.intrinsics
        codec = CodecConfig(k.width_px, k.height_px, config.preset, config.crf)
        rungs = self._rungs(field)
        field.prepare()
        self._observer.field_ready(field, len(pictures))
        steering = config.steering.steering(codec.size_px)
        return PreparedField(field, pictures, codec, rungs, steering)

    def _rungs(self, field: RadianceField) -> Rungs:
        """Return how frames are coded; under a deadline prepare every renderer it may ask for."""
        config = self._config
        if config.deadline_ms is None:
            return FixedRung(Rung(preset=config.preset))
        ladder = read_ladder(config.ladder, field.metadata.kind, config.crf)
        for measured in ladder:
            field.prepare(measured.rung.quality)
        controller = DeadlineController(ladder, config.deadline_ms)
        log.info(
            "deadline",
            deadline_ms=config.deadline_ms,
            rungs=len(ladder),
            rung=controller.current.rung.name,
        )
        return DeadlineRungs(controller, self._observer.coded_under_deadline)


def read_drive(config: AgentConfig, origin: TileOrigin) -> tuple[PosedPicture, ...]:
    """Return the drive's pictures posed relative to ``origin``.

    Poses are rounded as on the wire before anything is rendered at them, so that both ends render
    at the same one. Raises ``InvalidInput`` unless all pictures are of one camera.
    """
    pictures = read_dataset(config.drive, tile_origin=origin).pictures
    intrinsics = pictures[0].camera.intrinsics
    for picture in pictures:
        if picture.camera.intrinsics != intrinsics:
            raise InvalidInput(
                "drive",
                f"{picture.name} has other intrinsics than {pictures[0].name}; "
                "one stream is one camera",
            )
    return tuple(map(_with_rounded_pose, pictures))


def _with_rounded_pose(picture: PosedPicture) -> PosedPicture:
    camera = picture.camera
    rounded = camera.rounded()
    return replace(picture, camera=rounded)


async def fetch_field(channel: grpc.aio.Channel, store: Store, field_id: str, folder: Path) -> None:
    """Put field ``field_id`` of the server into ``store``; what arrived before is not sent again.

    The partial file lies in ``folder``. Raises ``UnknownField`` when the server lacks the field,
    ``FieldFormatError`` when what arrives is not the field, ``RfedgeError`` when it does not come.
    """
    stub = FieldServiceStub(channel)
    partial = folder / f".{field_id}.part"
    size_bytes = await _size(stub, field_id)
    log.info("fetching field", field=field_id, size_bytes=size_bytes)
    await _receive_all(stub, field_id, partial, size_bytes)
    await asyncio.to_thread(_check_and_add, store, field_id, partial)
    log.info("field fetched", field=field_id)


async def _size(stub: FieldServiceAsyncStub, field_id: str) -> int:
    request = pb.GetManifestRequest(field_id=field_id)
    try:
        manifest = await stub.GetManifest(request, wait_for_ready=True)
    except grpc.aio.AioRpcError as error:
        if error.code() is grpc.StatusCode.NOT_FOUND:
            raise UnknownField(f"{error.details()} (asked for {field_id})") from error
        raise RfedgeError(f"the server has no manifest of {field_id}: {error.details()}") from error
    if not 0 < manifest.size_bytes <= MAX_FIELD_BYTES:
        raise FieldFormatError(
            f"field {field_id} has {manifest.size_bytes} bytes, at most {MAX_FIELD_BYTES} are taken"
        )
    return int(manifest.size_bytes)


async def _receive_all(
    stub: FieldServiceAsyncStub, field_id: str, partial: Path, size_bytes: int
) -> None:
    for resume in range(MAX_RESUMES + 1):
        try:
            await _receive(stub, field_id, partial, size_bytes)
            return
        except grpc.aio.AioRpcError as error:
            if error.code() not in RETRIED or resume == MAX_RESUMES:
                problem = f"{error.code().name}: {error.details()}"
                raise RfedgeError(f"field {field_id} does not arrive ({problem})") from error
            log.warning("field transfer interrupted", problem=error.details())


async def _receive(
    stub: FieldServiceAsyncStub, field_id: str, partial: Path, size_bytes: int
) -> None:
    have_bytes = partial.stat().st_size if partial.exists() else 0
    if have_bytes >= size_bytes:
        return
    request = pb.FetchFieldRequest(field_id=field_id, offset_bytes=have_bytes)
    with partial.open("ab") as file:
        async for response in stub.FetchField(request, wait_for_ready=True):
            end_bytes = response.offset_bytes + len(response.chunk)
            if response.offset_bytes != have_bytes or end_bytes > size_bytes:
                raise FieldFormatError(
                    f"the server sent bytes {response.offset_bytes}..{end_bytes} of field "
                    f"{field_id} where {have_bytes}.. of {size_bytes} were expected"
                )
            await asyncio.to_thread(file.write, response.chunk)
            have_bytes = end_bytes
    if have_bytes != size_bytes:
        raise FieldFormatError(
            f"field {field_id} ended after {have_bytes} of {size_bytes} bytes; try again"
        )


def _check_and_add(store: Store, field_id: str, partial: Path) -> None:
    """Add the file to the store, or remove it: a wrong digest cannot be resumed from."""
    try:
        with partial.open("rb") as file:
            found = hashlib.file_digest(file, "sha256").hexdigest()
        if found != field_id:
            raise FieldFormatError(
                f"what the server sent as field {field_id} has sha256 {found}; it was removed"
            )
        store.add(partial, field_id)
    finally:
        partial.unlink(missing_ok=True)
