"""Radiance fields on the vehicle: fetched from a server, opened, made ready, and kept.

A frame can be coded once the field of its tile is prepared. A field that is not in the local store
is fetched from the server that publishes the tile: resumable, and its digest is checked before
anything of it is parsed. Where the server publishes a preview of the tile, that is fetched first
and drawn while the tile's own field arrives.
"""

from __future__ import annotations

import asyncio
import hashlib
import itertools
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import grpc
import structlog

from cav_agent.config import AgentConfig
from cav_agent.deadline import DeadlineController, DeadlineRungs, FixedRung, Rungs
from cav_agent.drive_pictures import (
    OneCamera,
    RecordedPictures,
    RecordedRig,
    VehicleCamera,
    VehiclePictures,
)
from cav_agent.frame_log import DriveObserver
from cav_agent.handover import ServedTile
from cav_agent.lights import TileLights
from cav_agent.server_connection import ServerConnection, retry_after_s
from rfcore.camera import TileOrigin
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.sender.ladder import MeasuredRung, Rung, read_ladder
from rfcore.codec.sender.steering import Steering
from rfcore.dataset import read_dataset
from rfcore.dataset.rig import read_rig, read_rig_drive
from rfcore.errors import FieldFormatError, InvalidInput, RfedgeError, UnknownField
from rfcore.field import FieldStore, RadianceField
from rfcore.views import PosedPicture
from rfcore.wire.tiles import Tile
from rfcore.wire.v1 import field_pb2 as pb
from rfcore.wire.v1.field_pb2_grpc import FieldServiceStub

if TYPE_CHECKING:
    from rfcore.wire.v1.field_pb2_grpc import FieldServiceAsyncStub

Metadata = tuple[tuple[str, str], ...]

__all__ = [
    "MAX_FIELD_BYTES",
    "FieldCache",
    "PreparedCamera",
    "PreparedField",
    "Store",
    "fetch_field",
    "read_drive",
]

log = structlog.get_logger()

MAX_FIELD_BYTES = 4 << 30
"""Longest archive the agent takes; more than any vehicle renders in time."""

MAX_RESUMES = 5
MAX_REFUSALS = 60
"""Tries of a transfer that broke, and of one that a server has no room for: about a minute."""

RETRIED = (grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.INTERNAL, grpc.StatusCode.CANCELLED)


OWN_AGAIN_S = 10.0
"""From a failure to fetch a tile's own field to the next try, while its preview is drawn."""

MAX_PREPARED = 3
"""Fields kept ready: the previous tile's, the present one's and the next one's."""


class Store(Protocol):
    """A directory of field archives, as ``rfcore.field.FieldStore``."""

    def ids(self) -> tuple[str, ...]:
        """Return the ids of the fields there."""

    def add(self, source: bytes | Path, field_id: str | None = None) -> str:
        """Add an archive, checked against ``field_id`` before it is parsed."""


@dataclass(frozen=True)
class PreparedCamera:
    """How one camera's pictures are coded."""

    camera: VehicleCamera
    codec: CodecConfig
    steering: Steering


@dataclass(frozen=True)
class PreparedField:
    """A field that is ready to code against, and the drive as seen in its tile."""

    field: RadianceField
    pictures: VehiclePictures
    """Posed relative to the field's tile origin, or not posed: a live camera's."""
    cameras: tuple[PreparedCamera, ...]
    rungs: Rungs
    lights: TileLights
    field_ids: tuple[str, ...]
    """Those that frames may be coded against, the field's own first."""


class FieldCache:
    """Prepares fields by tile and keeps the last ``MAX_PREPARED``; tiles of one field share it.

    ``servers[i]`` is asked for a field of its tiles that is not in the local store.
    """

    def __init__(
        self,
        config: AgentConfig,
        servers: Sequence[ServerConnection],
        observer: DriveObserver,
        live: VehiclePictures | None = None,
    ) -> None:
        self._config = config
        self._live = live
        self._instants = itertools.count(1)
        self._servers = tuple(servers)
        self._observer = observer
        self._prepared: OrderedDict[Tile, asyncio.Task[PreparedField]] = OrderedDict()
        self._fetching: dict[Tile, asyncio.Task[None]] = {}
        self._fetching_own: set[asyncio.Task[None]] = set()

    async def prepared(self, served: ServedTile) -> PreparedField:
        """Return the tile's field, ready to code against; raise ``RfedgeError`` if it cannot be.

        A failure is not kept: the next call tries again.
        """
        tasks, tile = self._prepared, _without_ground(served.tile)
        task = tasks.get(tile)
        if task is None or (task.done() and (task.cancelled() or task.exception())):
            task = tasks[tile] = asyncio.create_task(self._load(served))
        tasks.move_to_end(tile)
        while len(tasks) > MAX_PREPARED and next(iter(tasks.values())).done():
            tasks.popitem(last=False)
        return await asyncio.shield(task)

    async def close(self) -> None:
        """Stop what is being fetched or prepared."""
        tasks: list[asyncio.Task[Any]] = [*self._prepared.values(), *self._fetching.values()]
        tasks += self._fetching_own
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _load(self, served: ServedTile) -> PreparedField:
        tile, loop = served.tile, asyncio.get_running_loop()
        preview = await self._preview(tile)
        field = await self._opened(served, preview or (tile.field_id,))

        def want() -> None:
            loop.call_soon_threadsafe(self._fetch_lights, served, lights)

        lights = TileLights(field, want if tile.other_lights else lambda: None, tile.field_id)
        prepared = await asyncio.to_thread(self._prepare, field, lights, tile.renderable_ids)
        if preview:
            fetching = asyncio.create_task(self._take_own(served, lights))
            self._fetching_own.add(fetching)
            fetching.add_done_callback(self._fetching_own.discard)
        return prepared

    async def _preview(self, tile: Tile) -> tuple[str, ...]:
        """Return the archives of the field to begin with; none if the tile's own is here.

        None either where a camera is looked for in the field (``--localise``), on another thread
        than takes a preview's place, or within its bounds (a feed's).
        """
        config = self._config
        waits = config.localise or config.feed.source is not None
        if tile.preview is None or waits:
            return ()
        held = await asyncio.to_thread(FieldStore(config.fields.expanduser()).ids)
        return () if tile.field_id in held else tile.preview.field_ids

    async def _take_own(self, served: ServedTile, lights: TileLights) -> None:
        """Fetch the tile's own field and have it drawn; try again until it is there."""
        while True:
            try:
                field = await self._opened(served, (served.tile.field_id,))
                _check_origin(field, lights.own)
                await asyncio.to_thread(_prepare_renderers, field, self._ladder(field))
            except RfedgeError as error:
                log.warning("own field not fetched", tile=served.tile.name, problem=str(error))
                await asyncio.sleep(OWN_AGAIN_S)
            else:
                lights.take_own(field)
                return

    async def _opened(self, served: ServedTile, archive_ids: Sequence[str]) -> RadianceField:
        """Return the last of ``archive_ids``, fetching those that are not in the store."""
        config = self._config
        folder, render = config.fields.expanduser(), config.render
        store = FieldStore(folder)
        for field_id in archive_ids:
            if field_id not in await asyncio.to_thread(store.ids):
                server = self._servers[served.server]
                channel = await server.require(config.limits.give_up_s or None)
                try:
                    await fetch_field(channel, store, field_id, folder, server.metadata)
                    size_bytes = (await asyncio.to_thread(store.path, field_id)).stat().st_size
                    self._observer.field_fetched(size_bytes)
                except UnknownField:
                    server.fields_changed.set()  # it publishes another one by now
                    raise
        return await asyncio.to_thread(
            store.load,
            archive_ids[-1],
            threads=render.threads,
            isa=render.field_isa,
            max_bytes=render.max_field_bytes,
        )

    def _fetch_lights(self, served: ServedTile, lights: TileLights) -> None:
        """Begin to fetch the tile's other lights, unless that is going on."""
        running = self._fetching.get(served.tile)
        if running is None or running.done():
            self._fetching[served.tile] = asyncio.create_task(self._add_lights(served, lights))

    async def _add_lights(self, served: ServedTile, lights: TileLights) -> None:
        """Fetch and open what is missing, one after the other; the drive goes on without it."""
        for light in served.tile.other_lights:
            if light.field_id in lights.held_ids():
                continue
            try:
                field = await self._opened(served, light.field_ids)
                _check_origin(field, lights.own)
                await asyncio.to_thread(field.prepare)
            except RfedgeError as error:
                log.warning("light not fetched", light=light.name, problem=str(error))
                continue
            lights.add(field)
            log.info("light ready", light=light.name, field=light.field_id)

    def _prepare(
        self, field: RadianceField, lights: TileLights, field_ids: tuple[str, ...]
    ) -> PreparedField:
        config = self._config
        pictures = self._live or self._recorded(field.metadata.tile_origin)
        cameras = tuple(_prepared_camera(config, camera) for camera in pictures.cameras)
        ladder = self._ladder(field)
        rungs = self._rungs(ladder)
        _prepare_renderers(field, ladder)
        self._observer.field_ready(field, len(pictures))
        return PreparedField(field, pictures, cameras, rungs, lights, field_ids)

    def _recorded(self, origin: TileOrigin) -> VehiclePictures:
        config = self._config
        if config.rig is None:
            pictures = RecordedPictures(read_drive(config, origin))
            return OneCamera(config.camera, pictures, config.steering)
        rig = read_rig(config.rig)
        return RecordedRig(rig, read_rig_drive(rig, origin), self._instants)

    def _ladder(self, field: RadianceField) -> tuple[MeasuredRung, ...]:
        """Return the rungs that a deadline chooses from; none without one."""
        config = self._config
        if config.deadline_ms is None:
            return ()
        kind, coder = field.metadata.kind, config.coding.coder
        return read_ladder(config.ladder, kind, config.crf, coder, tracking=config.localise)

    def _rungs(self, ladder: tuple[MeasuredRung, ...]) -> Rungs:
        """Return how frames are coded."""
        config = self._config
        if config.deadline_ms is None:
            return FixedRung(Rung(effort=config.coding.name))
        controller = DeadlineController(ladder, config.deadline_ms)
        log.info(
            "deadline",
            deadline_ms=config.deadline_ms,
            rungs=len(ladder),
            rung=controller.current.rung.name,
        )
        return DeadlineRungs(controller, self._observer.coded_under_deadline)


def _without_ground(tile: Tile) -> Tile:
    """Return what of a tile says which fields there are: tiles of the same ones share them."""
    return replace(tile, name="any", area=None, margin_m=0.0, version=1)


def _check_origin(light: RadianceField, own: RadianceField) -> None:
    """Raise ``FieldFormatError`` for a light in other coordinates: poses are sent in the tile's."""
    if light.metadata.tile_origin != own.metadata.tile_origin:
        raise FieldFormatError(
            f"light {light.field_id} has its origin at {light.metadata.tile_origin}, its tile at "
            f"{own.metadata.tile_origin}"
        )


def _prepared_camera(config: AgentConfig, camera: VehicleCamera) -> PreparedCamera:
    k = camera.intrinsics
    codec = CodecConfig(k.width_px, k.height_px, config.coding.name, config.crf)
    settings = replace(camera.steering, mask_qp=config.steering.mask_qp)
    return PreparedCamera(camera, codec, settings.steering(codec.size_px))


def read_drive(config: AgentConfig, origin: TileOrigin) -> tuple[PosedPicture, ...]:
    """Return the drive's pictures posed relative to ``origin``.

    Poses are rounded as on the wire before anything is rendered at them, so that both ends render
    at the same one. Raises ``InvalidInput`` unless all pictures are of one camera.
    """
    if config.drive is None:
        raise InvalidInput("drive", "is missing")
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


def _prepare_renderers(field: RadianceField, ladder: Sequence[MeasuredRung]) -> None:
    """Make every renderer that frames may ask for."""
    field.prepare()
    for quality in {measured.rung.quality for measured in ladder}:
        field.prepare(quality)


def _with_rounded_pose(picture: PosedPicture) -> PosedPicture:
    camera = picture.camera
    rounded = camera.rounded()
    return replace(picture, camera=rounded)


async def fetch_field(
    channel: grpc.aio.Channel, store: Store, field_id: str, folder: Path, metadata: Metadata = ()
) -> None:
    """Put field ``field_id`` of the server into ``store``; what arrived before is not sent again.

    The partial file lies in ``folder``; ``metadata`` goes with each call. Raises ``UnknownField``
    when the server lacks the field, ``FieldFormatError`` when what arrives is not the field,
    ``RfedgeError`` when it does not come.
    """
    stub = FieldServiceStub(channel)
    partial = folder / f".{field_id}.part"
    size_bytes = await _size(stub, field_id, metadata)
    log.info("fetching field", field=field_id, size_bytes=size_bytes)
    await _receive_all(stub, field_id, partial, size_bytes, metadata)
    await asyncio.to_thread(_check_and_add, store, field_id, partial)
    log.info("field fetched", field=field_id)


async def _size(stub: FieldServiceAsyncStub, field_id: str, metadata: Metadata) -> int:
    request = pb.GetManifestRequest(field_id=field_id)
    try:
        manifest = await stub.GetManifest(request, metadata=metadata, wait_for_ready=True)
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
    stub: FieldServiceAsyncStub,
    field_id: str,
    partial: Path,
    size_bytes: int,
    metadata: Metadata,
) -> None:
    """Receive what is missing; resume where it broke, and come again to a server that is busy."""
    resumes = refusals = 0
    while True:
        try:
            await _receive(stub, field_id, partial, size_bytes, metadata)
            return
        except grpc.aio.AioRpcError as error:
            is_refused = error.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
            resumes, refusals = resumes + (not is_refused), refusals + is_refused
            final = not is_refused and error.code() not in RETRIED
            if final or resumes > MAX_RESUMES or refusals > MAX_REFUSALS:
                problem = f"{error.code().name}: {error.details()}"
                raise RfedgeError(f"field {field_id} does not arrive ({problem})") from error
            log.warning("field transfer interrupted", problem=error.details())
            await asyncio.sleep(retry_after_s(error))


async def _receive(
    stub: FieldServiceAsyncStub,
    field_id: str,
    partial: Path,
    size_bytes: int,
    metadata: Metadata,
) -> None:
    have_bytes = partial.stat().st_size if partial.exists() else 0
    if have_bytes >= size_bytes:
        return
    request = pb.FetchFieldRequest(field_id=field_id, offset_bytes=have_bytes)
    with partial.open("ab") as file:
        async for response in stub.FetchField(request, metadata=metadata, wait_for_ready=True):
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
