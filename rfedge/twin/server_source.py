"""Fields, pictures, objects and views of one server, for the page.

Survives restarts of the server: what was shown stays, and the page says that it waits. Objects and
views take the server's time, so they are asked for only while a browser shows them.
"""

from __future__ import annotations

import asyncio
import time
import zlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import structlog
from numpy.typing import NDArray

from cav_agent.field_fetch import fetch_field
from rfcore.errors import AccessDenied, InvalidInput, RfedgeError
from rfcore.field import FieldStore
from rfcore.perception.objects import CameraKey
from rfcore.wire.address import ASK_AFTER_S
from rfcore.wire.conventions import RECONNECT_S, retry_after_s
from rfcore.wire.tiles import LearntLight, Tile, TileLight, learnt_of, tile_of
from rfcore.wire.twin import Departure, TwinPicture
from rfcore.wire.twin_client import AsyncTwinClient
from rfcore.wire.twin_render import (
    NO_AGE,
    ObjectsRequest,
    RenderedView,
    ViewRequest,
    rendered_view_from_wire,
    view_request_to_wire,
)
from rfcore.wire.v1 import field_pb2, twin_pb2, twin_pb2_grpc
from rfcore.wire.v1.field_pb2_grpc import FieldServiceStub
from rfedge.twin.scene import Message, PlacedField, TwinScene

log = structlog.get_logger()

RETRY_S = 0.5
FIELDS_EVERY_S = 5.0
OBJECTS_AGAIN_S = 0.5
"""Period of checks for fields to show objects of."""
VIEW_EVERY_S = 0.25
"""Least time between two views of a browser. The next is asked for after a pause as long as the
last took, so that views take half of the time that a server grants, also where it is slow."""
SILENT_S = 5.0
"""Time without an answer after which the user is told what a view waits for."""
FRESHNESS_STEP_MS = 10
FIELD_ALONE = 255
"""Freshness of pixels that no live picture vouches for; that of others is their age in steps of the
above, at most 254."""


class ServerSource:
    """Shows in ``scene`` what the server of ``client`` shows.

    Fields that are fetched are kept in ``folder``; ``threads`` render each of them.
    """

    def __init__(
        self,
        client: AsyncTwinClient,
        folder: Path,
        scene: TwinScene,
        threads: int = 1,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._client = client
        self._folder = folder
        self._scene = scene
        self._threads = threads
        self._clock = clock
        self._store = FieldStore(folder)
        self._cameras: set[CameraKey] = set()
        self._showing_objects = 0
        self._is_connected = asyncio.Event()

    @property
    def live(self) -> ServerSource:
        """A server shows objects, and the street from anywhere."""
        return self

    async def run(self) -> None:
        """Show until cancelled; raises ``AccessDenied`` where the server does not let us."""
        async with self._client:
            fields = asyncio.create_task(self._follow_fields())
            objects = asyncio.create_task(self._follow_objects())
            try:
                while True:
                    problem = await self._watch_explained()
                    self._show_state("waiting", problem)
                    await asyncio.sleep(RETRY_S)
            finally:
                fields.cancel()
                objects.cancel()

    def open_view(self, send: Callable[[Message], object]) -> LiveView:
        """Return a view for one browser; ``send`` takes its messages."""
        return LiveView(self._client, send, self._clock)

    def want_objects(self, wanted: bool) -> None:
        """Count one browser more, or less, that shows objects."""
        self._showing_objects += 1 if wanted else -1

    async def _follow_objects(self) -> None:
        """Show the objects on every field's ground, while a browser shows them."""
        following: dict[str, asyncio.Task[None]] = {}
        try:
            while True:
                wanted = set(self._scene.field_ids) if self._showing_objects else set()
                ended = {field_id for field_id, task in following.items() if task.done()}
                for field_id in (following.keys() - wanted) | ended:
                    following.pop(field_id).cancel()
                for field_id in following.keys() ^ wanted:
                    following[field_id] = asyncio.create_task(self._watch_objects(field_id))
                await asyncio.sleep(OBJECTS_AGAIN_S)
        finally:
            for task in following.values():
                task.cancel()

    async def _watch_objects(self, field_id: str) -> None:
        """Show the objects on one field's ground until the stream ends, then the reason."""
        problem = "the server ended the stream"
        try:
            try:
                async for seen in self._client.objects(ObjectsRequest(field_id=field_id)):
                    self._scene.show_objects(field_id, seen.objects, self._clock())
            except RfedgeError as error:
                problem = str(error)
            self._scene.show_objects(field_id, (), self._clock(), problem)
            await asyncio.sleep(FIELDS_EVERY_S)
        finally:
            self._scene.hide_objects(field_id, self._clock())

    def _show_state(self, state: str, detail: str) -> None:
        self._scene.connection(state, detail, self._clock())

    def _connected(self, may_see: str) -> None:
        self._is_connected.set()
        address = str(self._client.address)
        log.info("connected", server=address, may_see=may_see or "everything")
        limits = f"; this certificate may see: {may_see}" if may_see else ""
        self._show_state("connected", address + limits)

    async def _watch_explained(self) -> str:
        """As ``_watch``; until there is a connection, say why; raise ``AccessDenied``."""
        self._is_connected.clear()
        watching = asyncio.create_task(self._watch())
        explaining = asyncio.create_task(self._explain())
        try:
            await asyncio.wait({watching, explaining}, return_when=asyncio.FIRST_COMPLETED)
            if explaining.done():
                explaining.result()
            return await watching
        finally:
            watching.cancel()
            explaining.cancel()
            await asyncio.gather(watching, explaining, return_exceptions=True)

    async def _explain(self) -> None:
        before = ""
        while not self._is_connected.is_set():
            with suppress(TimeoutError):
                async with asyncio.timeout(ASK_AFTER_S):
                    await self._is_connected.wait()
                    return
            problem = await asyncio.to_thread(self._client.connection_problem)
            if problem and problem != before:
                log.warning("no connection", problem=problem, again_in_s=RECONNECT_S)
                self._show_state("waiting", problem)
            before = problem

    async def _watch(self) -> str:
        """Show pictures until the stream ends; return the reason."""
        address = str(self._client.address)
        self._show_state("waiting", f"connecting to {address}")
        messages = self._client.watch(connected=self._connected)
        try:
            async for message in messages:
                self._take(message)
        except AccessDenied:
            raise
        except RfedgeError as error:
            log.warning("the twin ended", problem=str(error))
            return str(error)
        finally:
            self._depart_all()
        return "the server ended the stream"

    def _take(self, message: TwinPicture | Departure) -> None:
        if isinstance(message, Departure):
            self._cameras.discard(message.key)
            self._scene.leave(message.key, self._clock())
            return
        self._cameras.add(message.key)
        self._scene.show(message, self._clock())

    def _depart_all(self) -> None:
        for key in self._cameras:
            self._scene.leave(key, self._clock())
        self._cameras.clear()

    async def _follow_fields(self) -> None:
        """Fetch each field that the server publishes, and those that replace them; take away those
        that it publishes no more."""
        stub = FieldServiceStub(self._client.channel)
        while True:
            try:
                request = field_pb2.ListFieldsRequest()
                listed = await stub.ListFields(request, wait_for_ready=True)
                self._show_tiles(listed)
                tiles = {tile.name: tile.field_id for tile in listed.tiles}
                shown = tiles or {i[:8]: i for i in listed.field_ids}
                for tile, field_id in shown.items():
                    await self._bring(tile, field_id)
                self._scene.keep(shown, self._clock())
            except grpc.aio.AioRpcError as error:
                log.info("fields cannot be listed", problem=error.details())
            await asyncio.sleep(FIELDS_EVERY_S)

    def _show_tiles(self, listed: field_pb2.ListFieldsResponse) -> None:
        """Show which lights the tiles have, and what was learnt of them."""
        try:
            tiles, learnt = map(tile_of, listed.tiles), map(learnt_of, listed.learnt)
            rows = tile_rows(tuple(tiles), tuple(learnt))
        except InvalidInput as error:
            log.warning("tiles cannot be shown", problem=str(error))
            return
        self._scene.show_tiles(rows, self._clock())

    async def _bring(self, tile: str, field_id: str) -> None:
        if self._scene.field(field_id) is not None:
            return
        self._scene.note(tile, "being fetched", self._clock())
        try:
            if field_id not in await asyncio.to_thread(self._store.ids):
                await fetch_field(self._client.channel, self._store, field_id, self._folder)
            placed = await asyncio.to_thread(self._placed, tile, field_id)
        except (RfedgeError, OSError) as error:
            log.warning("field cannot be shown", field=field_id, problem=str(error))
            self._scene.note(tile, str(error), self._clock())
            return
        self._scene.place(placed, self._clock())

    def _placed(self, tile: str, field_id: str) -> PlacedField:
        return PlacedField.of(self._store.load(field_id, threads=self._threads), tile)


class LiveView:
    """The view of one browser through a camera that its user moves: ``RenderStream``, asked again
    and again while it is open, at most once in ``VIEW_EVERY_S``.

    A refusal is shown and ends the stream. Another is opened when the server said that it may be,
    or with the next viewpoint. Used on the event loop.
    """

    def __init__(
        self,
        client: AsyncTwinClient,
        send: Callable[[Message], object],
        clock: Callable[[], float],
    ) -> None:
        self._client = client
        self._send = send
        self._clock = clock
        self._wanted: ViewRequest | None = None
        self._following: asyncio.Task[None] | None = None

    def look(self, request: ViewRequest | None) -> None:
        """Show this viewpoint from now on; None: nothing."""
        self._wanted = request
        if request is None:
            self.close()
        elif self._following is None or self._following.done():
            self._following = asyncio.create_task(self._follow())

    def close(self) -> None:
        """Ask for nothing any more."""
        if self._following is not None:
            self._following.cancel()
            self._following = None

    async def _follow(self) -> None:
        try:
            while (pause_s := await self._serve()) is not None:
                await asyncio.sleep(pause_s)
        except RfedgeError as error:
            self._refused(str(error))

    async def _serve(self) -> float | None:
        """Show views until the stream ends; return when to open another, None for never."""
        call = twin_pb2_grpc.TwinServiceStub(self._client.channel).RenderStream()
        try:
            with suppress(grpc.aio.AioRpcError, asyncio.InvalidStateError):
                await self._ask(call)
            if self._wanted is None:
                return None
            after_s = retry_after_s(await call.trailing_metadata())
            problem = await call.details() or "the server ended the stream"
            self._refused(
                f"the server draws no more for you at the moment; asked again in {after_s:.1f} s "
                f"({problem})"
                if after_s
                else problem
            )
            return after_s or None
        finally:
            call.cancel()

    async def _ask(self, call: Any) -> None:
        while (request := self._wanted) is not None:
            asked_s = self._clock()
            await call.write(twin_pb2.RenderStreamRequest(view=view_request_to_wire(request)))
            response = await self._answer(call)
            if response is grpc.aio.EOF:
                return
            took_s = self._clock() - asked_s
            intrinsics = request.camera.intrinsics
            view = rendered_view_from_wire(response.view, intrinsics)
            self._send(await asyncio.to_thread(view_message, view, self._clock()))
            await asyncio.sleep(max(took_s, VIEW_EVERY_S - took_s))

    async def _answer(self, call: Any) -> Any:
        """Return the next answer; say so while there is none for long."""
        reading = asyncio.ensure_future(call.read())
        try:
            while not (await asyncio.wait({reading}, timeout=SILENT_S))[0]:
                self._refused(
                    f"no view within {SILENT_S:g} s: the server draws views while a processor of "
                    "its machine is idle, and none is; still waiting"
                )
            return reading.result()
        finally:
            reading.cancel()

    def _refused(self, problem: str) -> None:
        self._send(Message({"kind": "view_refused", "problem": problem}, self._clock()))


def tile_rows(tiles: Sequence[Tile], learnt: Sequence[LearntLight]) -> list[dict[str, Any]]:
    """Return one row of the page's table for each light of each tile, the tile's own first.

    ``passes`` 0: not stated. ``learnt_ms``: when the server learnt by itself what is current, or
    what it has withdrawn since, of the Unix epoch, and ``saved_ratio`` the share of bits that this
    saves; null for what was published by hand.
    """
    newest = {(one.tile, one.light): one for one in learnt}
    return [
        _tile_row(tile, light, newest.get((tile.name, light.name if light else "")))
        for tile in tiles
        for light in (None, *tile.lights)
    ]


def _tile_row(tile: Tile, light: TileLight | None, learnt: LearntLight | None) -> dict[str, Any]:
    current = light or tile
    row = {
        "tile": tile.name,
        "light": light.name if light else "",
        "version": current.version,
        "time_of_day_h": light.time_of_day_h if light else None,
        "passes": light.passes if light else 0,
        "learnt_ms": None,
        "saved_ratio": None,
        "withdrawn": False,
    }
    if learnt is None:
        return row
    if learnt.withdrawn:
        return {**row, "learnt_ms": learnt.time_ms, "saved_ratio": 0.0, "withdrawn": True}
    if learnt.field_id != current.field_id:
        return row
    passes, saved_ratio = learnt.passes, learnt.saved_ratio
    return {**row, "passes": passes, "learnt_ms": learnt.time_ms, "saved_ratio": saved_ratio}


def view_message(view: RenderedView, now_s: float) -> Message:
    """Return a view for the page; its parts: the picture as JPEG, and how old each pixel is, one
    byte each (``FRESHNESS_STEP_MS``, ``FIELD_ALONE``), deflated (RFC 1950)."""
    header = {
        "kind": "view",
        "width_px": view.age_ms.shape[1],
        "height_px": view.age_ms.shape[0],
        "field": view.field_id,
        "step_ms": FRESHNESS_STEP_MS,
        "field_alone": FIELD_ALONE,
        "live_share": float(view.live.mean()),
        "cameras": [
            {
                "vehicle": camera.vehicle_id,
                "camera": camera.camera_id,
                "age_ms": 1e3 * camera.age_s,
                "share": camera.share,
                "outvoted": camera.outvoted,
            }
            for camera in view.cameras
        ],
    }
    return Message(header, now_s, (view.picture, zlib.compress(_freshness(view.age_ms), 1)))


def _freshness(age_ms: NDArray[np.uint16]) -> bytes:
    steps = np.minimum(age_ms // FRESHNESS_STEP_MS, FIELD_ALONE - 1)
    return np.where(age_ms == NO_AGE, FIELD_ALONE, steps).astype(np.uint8).tobytes()
