"""Views of the twin for consumers: which pictures may enter them, where they are computed, and what
that is charged.

Views are computed on one thread of the lowest priority, with fields of its own: neither event loop
nor the workers that decode, nor the renderers these share, wait for it. Identities take turns, and
pay with worker time, the same as vehicles.
"""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np

from mec_server.event_loop import LOWEST_NICE, Workers
from mec_server.ledger.budgets import Resource
from mec_server.ledger.ledger import Ledger
from mec_server.twin.composition import (
    ComposedView,
    LivePicture,
    compose,
    live_picture,
    nearest,
    shrunk,
    with_things,
)
from mec_server.twin.contacts import Detection, find
from mec_server.twin.ground import FieldGround
from mec_server.twin.objects import Lacks
from mec_server.twin.state import CameraKey, Covers, Twin, TwinView
from rfcore.camera import Camera
from rfcore.errors import AccessDenied, InvalidInput
from rfcore.field import RadianceField
from rfcore.field.quality import FULL
from rfcore.image import Rgb, jpeg_bytes, png_bytes
from rfcore.native.yuv import i420_from_rgb
from rfcore.views import View
from rfcore.wire.checks import shown
from rfcore.wire.tiles import Tile
from rfcore.wire.twin import PictureEncoding
from rfcore.wire.twin_render import (
    NO_AGE,
    LiveCamera,
    ObjectsRequest,
    RenderedView,
    ViewRequest,
)

__all__ = ["Glance", "Place", "TwinViews", "check_inside", "place_of"]

R = TypeVar("R")

MOST_KEPT = 16
"""Live pictures whose difference from the field is kept for the next view."""

MOST_GROUNDS = 2
"""Fields whose ground is kept, and which are open for it."""

BEYOND_BOUNDS_M = 5.0
"""How far outside of a field's box a view may be."""
INSIDE_M, INSIDE_SHARE = 0.3, 0.9
"""A view of which so much is nearer than this is inside of something."""


@dataclass(frozen=True)
class Place:
    """A field to draw, and every field that pictures of the same ground may be coded against."""

    field_id: str
    field_ids: frozenset[str]


def place_of(request: ViewRequest | ObjectsRequest, tiles: Sequence[Tile]) -> Place:
    """Return what ``request`` names; raise ``InvalidInput`` for a tile that is not published."""
    for tile in tiles:
        if request.tile == tile.name or request.field_id in tile.archive_ids:
            return Place(request.field_id or tile.field_id, tile.archive_ids)
    if request.field_id:
        return Place(request.field_id, frozenset((request.field_id,)))
    here = ", ".join(tile.name for tile in tiles) or "none; name a field_id"
    raise InvalidInput("tile", f"{shown(request.tile)} is not published here; published: {here}")


@dataclass(frozen=True, eq=False)
class Glance:
    """What a picture says of things that the field does not have: those it shows, and of which it
    says that they are not there."""

    detections: list[Detection]
    lacks: Lacks = lambda _at_m, _width_m, _height_m: False


@dataclass(frozen=True, eq=False)
class _LookedAt:
    """A picture, what it changes in a field, and the things in it."""

    seen: TwinView
    live: LivePicture
    detections: list[Detection]


class TwinViews:
    """Composes views of ``twin``.

    ``open_field`` opens a field that only these views use; ``tiles`` are those published now.
    ``failed`` is called with what a callback of the thread raised.
    """

    def __init__(
        self,
        twin: Twin,
        open_field: Callable[[str], RadianceField],
        tiles: Callable[[], tuple[Tile, ...]],
        ledger: Ledger,
        failed: Callable[[Exception], None],
    ) -> None:
        self._twin = twin
        self._open_field = open_field
        self._tiles = tiles
        self._ledger = ledger
        self._worker = Workers(1, failed, "views", nice=LOWEST_NICE)
        self._kept: OrderedDict[tuple[CameraKey, str], _LookedAt] = OrderedDict()
        self._grounds: OrderedDict[str, FieldGround] = OrderedDict()

    def close(self) -> None:
        """Stop the thread."""
        self._worker.close()

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
        viewpoint outside of the field or inside of a wall. A caller that is cancelled costs at most
        the view that has begun.
        """
        place = self.place(request, may_draw)
        now = time.monotonic()
        recent = [
            seen
            for seen in self._twin.recent(now, request.max_age_s)
            if seen.field_id in place.field_ids and covers(seen.vehicle_id, seen.field_id)
        ]
        return await self._on_thread(identity, partial(self._composed, request, place, recent))

    async def glance(self, seen: TwinView, place: Place, identity: str) -> Glance:
        """Return what a picture shows that the field of ``place`` does not have; nothing for one
        without a pose.

        Raises ``LimitExceeded`` while ``identity`` has spent its worker time.
        """
        if seen.frame.pose is None:
            return Glance([])
        return await self._on_thread(identity, partial(self._detected, seen, place))

    def place(
        self, request: ViewRequest | ObjectsRequest, may_draw: Callable[[str], bool]
    ) -> Place:
        """Return where to look; raise ``InvalidInput`` or ``AccessDenied``."""
        place = place_of(request, self._tiles())
        if not may_draw(place.field_id):
            raise AccessDenied("this certificate may not see that tile; ask the operator")
        return place

    async def _on_thread(self, identity: str, compute: Callable[[], R]) -> R:
        self._ledger.check(identity, Resource.WORKER_SECONDS, time.monotonic())
        answer: asyncio.Future[R] = asyncio.get_running_loop().create_future()
        work = partial(self._timed, compute, answer)
        self._worker.submit(identity, work, partial(self._finish, identity, answer))
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

    # --- on the thread

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

    def _composed(self, request: ViewRequest, place: Place, recent: list[TwinView]) -> RenderedView:
        field = self._open_field(place.field_id)
        camera = request.camera
        check_inside(camera, field)
        view = field.render(camera, request.quality)
        check_outside_of_walls(view)
        by_key = sorted(recent, key=lambda it: it.key)
        seen = nearest(by_key, camera, lambda it: it.frame.pose, lambda it: it.vehicle_id)
        now = time.monotonic()
        live = [(self._looked_at(each, field).live, each.age_s(now)) for each in seen]
        vehicles = [each.vehicle_id for each in seen]
        composed = compose(camera, view, live, request.max_age_s, vehicles)
        cameras = tuple(
            LiveCamera(each.vehicle_id, each.frame.camera_id, age_s, share, picture.trust == 0)
            for each, (picture, age_s), share in zip(seen, live, composed.shares, strict=True)
        )
        return RenderedView(
            number=request.number,
            time_ns=time.time_ns(),
            field_id=place.field_id,
            encoding=request.encoding,
            picture=_encoded(composed.rgb, request.encoding),
            depth=composed.depth,
            age_ms=_milliseconds(composed),
            cameras=cameras,
        )

    def _detected(self, seen: TwinView, place: Place) -> Glance:
        looked = self._looked_at(seen, self._open_field(place.field_id))
        return Glance(looked.detections, looked.live.lacks)

    def _ground(self, field: RadianceField) -> FieldGround:
        """Return the ground of ``field``; what of it was drawn is kept."""
        ground = self._grounds.pop(field.field_id, None) or FieldGround(field.render)
        self._grounds[field.field_id] = ground
        if len(self._grounds) > MOST_GROUNDS:
            self._grounds.popitem(last=False)
        return ground

    def _looked_at(self, seen: TwinView, field: RadianceField) -> _LookedAt:
        """Return what a picture changes in ``field``; found once for each picture."""
        key = (seen.key, field.field_id)
        kept = self._kept.get(key)
        if kept is None or kept.seen is not seen:
            assert seen.frame.pose is not None
            rgb, intrinsics = shrunk(seen.picture, seen.intrinsics)
            camera = Camera(intrinsics, seen.frame.pose)
            live = live_picture(camera, rgb, field.render(camera, FULL))
            found = find(live, self._ground(field))
            live = with_things(live, [each.outline for each in found])
            kept = _LookedAt(seen, live, [each.detection for each in found])
            self._kept[key] = kept
            if len(self._kept) > MOST_KEPT:
                self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        return kept


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
