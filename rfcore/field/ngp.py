"""A radiance field made of a multiresolution hash grid (Mueller et al. 2022).

``Quality.samples_per_ray`` is its knob: ``None`` takes every occupied step along a ray, a number n
merges neighbouring ones where a ray has more than n (``rfcore.ngp.reference.render_rays``). What
its archive holds is in ``rfcore.field.ngp_archive``.
"""

from __future__ import annotations

import hashlib
from functools import cached_property
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera
from rfcore.errors import InvalidInput
from rfcore.field.archive import Archive, encode_archive
from rfcore.field.interface import NGP, Bounds, FieldMetadata
from rfcore.field.ngp_archive import as_stored, bounds_of, ngp_archive
from rfcore.field.quality import FULL, Quality
from rfcore.field.scale import colour_at_scale, view_at_scale
from rfcore.native.raster import check_backend
from rfcore.ngp.native import NgpRenderer
from rfcore.ngp.parameters import NgpParameters
from rfcore.views import View

__all__ = ["NgpField"]


class NgpField:
    """A hash grid with metadata, ready to render.

    The table is rounded to the float16 its file holds. ``threads`` and ``isa`` choose how it
    renders, never what: every choice gives the same bytes. Raises ``BackendUnavailable`` if this
    machine lacks ``isa``. Safe to share between threads.
    """

    def __init__(
        self,
        numbers: NgpParameters,
        metadata: FieldMetadata | None = None,
        *,
        threads: int = 1,
        isa: str | None = None,
    ) -> None:
        self.numbers = as_stored(numbers)
        self.metadata = metadata if metadata is not None else FieldMetadata(kind=NGP)
        if self.metadata.kind != NGP:
            raise InvalidInput("field.kind", f"'{self.metadata.kind}' is not '{NGP}'")
        self.isa = check_backend(threads, isa)
        self._threads = threads
        self._lock = Lock()
        self._renderer: NgpRenderer | None = None

    @cached_property
    def field_id(self) -> str:
        """SHA-256 of the field's archive, in hex."""
        return hashlib.sha256(encode_archive(self.archive())).hexdigest()

    @cached_property
    def bounds(self) -> Bounds:
        """The box the field was made for."""
        return bounds_of(self.numbers.shape.space)

    @property
    def primitives(self) -> int:
        """How many trained numbers the field has."""
        return self.numbers.table.size + self.numbers.matrices.size

    def archive(self) -> Archive:
        """Return what the field's file holds."""
        return ngp_archive(self.numbers, self.metadata)

    def prepare(self, quality: Quality = FULL) -> None:  # noqa: ARG002 - one renderer for all
        """Make the renderer; without this the first picture makes it."""
        self.renderer()

    def renderer(self) -> NgpRenderer:
        """Return the renderer, made when it is first needed and kept."""
        with self._lock:
            if self._renderer is None:
                self._renderer = NgpRenderer(self.numbers, threads=self._threads, isa=self.isa)
            return self._renderer

    def render(self, camera: Camera, quality: Quality = FULL) -> View:
        """Render colour, depth and opacity as ``camera`` sees them."""
        return view_at_scale(self._view, camera, quality)

    def _view(self, camera: Camera, quality: Quality) -> View:
        return self.renderer().render(camera, quality.samples_per_ray)

    def render_colour(self, camera: Camera, quality: Quality = FULL) -> NDArray[np.float32]:
        """Render colour alone, float32 [H, W, 3]: the bytes of ``render``, sooner."""
        return colour_at_scale(self._colour, camera, quality)

    def _colour(self, camera: Camera, quality: Quality) -> NDArray[np.float32]:
        return self.renderer().render_colour(camera, quality.samples_per_ray)
