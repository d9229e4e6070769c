"""The vehicle's radiance fields: fetched from a server, opened, made ready, and kept.

A frame can be coded once the field of its tile is prepared. A field that is not in the local store
is fetched from the server that publishes the tile (``cav_agent.field_fetch``). Frames are coded
against its lowest level of detail as soon as that has arrived, then against higher ones. Where the
server publishes a preview of the tile, that is fetched first and drawn instead while the tile's own
field arrives.
"""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import Coroutine, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import structlog

from cav_agent.cameras import (
    RecordedCameras,
    VehicleCamera,
    VehicleCameras,
    instant_numbers,
    recorded_cameras,
)
from cav_agent.config import AgentConfig
from cav_agent.deadline import DeadlineController, DeadlineRungs, FixedRung, Rungs
from cav_agent.field_fetch import Beginnings, FetchPace, fetch_field
from cav_agent.frame_log import DriveObserver
from cav_agent.handover import ServedTile
from cav_agent.lights import TileLights
from cav_agent.server_connection import ServerConnection
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.h264.qp_map import QpMap
from rfcore.codec.sender.ladder import MeasuredRung, Rung, read_ladder
from rfcore.errors import FieldFormatError, RfedgeError, UnknownField
from rfcore.field import FULL, FieldStore, RadianceField
from rfcore.field.own import OwnField
from rfcore.field.place import check_place, coarseness
from rfcore.field.store import decode_beginning
from rfcore.wire.tiles import Tile

log = structlog.get_logger()

SHIPPED_LADDER = Path(__file__).with_name("ladder.json")
"""Rungs measured on the sample street with the field that ships (`rfedge eval ladder`)."""

OWN_AGAIN_S = 10.0
"""Pause after a failure to fetch a tile's own field, while something else is drawn."""

MAX_PREPARED = 3
"""Fields kept ready: the previous tile's, the present one's and the next one's."""


@dataclass(frozen=True)
class PreparedCamera:
    """The coding of one camera's pictures."""

    camera: VehicleCamera
    codec: CodecConfig
    qp_map: QpMap | None


@dataclass(frozen=True)
class PreparedField:
    """A field that is ready to code against, and the drive as seen in its tile."""

    field: RadianceField
    pictures: VehicleCameras
    """Posed relative to the field's tile origin, or not posed: a live camera's."""
    cameras: tuple[PreparedCamera, ...]
    rungs: Rungs
    lights: TileLights
    field_ids: tuple[str, ...]
    """Those that frames may be coded against, the field's own first."""


class FieldCache:
    """Prepares fields by tile and keeps the last ``MAX_PREPARED``; tiles of one field share it.

    A field that is not in the local store is fetched from ``servers[i]``, which publishes the tile.
    ``own`` stands for every field.
    """

    def __init__(
        self,
        config: AgentConfig,
        servers: Sequence[ServerConnection],
        observer: DriveObserver,
        live: VehicleCameras | None = None,
        own: OwnField | None = None,
    ) -> None:
        self._config = config
        self._live = live
        self._own = own
        self._instants = instant_numbers(config)
        self._servers = tuple(servers)
        self._observer = observer
        self._prepared: OrderedDict[Tile, asyncio.Task[PreparedField]] = OrderedDict()
        self._fetching: dict[Tile, asyncio.Task[None]] = {}
        self._background: set[asyncio.Task[None]] = set()
        self.pace = FetchPace(
            config.fetch_share, lambda: any(map(_succeeded, self._prepared.values()))
        )

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
        tasks += self._background
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _load(self, served: ServedTile) -> PreparedField:
        tile, loop = served.tile, asyncio.get_running_loop()
        own = ArrivingField()
        preview: tuple[str, ...] = ()
        if self._own or self._finds_poses or await self._holds(tile.field_id):
            field = await self._opened(served, (tile.field_id,))
            own.whole.set_result(field)
        elif tile.preview is not None:
            preview = tile.preview.field_ids
            field = await self._opened(served, preview)
            own.take(field)
        else:
            field = await self._first(served, own)

        def want() -> None:
            loop.call_soon_threadsafe(self._fetch_lights, served, lights)

        lights = TileLights(field, want if tile.other_lights else lambda: None, tile.field_id)
        prepared = await asyncio.to_thread(self._prepare, field, lights, tile.renderable_ids)
        own.shown_by(lights)
        if preview:
            self._begin(self._arrive(served, own))
        pictures = prepared.pictures
        if isinstance(pictures, RecordedCameras) and not self._finds_poses:
            self._begin(self._check_place(served, own, pictures))
        return prepared

    async def _check_place(
        self, served: ServedTile, own: ArrivingField, drive: RecordedCameras
    ) -> None:
        """Warn, once the tile's own field is there, if the pictures on its ground show another
        place."""
        field, config, tile = await own.whole, self._config, served.tile
        name = self._own.name if self._own else str(config.fields / f"{tile.field_id}.rff")
        origin = field.metadata.tile_origin
        seen = [
            picture
            for picture in drive.pictures
            if not tile.distance_m(
                *origin.globalise(picture.camera.world_from_cam).translation_m[:2]
            )
        ]
        problem: str | None = None
        try:
            names = (name, str(config.drive or config.rig))
            if seen:
                problem = await asyncio.to_thread(check_place, field, seen, names)
        except RfedgeError as error:
            problem = str(error)
        if problem is not None:
            log.warning("field of another place", tile=tile.name, problem=problem)

    async def _first(self, served: ServedTile, own: ArrivingField) -> RadianceField:
        """Begin to fetch the tile's own field; return what can be drawn of it first."""
        arriving = self._begin(self._arrive(served, own))
        either: set[asyncio.Future[Any]] = {arriving, own.first}
        await asyncio.wait(either, return_when=asyncio.FIRST_COMPLETED)
        if own.field is None:
            await arriving  # raises what went wrong
        return await own.first

    async def _holds(self, field_id: str) -> bool:
        store = FieldStore(self._config.fields.expanduser())
        return field_id in await asyncio.to_thread(store.ids)

    def _begin(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        task = asyncio.create_task(work)
        self._background.add(task)
        task.add_done_callback(self._background.discard)
        return task

    @property
    def _finds_poses(self) -> bool:
        """Return whether poses are found on the way, and are not those of the drive.

        The whole of the tile's own field is needed for it: a camera is searched in it on another
        thread (``--localise``), and a feed's positions are checked against its bounds.
        """
        return self._config.localise or self._config.feed.source is not None

    async def _arrive(self, served: ServedTile, own: ArrivingField) -> None:
        """Fetch the tile's own field and have it drawn; try again until all of it is there.

        Raises ``RfedgeError`` if it cannot be fetched and nothing can be drawn instead.
        """
        while True:
            try:
                await self._take_own(served, own)
                return
            except RfedgeError as error:
                if own.field is None:
                    raise
                log.warning("own field not fetched", tile=served.tile.name, problem=str(error))
                await asyncio.sleep(OWN_AGAIN_S)

    async def _take_own(self, served: ServedTile, own: ArrivingField) -> None:
        async def take(field: RadianceField) -> None:
            if own.field is not None:
                _check_origin(field, own.field)
            await asyncio.to_thread(_prepare_renderers, field, self._ladder(field))
            own.take(field)

        async def begin(data: bytes) -> None:
            field = await asyncio.to_thread(self._beginning, data, served.tile.field_id)
            await take(field)
            log.info("beginning of the field ready", detail=field.most_detail, bytes=len(data))

        beginnings = None if served.tile.preview else Beginnings(begin)
        field = await self._opened(served, (served.tile.field_id,), beginnings)
        await take(field)
        own.whole.set_result(field)

    def _beginning(self, data: bytes, field_id: str) -> RadianceField:
        render = self._config.render
        return decode_beginning(
            data,
            field_id,
            threads=render.threads,
            isa=render.field_isa,
            max_bytes=render.max_field_bytes,
        )

    async def _opened(
        self,
        served: ServedTile,
        archive_ids: Sequence[str],
        beginnings: Beginnings | None = None,
    ) -> RadianceField:
        """Return the last of ``archive_ids``, fetching those that are not in the store; a user's
        class is all there is."""
        if self._own is not None:
            return self._own
        config = self._config
        folder, render = config.fields.expanduser(), config.render
        store = FieldStore(folder)
        for field_id in archive_ids:
            if field_id not in await asyncio.to_thread(store.ids):
                server = self._servers[served.server]
                channel = await server.require(config.limits.give_up_s or None)
                try:
                    await fetch_field(
                        channel, store, field_id, folder, server.metadata, beginnings, self.pace
                    )
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
        """Fetch and open what is missing, one after the other; the drive does not wait for it."""
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
        origin = field.metadata.tile_origin
        pictures = self._live or recorded_cameras(config, origin, self._instants)
        cameras = tuple(_prepared_camera(config, camera) for camera in pictures.cameras)
        problem = coarseness(field, [camera.intrinsics for camera in pictures.cameras])
        if problem is not None:
            log.warning("field coarser than the camera", problem=problem)
        ladder = self._ladder(field)
        rungs = self._rungs(ladder)
        _prepare_renderers(field, ladder)
        self._observer.field_ready(field, len(pictures))
        return PreparedField(field, pictures, cameras, rungs, lights, field_ids)

    def _ladder(self, field: RadianceField) -> tuple[MeasuredRung, ...]:
        """Return the rungs that a deadline chooses from; none without one."""
        config = self._config
        if config.deadline_ms is None:
            return ()
        kind, coder = field.metadata.kind, config.coding.coder
        ladder = config.ladder or SHIPPED_LADDER
        return read_ladder(ladder, kind, config.crf, coder, tracking=config.localise)

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


class ArrivingField:
    """The tile's own field as far as it has arrived, or its preview; used on the event loop."""

    def __init__(self) -> None:
        loop = asyncio.get_running_loop()
        self.first: asyncio.Future[RadianceField] = loop.create_future()
        self.whole: asyncio.Future[RadianceField] = loop.create_future()
        self.field: RadianceField | None = None
        self._lights: TileLights | None = None

    def take(self, field: RadianceField) -> None:
        """Draw ``field`` from now on."""
        self.field = field
        if not self.first.done():
            self.first.set_result(field)
        if self._lights is not None:
            self._lights.take_own(field)

    def shown_by(self, lights: TileLights) -> None:
        """Pass what arrives from now on to ``lights``, which have the first one."""
        self._lights = lights
        if self.field is not None and self.field is not lights.own:
            lights.take_own(self.field)


def _succeeded(task: asyncio.Task[PreparedField]) -> bool:
    return task.done() and not task.cancelled() and task.exception() is None


def _without_ground(tile: Tile) -> Tile:
    """Return the parts of a tile that name its fields: tiles with equal ones share them."""
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
    settings = replace(camera.masking, mask_qp=config.masking.mask_qp)
    return PreparedCamera(camera, codec, settings.qp_map(codec.size_px))


def _prepare_renderers(field: RadianceField, ladder: Sequence[MeasuredRung]) -> None:
    """Make every renderer that frames may need."""
    for quality in {FULL, *(measured.rung.quality for measured in ladder)}:
        field.prepare(replace(quality, detail=min(quality.detail, field.most_detail)))
