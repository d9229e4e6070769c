"""Chooses which of a tile's fields a frame is coded against: the one of the frame's light.

A frame fits a field if the median of the differences between the block means of frame and render is
small: 0 or 1 level on the sample street at noon, vehicles included, 36 to 47 with the field of
noon at dusk. While the field in use fits, no other is tried. When it does not, the tile's other
lights are fetched, and those that are there are rendered beside it for one frame in ``TRY_EVERY``.
Another one is taken if it is clearly nearer, so that two lights that fit about equally do not take
turns.

A vehicle that has not fetched the tile's own field yet begins with a part of it, or with another
field, the tile's preview; ``take_own`` puts more of it in the place of that between two frames. A
part draws no higher level of detail than it has (``drawable``).
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace

import structlog

from rfcore.camera import Camera
from rfcore.codec.packet import median_block_mean_difference
from rfcore.field import Quality, RadianceField, render_field_view
from rfcore.image import I420
from rfcore.views import FieldView, View

log = structlog.get_logger()

FITS_LEVELS = 6.0
"""A median difference up to which a field is taken to be in the frame's light."""
NEARER_LEVELS = 3.0
"""Levels by which another light must be nearer."""
TRY_EVERY = 5


class TileLights:
    """The opened fields of one tile; frames are coded against ``current``.

    ``own_id``: the tile's own field, if it is not ``field``, which is drawn until that has arrived.
    ``want`` is called, on the thread that codes frames, each time that the field in use does not
    fit and further lights may be fetched. ``add`` and ``take_own`` may be called on other threads.
    """

    def __init__(
        self,
        field: RadianceField,
        want: Callable[[], None] = lambda: None,
        own_id: str | None = None,
    ) -> None:
        self.own = self.current = field
        self._own_id = field.field_id if own_id is None else own_id
        self._want = want
        self._lock = threading.Lock()
        self._fields: dict[str, RadianceField] = {field.field_id: field}
        self._until_try = 0
        self._arrived: RadianceField | None = None

    @property
    def named_id(self) -> str:
        """The current field's id as frames name it: empty for the tile's own."""
        return "" if self.current.field_id == self._own_id else self.current.field_id

    def add(self, field: RadianceField) -> None:
        """Offer another light; it is tried with the next frame that does not fit."""
        with self._lock:
            self._fields[field.field_id] = field
            self._until_try = 0

    def take_own(self, field: RadianceField) -> None:
        """Draw the next frame from ``field`` in place of the one in its stead."""
        with self._lock:
            self._arrived = field

    def held_ids(self) -> frozenset[str]:
        """Return the ids of the fields that were opened."""
        with self._lock:
            return frozenset(self._fields)

    def render(self, camera: Camera, quality: Quality) -> View:
        """Render the field in use, on any thread, for the search of a camera.

        A preview stays in use: only ``view`` puts the own field in its place.
        """
        return self.current.render(camera, quality)

    def drawable(self, quality: Quality) -> Quality:
        """Return the quality to call ``view`` with next, on the same thread.

        It is less detailed than ``quality`` while only a part of the field in use has arrived.
        """
        most = self._taken().most_detail
        return quality if quality.detail <= most else replace(quality, detail=most)

    def view(self, frame: I420, camera: Camera, quality: Quality) -> FieldView:
        """Render the field that fits at a frame's camera."""
        return self.fitting(frame, render_field_view(self._taken(), camera, quality), quality)

    def fitting(self, frame: I420, view: FieldView, quality: Quality) -> FieldView:
        """Return ``view``, which is the field in use, or the view of a light that is nearer."""
        if self._until_try > 0:
            self._until_try -= 1
            return view
        difference = median_block_mean_difference(frame, view.render)
        self._until_try = TRY_EVERY - 1
        if difference <= FITS_LEVELS:
            return view
        self._want()
        return self._nearest(frame, view, difference, quality)

    def _taken(self) -> RadianceField:
        """Return the current field, once the tile's own has taken the place of its preview.

        Called on the thread that codes frames, so that none changes between its render and name.
        """
        with self._lock:
            own, before = self._arrived, self.own
            if own is not None:
                del self._fields[before.field_id]
                self._fields[own.field_id] = self.own = own
                self._arrived, self._until_try = None, 0
                self.current = own if self.current is before else self.current
                log.info(
                    "own field taken",
                    field=own.field_id,
                    detail=own.most_detail,
                    detail_before=before.most_detail,
                )
            return self.current

    def _nearest(
        self, frame: I420, view: FieldView, difference: float, quality: Quality
    ) -> FieldView:
        with self._lock:
            others = [
                field
                for field in self._fields.values()
                if field is not self.current and field.most_detail >= quality.detail
            ]
        found, limit = view, difference - NEARER_LEVELS
        for field in others:
            other = render_field_view(field, view.camera, quality)
            levels = median_block_mean_difference(frame, other.render)
            if levels < limit:
                found, limit, self.current = other, levels, field
        if found is not view:
            log.info(
                "light changed",
                field=self.current.field_id,
                before_levels=difference,
                levels=limit,
            )
        return found
