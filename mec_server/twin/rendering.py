"""Views of the twin for consumers, and the objects in its pictures.

Views are composed on one thread that works while a processor is idle. Objects are found, for
notices and for consumers, on another thread that gives way to decoding alone: warnings do not wait
for views. Each thread has fields of its own, so that neither the event loop nor the workers that
decode, nor the renderers these share, wait for it. Identities take turns and pay with worker time,
as vehicles do.

A picture is compared with a field once, by whichever thread needs it first. The field's view at
its pose is the decoder's own render, if that is kept and of the same field and size.
"""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import astuple, dataclass, replace
from functools import partial
from threading import Lock
from typing import TypeVar

import numpy as np

from mec_server.event_loop import Workers, give_way
from mec_server.ledger.budgets import Resource
from mec_server.ledger.ledger import Ledger
from mec_server.twin.state import Covers, ReceivedPicture, Twin
from rfcore.camera import Camera, TileOrigin
from rfcore.errors import AccessDenied, InvalidInput, LimitExceeded, named
from rfcore.field import RadianceField
from rfcore.field.quality import FULL
from rfcore.image import Rgb
from rfcore.perception.composition import (
    ComposedView,
    LivePicture,
    compose,
    live_picture,
    nearest,
    shrunk,
)
from rfcore.perception.contacts import Detection, cut_out
from rfcore.perception.ground import FieldGround
from rfcore.perception.objects import CameraKey, RulesOut, rules_nothing_out
from rfcore.views import View
from rfcore.wire.tiles import Tile
from rfcore.wire.twin import encoded_picture
from rfcore.wire.twin_render import (
    NO_AGE,
    LiveCamera,
    ObjectsRequest,
    RenderedView,
    ViewRequest,
)
from rfcore.wire.values import check_label, shown

R = TypeVar("R")
OpenField = Callable[[str], RadianceField]

Classify = Callable[[Rgb], str]
"""A detector: returns the name of the object in a cut-out of a picture, uint8 [H, W, 3]: at most 64
letters, digits, '.', '_' or '-', or nothing."""

VIEWS_NICE = 19
"""Niceness of the thread that draws views. Not SCHED_IDLE: on a busy machine its thread would be
stopped for seconds while it holds the interpreter's lock, and the whole server with it.
"""
FINDING_NICE = 5
"""Niceness of the thread that finds objects, which are worth nothing when they are late: at 10 it
found none for seconds where others kept the processors busy."""
MOST_KEPT = 16
"""Pictures whose comparison with a field is kept for the next view."""

MOST_AHEAD = 2
"""Tasks that may wait in preparation of pictures which are not there yet."""
MOST_GROUNDS = 2
"""Fields whose ground is kept, and which are open for it."""

BEYOND_BOUNDS_M = 5.0
"""Greatest distance of a viewpoint from the box of its field."""
INSIDE_M, INSIDE_SHARE = 0.3, 0.9
"""A viewpoint is inside of something if this share of its view is nearer than this distance."""


@dataclass(frozen=True)
class ViewedTile:
    """A field to draw, and all fields that pictures of the same ground may be coded against.

    ``world``: the origin of poses and objects; None for the origin of the field.
    """

    field_id: str
    field_ids: frozenset[str]
    world: TileOrigin | None = None


def viewed_tile(request: ViewRequest | ObjectsRequest, tiles: Sequence[Tile]) -> ViewedTile:
    """Return the tile that ``request`` names.

    Raises ``InvalidInput`` for a tile that is not published, and for a place on no tile.
    """
    if request.place is not None:
        tile = _tile_at(request.place, tiles)
        return ViewedTile(tile.field_id, tile.archive_ids, request.place)
    for tile in tiles:
        if request.tile == tile.name or request.field_id in tile.archive_ids:
            return ViewedTile(request.field_id or tile.field_id, tile.archive_ids)
    if request.field_id:
        return ViewedTile(request.field_id, frozenset((request.field_id,)))
    here = named((tile.name for tile in tiles), "none; name a field_id")
    raise InvalidInput("tile", f"{shown(request.tile)} is not published here; published: {here}")


def _tile_at(place: TileOrigin, tiles: Sequence[Tile]) -> Tile:
    """Return the tile whose area a place is in, or else the nearest whose margin reaches it."""
    at = (place.east_m, place.north_m)
    reaching = [tile for tile in tiles if tile.reaches(*at)]
    if not reaching:
        here = named(map(_area_of, tiles), "none; name a field_id")
        raise InvalidInput(
            "place",
            f"east {at[0]:.10g} m, north {at[1]:.10g} m is on no tile published here: {here}",
        )
    return min(reaching, key=lambda tile: (tile.distance_m(*at), tile.area is None))


def _area_of(tile: Tile) -> str:
    if tile.area is None:
        return f"{tile.name} (everywhere)"
    (west, south), (east, north) = tile.area.low_m, tile.area.high_m
    return (
        f"{tile.name} (east {west:.10g} to {east:.10g} m, north {south:.10g} to {north:.10g} m, "
        f"and {tile.margin_m:g} m around)"
    )


@dataclass(frozen=True, eq=False)
class PictureObjects:
    """Objects seen in a picture that the field lacks, and a test for ones that it rules out.

    ``origin_m``: the field's origin, relative to ``ViewedTile.world``; ``labels``: a detector's
    name for each object, empty without a detector.
    """

    detections: list[Detection]
    rules_out: RulesOut = rules_nothing_out
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    labels: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class _AnalysedPicture:
    """A picture, its difference from a field, and the objects in it."""

    picture: ReceivedPicture
    live: LivePicture
    detections: list[Detection]


class _FieldThread:
    """One thread, and the fields that it alone renders; ``open_field`` opens them."""

    def __init__(self, worker: Workers, open_field: OpenField) -> None:
        self.worker = worker
        self.open_field = open_field
        self._grounds: OrderedDict[str, FieldGround] = OrderedDict()

    def ground(self, field: RadianceField) -> FieldGround:
        """Return the ground of ``field``, with the renders that it has cached."""
        ground = self._grounds.pop(field.field_id, None) or FieldGround(
            field.render, field.metadata.vertical
        )
        self._grounds[field.field_id] = ground
        if len(self._grounds) > MOST_GROUNDS:
            self._grounds.popitem(last=False)
        return ground


class _AnalysisCache:
    """Keeps the analyses of the newest pictures, for all threads."""

    def __init__(self) -> None:
        self._kept: OrderedDict[tuple[CameraKey, str], _AnalysedPicture] = OrderedDict()
        self._lock = Lock()

    def of(self, picture: ReceivedPicture, field_id: str) -> _AnalysedPicture | None:
        """Return the analysis of ``picture``, None if it is not kept."""
        with self._lock:
            kept = self._kept.get((picture.key, field_id))
            if kept is None or kept.picture is not picture:
                return None
            self._kept.move_to_end((picture.key, field_id))
        return kept

    def keep(self, analysed: _AnalysedPicture, field_id: str) -> None:
        """Keep an analysis, in place of that of its camera's picture before."""
        with self._lock:
            self._kept[analysed.picture.key, field_id] = analysed
            self._kept.move_to_end((analysed.picture.key, field_id))
            if len(self._kept) > MOST_KEPT:
                self._kept.popitem(last=False)


class ViewService:
    """Composes views of ``twin``, and finds the objects in its pictures.

    ``open_fields`` returns, for each thread, a function that opens fields for it alone; ``tiles``
    returns the published tiles. ``failed`` is called with an exception of a thread's callback.
    ``classify`` names the objects in pictures, on the thread that finds them.
    """

    def __init__(
        self,
        twin: Twin,
        open_fields: Callable[[], OpenField],
        tiles: Callable[[], tuple[Tile, ...]],
        ledger: Ledger,
        failed: Callable[[Exception], None],
        classify: Classify | None = None,
    ) -> None:
        self._twin = twin
        self._classify = classify
        self._tiles = tiles
        self._ledger = ledger
        views = Workers(1, failed, "views", begin=partial(give_way, VIEWS_NICE))
        objects = Workers(1, failed, "objects", begin=partial(give_way, FINDING_NICE))
        self._composing = _FieldThread(views, open_fields())
        self._finding = _FieldThread(objects, open_fields())
        self._analyses = _AnalysisCache()
        self._ahead: set[asyncio.Task[None]] = set()

    def close(self) -> None:
        """Stop the threads."""
        self._composing.worker.close()
        self._finding.worker.close()

    def spend_message(self, identity: str) -> None:
        """Charge a message of a stream; raise ``LimitExceeded``."""
        self._ledger.spend(identity, Resource.MESSAGES, 1, time.monotonic())

    async def view(
        self,
        request: ViewRequest,
        identity: str,
        covers: Covers,
        may_draw: Callable[[str], bool],
    ) -> RenderedView:
        """Return a view of the pictures that ``covers`` lets the consumer see.

        Raises ``LimitExceeded`` while ``identity`` has spent its worker time, ``AccessDenied`` for
        a field that it may not have (``may_draw``), ``UnknownField``, and ``InvalidInput`` for a
        viewpoint outside of the field or inside of a wall, or a moment of which the pictures are
        not there. A caller that is cancelled costs at most the view that has begun.
        """
        tile = self.tile(request, may_draw)
        now = time.monotonic()
        ago_s = _ago_s(request, time.time_ns(), self._twin.reach_s(now))
        if request.time_ns:
            known = self._twin.at(now - ago_s, request.max_age_s)
        else:
            known = self._twin.recent(now, request.max_age_s)
        pictures = [
            each
            for each in known
            if each.field_id in tile.field_ids and covers(each.vehicle_id, each.field_id)
        ]
        work = partial(self._composed, request, tile, pictures, now - ago_s)
        return await self._on_thread(self._composing, identity, work)

    async def objects_in(
        self, picture: ReceivedPicture, tile: ViewedTile, identity: str
    ) -> PictureObjects:
        """Return the objects in a picture that the field of ``tile`` lacks; none without a pose.

        Raises ``LimitExceeded`` while ``identity`` has spent its worker time.
        """
        if picture.frame.pose is None:
            return PictureObjects([])
        compute = partial(self._detected, picture, tile)
        return await self._on_thread(self._finding, identity, compute)

    def prepare(self, tile: ViewedTile, identity: str) -> None:
        """Open the field of ``tile`` and draw it once, so that the first objects are not late."""
        self._prepare_for(partial(self._warmed_up, tile), identity)

    def expect_picture(self, camera: Camera, tile: ViewedTile, identity: str) -> None:
        """Draw the ground that a picture of ``camera`` will be compared with, while it is decoded.

        Ground that was not drawn before takes as long as the decoding.
        """
        self._prepare_for(partial(self._ground_ahead, camera, tile), identity)

    def _prepare_for(self, draw: Callable[[], None], identity: str) -> None:
        """Draw, unless ``MOST_AHEAD`` tasks wait or ``identity`` has spent its worker time."""
        if len(self._ahead) < MOST_AHEAD:
            task = asyncio.create_task(self._prepared(draw, identity))
            self._ahead.add(task)
            task.add_done_callback(self._ahead.discard)

    async def _prepared(self, draw: Callable[[], None], identity: str) -> None:
        with suppress(LimitExceeded):
            await self._on_thread(self._finding, identity, draw)

    def tile(
        self, request: ViewRequest | ObjectsRequest, may_draw: Callable[[str], bool]
    ) -> ViewedTile:
        """Return the tile of a request; raise ``InvalidInput`` or ``AccessDenied``."""
        tile = viewed_tile(request, self._tiles())
        if not may_draw(tile.field_id):
            raise AccessDenied("this certificate may not see that tile; ask the operator")
        return tile

    async def _on_thread(self, thread: _FieldThread, identity: str, compute: Callable[[], R]) -> R:
        self._ledger.check(identity, Resource.WORKER_SECONDS, time.monotonic())
        answer: asyncio.Future[R] = asyncio.get_running_loop().create_future()
        work = partial(self._timed, compute, answer)
        thread.worker.submit(identity, work, partial(self._finish, identity, answer))
        return await answer

    def _finish(
        self,
        identity: str,
        answer: asyncio.Future[R],
        outcome: tuple[float, R | Exception] | Exception,
    ) -> None:
        if isinstance(outcome, Exception):
            raise outcome
        worked_s, result = outcome
        self._ledger.charge(identity, Resource.WORKER_SECONDS, worked_s, time.monotonic())
        if answer.done():
            return
        if isinstance(result, Exception):
            answer.set_exception(result)
        else:
            answer.set_result(result)

    # --- on the threads

    def _timed(
        self, compute: Callable[[], R], answer: asyncio.Future[R]
    ) -> tuple[float, R | Exception]:
        """Return the processor time that it took, and the result or the error.

        A thread that gives way to others waits for its processor: nobody pays for that.
        """
        if answer.cancelled():
            return 0.0, asyncio.InvalidStateError("nobody waits for this")
        started = time.thread_time()
        try:
            result: R | Exception = compute()
        except Exception as error:
            result = error
        return time.thread_time() - started, result

    def _composed(
        self,
        request: ViewRequest,
        tile: ViewedTile,
        pictures: list[ReceivedPicture],
        moment_s: float,
    ) -> RenderedView:
        """Return the view at ``moment_s`` (monotonic), or at the time of composing it if the
        request is for now; then pictures vouch for as long again as the view had to wait."""
        field = self._composing.open_field(tile.field_id)
        camera = _in_tile(request.camera, tile, field)
        _check_inside(camera, field)
        view = field.render(camera, request.quality)
        _check_outside_of_walls(view)
        by_key = sorted(pictures, key=lambda it: it.key)
        chosen = nearest(by_key, camera, lambda it: it.frame.pose, lambda it: it.vehicle_id)
        now = time.monotonic()
        past = request.time_ns != 0
        ages_s = [moment_s - it.captured_s if past else it.age_s(now) for it in chosen]
        pairs = zip(chosen, ages_s, strict=True)
        live = [(self._analysed(each, field, self._composing).live, age) for each, age in pairs]
        vehicles = [each.vehicle_id for each in chosen]
        max_age_s = request.max_age_s + (0.0 if past else now - moment_s)
        composed = compose(camera, view, live, max_age_s, vehicles)
        cameras = tuple(
            LiveCamera(each.vehicle_id, each.frame.camera_id, age_s, share, picture.trust == 0)
            for each, (picture, age_s), share in zip(chosen, live, composed.shares, strict=True)
        )
        return RenderedView(
            number=request.number,
            time_ns=request.time_ns or time.time_ns(),
            field_id=tile.field_id,
            encoding=request.encoding,
            picture=encoded_picture(composed.rgb, request.encoding),
            depth=composed.depth,
            age_ms=_milliseconds(composed),
            cameras=cameras,
        )

    def _detected(self, picture: ReceivedPicture, tile: ViewedTile) -> PictureObjects:
        field = self._finding.open_field(tile.field_id)
        found = self._analysed(picture, field, self._finding)
        labels = () if self._classify is None else _labels(self._classify, found)
        return PictureObjects(
            found.detections, found.live.rules_out, _origin_m(tile, field), labels
        )

    def _warmed_up(self, tile: ViewedTile) -> None:
        field = self._finding.open_field(tile.field_id)
        x_m, y_m, z_m = (sum(ends) / 2 for ends in zip(*astuple(field.bounds), strict=True))
        self._finding.ground(field).warm_up((x_m, y_m, z_m))

    def _ground_ahead(self, camera: Camera, tile: ViewedTile) -> None:
        field = self._finding.open_field(tile.field_id)
        ground = self._finding.ground(field)
        ground.ahead_of(ground.upright(camera))

    def _analysed(
        self, picture: ReceivedPicture, field: RadianceField, thread: _FieldThread
    ) -> _AnalysedPicture:
        """Return the comparison of a picture with ``field``, which is one of ``thread``."""
        kept = self._analyses.of(picture, field.field_id)
        if kept is None:
            kept = self._analyse(picture, field, thread.ground(field))
            self._analyses.keep(kept, field.field_id)
        return kept

    def _analyse(
        self, picture: ReceivedPicture, field: RadianceField, ground: FieldGround
    ) -> _AnalysedPicture:
        assert picture.frame.pose is not None
        rgb, intrinsics = shrunk(picture.picture, picture.intrinsics)
        camera = Camera(intrinsics, picture.frame.pose)
        live = live_picture(camera, rgb, self._field_view(picture, camera, field))
        return _AnalysedPicture(picture, *cut_out(live, ground))

    def _field_view(self, picture: ReceivedPicture, camera: Camera, field: RadianceField) -> View:
        """Return the view of ``field`` at a picture's ``camera``: the decoder's render if that is
        of this field and size."""
        render = self._twin.renders.of(picture)
        same = picture.field_id == field.field_id and camera.intrinsics == picture.intrinsics
        return field.render(camera, FULL) if render is None or not same else render


def _labels(classify: Classify, analysed: _AnalysedPicture) -> tuple[str, ...]:
    """Return the name that ``classify`` gives each object of a picture, by its bounding box."""
    rgb, _ = shrunk(analysed.picture.picture, analysed.picture.intrinsics)
    labels = []
    for thing in analysed.live.things:
        patch = thing.patch
        height, width = patch.samples.shape[:2]
        box = rgb[patch.top : patch.top + height, patch.left : patch.left + width]
        labels.append(check_label("label", classify(np.ascontiguousarray(box))))
    return tuple(labels)


def _ago_s(request: ViewRequest, now_ns: int, reach_s: float) -> float:
    """Return how long ago the moment of a request is.

    Raises ``InvalidInput`` for one in the future, or longer ago than ``reach_s``.
    """
    ago_s = (now_ns - request.time_ns) / 1e9 if request.time_ns else 0.0
    if not 0 <= ago_s <= reach_s:
        when = f"{ago_s:.3f} s ago" if ago_s > 0 else f"{-ago_s:.3f} s ahead"
        raise InvalidInput(
            "time_ns",
            f"{request.time_ns} is {when} by this server's clock ({now_ns}); ask for a moment that "
            f"is 0 to {reach_s:.3g} s ago, or with 0 for now",
        )
    return ago_s


def _origin_m(tile: ViewedTile, field: RadianceField) -> tuple[float, float, float]:
    """Return the field's origin, relative to the origin of poses in ``tile``."""
    if tile.world is None:
        return (0.0, 0.0, 0.0)
    origin, world = field.metadata.tile_origin, tile.world
    return (
        origin.east_m - world.east_m,
        origin.north_m - world.north_m,
        origin.up_m - world.up_m,
    )


def _in_tile(camera: Camera, tile: ViewedTile, field: RadianceField) -> Camera:
    """Return a camera given relative to the world of ``tile`` relative to the field's origin."""
    shift = TileOrigin(*_origin_m(tile, field))
    return replace(camera, world_from_cam=shift.localise(camera.world_from_cam))


def _check_inside(camera: Camera, field: RadianceField) -> None:
    """Raise ``InvalidInput`` for a camera further than ``BEYOND_BOUNDS_M`` outside of the field."""
    low_m, high_m = field.bounds.low_m, field.bounds.high_m
    for axis, at_m, low, high in zip(
        "xyz", camera.world_from_cam.translation_m, low_m, high_m, strict=True
    ):
        if not low - BEYOND_BOUNDS_M <= at_m <= high + BEYOND_BOUNDS_M:
            raise InvalidInput(
                f"pose.{axis}_m",
                f"{at_m:.6g} is more than {BEYOND_BOUNDS_M:g} m outside of the field, which is "
                f"from {low:.6g} to {high:.6g}; choose a viewpoint in the tile",
            )


def _check_outside_of_walls(view: View) -> None:
    """Raise ``InvalidInput`` for a view that something fills at arm's length."""
    near = (view.opacity > 0.5) & (view.depth < INSIDE_M)
    share = float(near.mean())
    if share >= INSIDE_SHARE:
        raise InvalidInput(
            "pose",
            f"{share:.0%} of the view is nearer than {INSIDE_M:g} m: the viewpoint is inside of "
            "something; move it into the open",
        )


def _milliseconds(composed: ComposedView) -> np.ndarray[tuple[int, ...], np.dtype[np.uint16]]:
    ages_ms = np.minimum(np.rint(composed.age_s * 1e3), NO_AGE - 1)
    return np.where(np.isfinite(composed.age_s), ages_ms, NO_AGE).astype(np.uint16)
