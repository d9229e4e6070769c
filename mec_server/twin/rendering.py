"""Views of the twin for consumers: which pictures may enter them, where they are computed, and what
that is charged.

Views are composed on one thread that works while a processor is idle, and the things in pictures
are found, for notices and for whoever asks for objects, on another that gives way to decoding
alone: what a vehicle is to be told does not wait for views. Each has fields of its own: neither
event loop nor the workers that decode, nor the renderers these share, wait for them. Identities
take turns, and pay with worker time, the same as vehicles.

What a picture changes in a field is found once, by whichever thread comes first. The field's view
of its pose is the decoder's own render, where that is still there and of the same field and size.
"""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, replace
from functools import partial
from threading import Lock
from typing import TypeVar

import numpy as np

from mec_server.event_loop import Workers, give_way, work_when_idle
from mec_server.ledger.budgets import Resource
from mec_server.ledger.ledger import Ledger
from mec_server.twin.state import Covers, ReceivedPicture, Twin
from rfcore.camera import Camera, TileOrigin
from rfcore.errors import AccessDenied, InvalidInput, LimitExceeded
from rfcore.field import RadianceField
from rfcore.field.quality import FULL
from rfcore.image import Rgb, jpeg_bytes, png_bytes
from rfcore.native.yuv import i420_from_rgb
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
from rfcore.wire.checks import check_label, shown
from rfcore.wire.tiles import Tile
from rfcore.wire.twin import PictureEncoding
from rfcore.wire.twin_render import (
    NO_AGE,
    LiveCamera,
    ObjectsRequest,
    RenderedView,
    ViewRequest,
)

__all__ = ["Classify", "PictureObjects", "ViewService", "ViewedTile", "check_inside", "viewed_tile"]

R = TypeVar("R")
OpenField = Callable[[str], RadianceField]

Classify = Callable[[Rgb], str]
"""A detector: returns what the thing in a cut-out of a picture, uint8 [H, W, 3], is called: a name
of at most 64 letters, digits, '.', '_' or '-', or nothing."""

LOOKS_NICE = 5
"""Of the thread that finds things, for objects and notices, which are worth nothing when they are
late: at 10 it found nothing for seconds where others kept the processors busy."""
MOST_KEPT = 16
"""Live pictures whose difference from the field is kept for the next view."""

MOST_AHEAD = 2
"""Drawings that wait for pictures which are not there yet."""
MOST_GROUNDS = 2
"""Fields whose ground is kept, and which are open for it."""

BEYOND_BOUNDS_M = 5.0
"""How far outside of a field's box a view may be."""
INSIDE_M, INSIDE_SHARE = 0.3, 0.9
"""A view of which so much is nearer than this is inside of something."""


@dataclass(frozen=True)
class ViewedTile:
    """A field to draw, and every field that pictures of the same ground may be coded against.
    ``world``: what poses and objects are relative to, None for the field's origin."""

    field_id: str
    field_ids: frozenset[str]
    world: TileOrigin | None = None


def viewed_tile(request: ViewRequest | ObjectsRequest, tiles: Sequence[Tile]) -> ViewedTile:
    """Return what ``request`` names; raise ``InvalidInput`` for a tile that is not published, or a
    place that is on none."""
    if request.place is not None:
        tile = _tile_at(request.place, tiles)
        return ViewedTile(tile.field_id, tile.archive_ids, request.place)
    for tile in tiles:
        if request.tile == tile.name or request.field_id in tile.archive_ids:
            return ViewedTile(request.field_id or tile.field_id, tile.archive_ids)
    if request.field_id:
        return ViewedTile(request.field_id, frozenset((request.field_id,)))
    here = ", ".join(tile.name for tile in tiles) or "none; name a field_id"
    raise InvalidInput("tile", f"{shown(request.tile)} is not published here; published: {here}")


def _tile_at(place: TileOrigin, tiles: Sequence[Tile]) -> Tile:
    """Return the tile whose area a place is in, or else the nearest whose margin reaches it."""
    at = (place.east_m, place.north_m)
    reaching = [tile for tile in tiles if tile.reaches(*at)]
    if not reaching:
        here = ", ".join(map(_area_of, tiles)) or "none; name a field_id"
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
    """What a picture says of things that the field does not have: those it shows, and of which it
    says that they are not there. ``origin_m``: of the field, relative to the place's ``world``;
    ``labels``: what a detector calls each of them, none without one."""

    detections: list[Detection]
    rules_out: RulesOut = rules_nothing_out
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    labels: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class _AnalysedPicture:
    """A picture, what it changes in a field, and the things in it."""

    seen: ReceivedPicture
    live: LivePicture
    detections: list[Detection]


class _FieldThread:
    """One thread, and the fields that it alone renders, which ``open_field`` opens."""

    def __init__(self, worker: Workers, open_field: OpenField) -> None:
        self.worker = worker
        self.open_field = open_field
        self._grounds: OrderedDict[str, FieldGround] = OrderedDict()

    def ground(self, field: RadianceField) -> FieldGround:
        """Return the ground of ``field``; what of it was drawn is kept."""
        ground = self._grounds.pop(field.field_id, None) or FieldGround(field.render)
        self._grounds[field.field_id] = ground
        if len(self._grounds) > MOST_GROUNDS:
            self._grounds.popitem(last=False)
        return ground


class _AnalysisCache:
    """What the newest pictures change in fields, for all threads."""

    def __init__(self) -> None:
        self._kept: OrderedDict[tuple[CameraKey, str], _AnalysedPicture] = OrderedDict()
        self._lock = Lock()

    def of(self, seen: ReceivedPicture, field_id: str) -> _AnalysedPicture | None:
        """Return what was kept of ``seen``, None if nothing was."""
        with self._lock:
            kept = self._kept.get((seen.key, field_id))
            if kept is None or kept.seen is not seen:
                return None
            self._kept.move_to_end((seen.key, field_id))
        return kept

    def keep(self, looked_at: _AnalysedPicture, field_id: str) -> None:
        """Keep what was found, in place of what its camera showed before."""
        with self._lock:
            self._kept[looked_at.seen.key, field_id] = looked_at
            self._kept.move_to_end((looked_at.seen.key, field_id))
            if len(self._kept) > MOST_KEPT:
                self._kept.popitem(last=False)


class ViewService:
    """Composes views of ``twin``, and finds the things in its pictures.

    ``open_fields`` returns, for each thread, what opens fields that only this thread uses;
    ``tiles`` are those published now. ``failed`` is called with what a callback of a thread raised.
    ``classify`` names the things of pictures, on the thread that finds them.
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
        views = Workers(1, failed, "views", begin=work_when_idle)
        looks = Workers(1, failed, "looks", begin=partial(give_way, LOOKS_NICE))
        self._composing = _FieldThread(views, open_fields())
        self._looking = _FieldThread(looks, open_fields())
        self._kept = _AnalysisCache()
        self._ahead = 0

    def close(self) -> None:
        """Stop the threads."""
        self._composing.worker.close()
        self._looking.worker.close()

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
        place = self.place(request, may_draw)
        now = time.monotonic()
        ago_s = _ago_s(request, time.time_ns(), self._twin.reach_s(now))
        if request.time_ns:
            known = self._twin.at(now - ago_s, request.max_age_s)
        else:
            known = self._twin.recent(now, request.max_age_s)
        pictures = [
            seen
            for seen in known
            if seen.field_id in place.field_ids and covers(seen.vehicle_id, seen.field_id)
        ]
        work = partial(self._composed, request, place, pictures, now - ago_s)
        return await self._on_thread(self._composing, identity, work)

    async def objects_in(
        self, seen: ReceivedPicture, place: ViewedTile, identity: str
    ) -> PictureObjects:
        """Return what a picture shows that the field of ``place`` does not have; nothing for one
        without a pose.

        Raises ``LimitExceeded`` while ``identity`` has spent its worker time.
        """
        if seen.frame.pose is None:
            return PictureObjects([])
        compute = partial(self._detected, seen, place)
        return await self._on_thread(self._looking, identity, compute)

    def prepare(self, place: ViewedTile, identity: str) -> None:
        """Open the field of ``place`` and draw it once, so that the first glance is not late."""
        self._look_ahead(partial(self._warmed_up, place), identity)

    def expect_picture(self, camera: Camera, place: ViewedTile, identity: str) -> None:
        """Draw what a glance at a picture of ``camera`` will need of the field's ground, while the
        picture is being decoded: a place that was not looked at takes as long as that."""
        self._look_ahead(partial(self._ground_ahead, camera, place), identity)

    def _look_ahead(self, draw: Callable[[], object], identity: str) -> None:
        """Draw, unless ``MOST_AHEAD`` wait or ``identity`` has spent its worker time."""
        if self._ahead >= MOST_AHEAD:
            return
        try:
            self._ledger.check(identity, Resource.WORKER_SECONDS, time.monotonic())
        except LimitExceeded:
            return
        self._ahead += 1
        work = partial(_seconds_of, draw)
        self._looking.worker.submit(identity, work, partial(self._looked_ahead, identity))

    def _looked_ahead(self, identity: str, outcome: float | Exception) -> None:
        self._ahead -= 1
        if isinstance(outcome, Exception):
            raise outcome
        self._ledger.charge(identity, Resource.WORKER_SECONDS, outcome, time.monotonic())

    def place(
        self, request: ViewRequest | ObjectsRequest, may_draw: Callable[[str], bool]
    ) -> ViewedTile:
        """Return where to look; raise ``InvalidInput`` or ``AccessDenied``."""
        place = viewed_tile(request, self._tiles())
        if not may_draw(place.field_id):
            raise AccessDenied("this certificate may not see that tile; ask the operator")
        return place

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
        """Return for how long the thread was busy, and the result, or why there is none."""
        if answer.cancelled():
            return 0.0, asyncio.InvalidStateError("nobody waits for this")
        started = time.monotonic()
        try:
            result: R | Exception = compute()
        except Exception as error:
            result = error
        return time.monotonic() - started, result

    def _composed(
        self,
        request: ViewRequest,
        place: ViewedTile,
        pictures: list[ReceivedPicture],
        moment_s: float,
    ) -> RenderedView:
        """Return the view at ``moment_s`` (monotonic), or at the time of composing it if the
        request is for now."""
        field = self._composing.open_field(place.field_id)
        camera = _in_tile(request.camera, place, field)
        check_inside(camera, field)
        view = field.render(camera, request.quality)
        check_outside_of_walls(view)
        by_key = sorted(pictures, key=lambda it: it.key)
        seen = nearest(by_key, camera, lambda it: it.frame.pose, lambda it: it.vehicle_id)
        now = time.monotonic()
        past = request.time_ns != 0
        ages_s = [moment_s - it.captured_s if past else it.age_s(now) for it in seen]
        pairs = zip(seen, ages_s, strict=True)
        live = [(self._looked_at(each, field, self._composing).live, age) for each, age in pairs]
        vehicles = [each.vehicle_id for each in seen]
        composed = compose(camera, view, live, request.max_age_s, vehicles)
        cameras = tuple(
            LiveCamera(each.vehicle_id, each.frame.camera_id, age_s, share, picture.trust == 0)
            for each, (picture, age_s), share in zip(seen, live, composed.shares, strict=True)
        )
        return RenderedView(
            number=request.number,
            time_ns=request.time_ns or time.time_ns(),
            field_id=place.field_id,
            encoding=request.encoding,
            picture=_encoded(composed.rgb, request.encoding),
            depth=composed.depth,
            age_ms=_milliseconds(composed),
            cameras=cameras,
        )

    def _detected(self, seen: ReceivedPicture, place: ViewedTile) -> PictureObjects:
        field = self._looking.open_field(place.field_id)
        looked = self._looked_at(seen, field, self._looking)
        labels = () if self._classify is None else _labels(self._classify, looked)
        return PictureObjects(
            looked.detections, looked.live.rules_out, _origin_m(place, field), labels
        )

    def _warmed_up(self, place: ViewedTile) -> None:
        field = self._looking.open_field(place.field_id)
        x_m, y_m, z_m = (sum(ends) / 2 for ends in zip(*astuple(field.bounds), strict=True))
        self._looking.ground(field).warm_up((x_m, y_m, z_m))

    def _ground_ahead(self, camera: Camera, place: ViewedTile) -> None:
        field = self._looking.open_field(place.field_id)
        self._looking.ground(field).ahead_of(camera)

    def _looked_at(
        self, seen: ReceivedPicture, field: RadianceField, thread: _FieldThread
    ) -> _AnalysedPicture:
        """Return what a picture changes in ``field``, which is one of ``thread``."""
        kept = self._kept.of(seen, field.field_id)
        if kept is None:
            kept = self._look_at(seen, field, thread.ground(field))
            self._kept.keep(kept, field.field_id)
        return kept

    def _look_at(
        self, seen: ReceivedPicture, field: RadianceField, ground: FieldGround
    ) -> _AnalysedPicture:
        assert seen.frame.pose is not None
        rgb, intrinsics = shrunk(seen.picture, seen.intrinsics)
        camera = Camera(intrinsics, seen.frame.pose)
        live = live_picture(camera, rgb, self._field_view(seen, camera, field))
        return _AnalysedPicture(seen, *cut_out(live, ground))

    def _field_view(self, seen: ReceivedPicture, camera: Camera, field: RadianceField) -> View:
        """Return what ``field`` shows at the ``camera`` of a picture: the decoder's render if that
        is of this field and size."""
        render = self._twin.renders.of(seen)
        same = seen.field_id == field.field_id and camera.intrinsics == seen.intrinsics
        return field.render(camera, FULL) if render is None or not same else render


def _seconds_of(work: Callable[[], object]) -> float:
    started = time.monotonic()
    work()
    return time.monotonic() - started


def _labels(classify: Classify, looked: _AnalysedPicture) -> tuple[str, ...]:
    """Return what ``classify`` calls each thing of a picture, by the box of its outline."""
    rgb, _ = shrunk(looked.seen.picture, looked.seen.intrinsics)
    labels = []
    for thing in looked.live.things:
        patch = thing.patch
        height, width = patch.samples.shape[:2]
        box = rgb[patch.top : patch.top + height, patch.left : patch.left + width]
        labels.append(check_label("label", classify(np.ascontiguousarray(box))))
    return tuple(labels)


def _ago_s(request: ViewRequest, now_ns: int, reach_s: float) -> float:
    """Return how long ago the moment is that a request is for; raise ``InvalidInput`` for one that
    has not come, or longer ago than ``reach_s``."""
    ago_s = (now_ns - request.time_ns) / 1e9 if request.time_ns else 0.0
    if not 0 <= ago_s <= reach_s:
        when = f"{ago_s:.3f} s ago" if ago_s > 0 else f"{-ago_s:.3f} s ahead"
        raise InvalidInput(
            "time_ns",
            f"{request.time_ns} is {when} by this server's clock ({now_ns}); ask for a moment that "
            f"is 0 to {reach_s:.3g} s ago, or with 0 for now",
        )
    return ago_s


def _origin_m(place: ViewedTile, field: RadianceField) -> tuple[float, float, float]:
    """Return where the field's origin is, relative to what ``place`` says poses are."""
    if place.world is None:
        return (0.0, 0.0, 0.0)
    origin, world = field.metadata.tile_origin, place.world
    return (
        origin.east_m - world.east_m,
        origin.north_m - world.north_m,
        origin.up_m - world.up_m,
    )


def _in_tile(camera: Camera, place: ViewedTile, field: RadianceField) -> Camera:
    """Return a camera that is relative to ``place`` relative to the field's origin."""
    shift = TileOrigin(*_origin_m(place, field))
    return replace(camera, world_from_cam=shift.localise(camera.world_from_cam))


def check_inside(camera: Camera, field: RadianceField) -> None:
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


def check_outside_of_walls(view: View) -> None:
    """Raise ``InvalidInput`` for a view that something fills at arm's length."""
    near = (view.opacity > 0.5) & (view.depth < INSIDE_M)
    share = float(near.mean())
    if share >= INSIDE_SHARE:
        raise InvalidInput(
            "pose",
            f"{share:.0%} of the view is nearer than {INSIDE_M:g} m: the viewpoint is inside of "
            "something; move it into the open",
        )


def _encoded(rgb: Rgb, encoding: PictureEncoding) -> bytes:
    match encoding:
        case PictureEncoding.NONE:
            return b""
        case PictureEncoding.I420:
            return i420_from_rgb(rgb).packed()
        case PictureEncoding.JPEG:
            return jpeg_bytes(rgb)
        case PictureEncoding.PNG:
            return png_bytes(rgb)


def _milliseconds(composed: ComposedView) -> np.ndarray[tuple[int, ...], np.dtype[np.uint16]]:
    ages_ms = np.minimum(np.rint(composed.age_s * 1e3), NO_AGE - 1)
    return np.where(np.isfinite(composed.age_s), ages_ms, NO_AGE).astype(np.uint16)
