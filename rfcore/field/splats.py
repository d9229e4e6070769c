"""A radiance field made of 3D Gaussians (Kerbl et al. 2023).

``rfcore.field.splat_archive`` describes its archive, ``rfcore.field.quality`` which splats are
drawn at a quality.
"""

from __future__ import annotations

import hashlib
from copy import copy
from functools import cached_property
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera
from rfcore.errors import InvalidInput
from rfcore.field.archive import Archive, encode_archive
from rfcore.field.interface import LATER_KEYS, SPLATS, Bounds, FieldMetadata, stored_metadata
from rfcore.field.quality import (
    FULL,
    Beginning,
    LevelsOfDetail,
    Quality,
    check_levels,
    colour_at_scale,
    splats_at_detail,
    view_at_scale,
)
from rfcore.field.splat_archive import compressed_archive, splat_archive, splats_of_compressed
from rfcore.field.splat_grid import FINEST, Grain, Steps
from rfcore.native.yuv import field_view_from_view
from rfcore.raster.gaussians import Gaussians
from rfcore.raster.native import Rasterizer, check_renderer
from rfcore.raster.renderers import is_opencl
from rfcore.views import FieldView, View


class SplatField:
    """Gaussians with metadata, ready to render.

    ``levels``: scales and opacities of the lower levels of detail (``rfcore.field.quality``).
    ``archive``: the archive that the field was read from, ``None`` for a new field. ``threads`` and
    ``isa``, which may be an OpenCL device, change how fast it renders, but no byte. ``beginning``:
    ``gaussians`` are only the first splats of a field (``decode_beginning``), which draw levels up
    to ``most_detail`` and have no archive. Raises ``BackendUnavailable`` if this machine lacks
    ``isa``. Safe to share between threads.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        metadata: FieldMetadata | None = None,
        *,
        levels: LevelsOfDetail | None = None,
        threads: int = 1,
        isa: str | None = None,
        archive: Archive | None = None,
        beginning: Beginning | None = None,
    ) -> None:
        self.gaussians = gaussians
        self._beginning = beginning or Beginning(len(gaussians), 1.0)
        self.metadata = metadata if metadata is not None else FieldMetadata()
        if self.metadata.kind != SPLATS:
            raise InvalidInput("field.kind", f"'{self.metadata.kind}' is not '{SPLATS}'")
        self.levels = dict(levels or {})
        check_levels(gaussians, self.levels, self._beginning.count)
        self.isa = check_renderer(threads, isa)
        self.base: SplatField | None = None
        """The base field, if this one's archive is a layer or a delta."""
        self._threads = threads
        self._archive = archive
        self._rasterizers: dict[float, Rasterizer] = {}
        self._lock = Lock()

    def __repr__(self) -> str:
        splats = f"{self.primitives:,} splats of SH degree {self.gaussians.sh_degree}"
        if self._archive is None:
            return f"SplatField({splats}, of no file)"
        size_mb = len(encode_archive(self._archive)) / 1e6
        return f"SplatField({splats}, {size_mb:.2f} MB, id {self.field_id})"

    @cached_property
    def field_id(self) -> str:
        """SHA-256 of the field's archive, in hex."""
        return hashlib.sha256(encode_archive(self.archive())).hexdigest()

    @cached_property
    def bounds(self) -> Bounds:
        """The box around the means."""
        return Bounds.around(self.gaussians.means)

    @property
    def primitives(self) -> int:
        """The number of Gaussians."""
        return len(self.gaussians)

    @property
    def threads(self) -> int:
        """The number of threads that render."""
        return self._threads

    @property
    def most_detail(self) -> float:
        """The highest level of detail that can be drawn: 1, unless only a part was loaded."""
        return self._beginning.detail

    def archive(self) -> Archive:
        """Return the content of the field's file; raise ``InvalidInput`` if only a part was
        loaded."""
        if self.most_detail < 1:
            count = self._beginning.count
            raise InvalidInput("field", f"{len(self.gaussians)} of {count} splats are here")
        if self._archive is not None:
            return self._archive
        return splat_archive(self.gaussians, self.levels, self.metadata)

    def compressed(self, steps: Steps | None = None, grain: Grain = FINEST) -> SplatField:
        """Return this field compressed; a compressed field returns itself.

        The result differs slightly and is another field. Raises ``InvalidInput`` for values that a
        compressed archive cannot hold.
        """
        if "encoding" in self.archive().metadata:
            return self
        archive = compressed_archive(self.gaussians, self.levels, self.metadata, steps, grain)
        gaussians, levels = splats_of_compressed(archive)
        return self._like(gaussians, self.metadata, levels, archive)

    def described(self, metadata: FieldMetadata) -> SplatField:
        """Return another field with the same splats and other metadata."""
        old = self.archive()
        if old.kind != SPLATS:
            return SplatField(
                self.gaussians, metadata, levels=self.levels, threads=self._threads, isa=self.isa
            )
        kept = {key: value for key, value in old.metadata.items() if key not in LATER_KEYS}
        described = {**kept, **stored_metadata(metadata, self.bounds)}
        archive = Archive(SPLATS, described, old.arrays)
        return self._like(self.gaussians, metadata, self.levels, archive)

    def derived(
        self,
        gaussians: Gaussians,
        metadata: FieldMetadata,
        archive: Archive,
        levels: LevelsOfDetail | None = None,
    ) -> SplatField:
        """Return the field of ``archive``, a layer or delta on this one, with these splats.

        ``levels``: ``None`` for this field's.
        """
        levels = self.levels if levels is None else levels
        made = self._like(gaussians, metadata, levels, archive)
        made.base = self
        return made

    def with_threads(self, threads: int) -> SplatField:
        """Return the same field with renderers of its own and so many threads."""
        own = copy(self)
        own.isa, own._threads = check_renderer(threads, self.isa), threads
        with self._lock:
            made = self._rasterizers.items()
            own._rasterizers = {detail: each.with_threads(threads) for detail, each in made}
        own._lock = Lock()
        return own

    def prepare(self, quality: Quality = FULL) -> None:
        """Make the renderer of ``quality``, which otherwise the first picture makes."""
        self.rasterizer(quality.detail)

    def rasterizer(self, detail: float = 1.0) -> Rasterizer:
        """Return the renderer of a level, which is made at the first call and kept.

        Raises ``InvalidInput`` for a level that was not loaded.
        """
        if detail > self.most_detail:
            raise InvalidInput("quality.detail", f"{detail:g} is above {self.most_detail:g}, here")
        with self._lock:
            if detail not in self._rasterizers:
                self._rasterizers[detail] = Rasterizer(
                    splats_at_detail(self.gaussians, self.levels, detail, self._beginning.count),
                    threads=self._threads,
                    isa=self.isa,
                    antialiased=self.metadata.antialiased,
                )
            return self._rasterizers[detail]

    def render(self, camera: Camera, quality: Quality = FULL) -> View:
        """Render colour, depth and opacity as ``camera`` sees them."""
        return view_at_scale(self._view, camera, quality)

    def _view(self, camera: Camera, quality: Quality) -> View:
        return self.rasterizer(quality.detail).render(camera, sh_degree=self._degree(quality))

    @property
    def is_on_device(self) -> bool:
        """True if an OpenCL device renders and has not failed."""
        with self._lock:
            drawn_by = [self.isa, *(each.isa for each in self._rasterizers.values())]
        return all(map(is_opencl, drawn_by))

    def field_view(self, camera: Camera, quality: Quality = FULL) -> FieldView:
        """Render in the form of the codec; a device makes the codec's picture itself."""
        if quality.scale != 1:
            return field_view_from_view(self.render(camera, quality), camera)
        rasterizer = self.rasterizer(quality.detail)
        return rasterizer.field_view(camera, sh_degree=self._degree(quality))

    def render_colour(self, camera: Camera, quality: Quality = FULL) -> NDArray[np.float32]:
        """Render only colour, float32 [H, W, 3]: the same bytes as ``render``, faster."""
        return colour_at_scale(self._colour, camera, quality)

    def _colour(self, camera: Camera, quality: Quality) -> NDArray[np.float32]:
        rasterizer = self.rasterizer(quality.detail)
        return rasterizer.render_colour(camera, sh_degree=self._degree(quality))

    def _like(
        self,
        gaussians: Gaussians,
        metadata: FieldMetadata,
        levels: LevelsOfDetail,
        archive: Archive,
    ) -> SplatField:
        return SplatField(
            gaussians,
            metadata,
            levels=levels,
            threads=self._threads,
            isa=self.isa,
            archive=archive,
        )

    def _degree(self, quality: Quality) -> int:
        most = self.gaussians.sh_degree
        return most if quality.sh_degree is None else min(quality.sh_degree, most)
