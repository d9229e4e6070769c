"""A radiance field made of 3D Gaussians (Kerbl et al. 2023).

What its archive holds is in ``rfcore.field.splat_archive``, which splats a quality draws in
``rfcore.field.detail``.
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
from rfcore.field.detail import rung
from rfcore.field.interface import SPLATS, Bounds, FieldMetadata
from rfcore.field.quality import FULL, Quality
from rfcore.field.splat_archive import splat_archive
from rfcore.native.raster import check_backend
from rfcore.raster.gaussians import Gaussians
from rfcore.raster.native import Rasterizer
from rfcore.views import View

__all__ = ["SplatField"]


class SplatField:
    """Gaussians with metadata, ready to render.

    ``field_id`` is that of the archive it came from; ``None``: that of the archive it would make.
    ``threads`` and ``isa`` choose how it renders, never what: every choice gives the same bytes.
    Raises ``BackendUnavailable`` if this machine lacks ``isa``. Safe to share between threads.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        metadata: FieldMetadata | None = None,
        *,
        threads: int = 1,
        isa: str | None = None,
        field_id: str | None = None,
    ) -> None:
        self.gaussians = gaussians
        self.metadata = metadata if metadata is not None else FieldMetadata()
        if self.metadata.kind != SPLATS:
            raise InvalidInput("field.kind", f"'{self.metadata.kind}' is not '{SPLATS}'")
        self.isa = check_backend(threads, isa)
        self._threads = threads
        self._field_id = field_id
        self._rasterizers: dict[tuple[float, int], Rasterizer] = {}
        self._lock = Lock()

    @cached_property
    def field_id(self) -> str:
        """SHA-256 of the field's archive, in hex."""
        if self._field_id is not None:
            return self._field_id
        return hashlib.sha256(encode_archive(self.archive())).hexdigest()

    @cached_property
    def bounds(self) -> Bounds:
        """The box around the means."""
        return Bounds.around(self.gaussians.means)

    @property
    def primitives(self) -> int:
        """How many Gaussians the field has."""
        return len(self.gaussians)

    def archive(self) -> Archive:
        """Return what the field's file holds."""
        return splat_archive(self.gaussians, self.metadata)

    def prepare(self, quality: Quality = FULL) -> None:
        """Make the renderer of ``quality``; without this the first picture makes it."""
        self.rasterizer(quality)

    def rasterizer(self, quality: Quality = FULL) -> Rasterizer:
        """Return the renderer of ``quality``, made when it is first needed and kept."""
        most = self.gaussians.sh_degree
        degree = most if quality.sh_degree is None else min(quality.sh_degree, most)
        key = (quality.detail, degree)
        with self._lock:
            if key not in self._rasterizers:
                self._rasterizers[key] = Rasterizer(
                    rung(self.gaussians, quality.detail, degree),
                    threads=self._threads,
                    isa=self.isa,
                )
            return self._rasterizers[key]

    def render(self, camera: Camera, quality: Quality = FULL) -> View:
        """Render colour, depth and opacity as ``camera`` sees them."""
        return self.rasterizer(quality).render(camera)

    def render_colour(self, camera: Camera, quality: Quality = FULL) -> NDArray[np.float32]:
        """Render colour alone, float32 [H, W, 3]: the bytes of ``render``, sooner."""
        return self.rasterizer(quality).render_colour(camera)
