"""A field of 3D Gaussians: what it is made of, where it lies, and how it looks from a camera."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, TileOrigin
from rfcore.errors import FieldFormatError, InvalidInput
from rfcore.field.archive import (
    Archive,
    decode_archive,
    encode_archive,
    read_file,
)
from rfcore.files import write_whole
from rfcore.native.raster import check_backend
from rfcore.raster.gaussians import Gaussians
from rfcore.raster.native import Rasterizer
from rfcore.views import View

__all__ = [
    "Bounds",
    "FieldMetadata",
    "SplatField",
    "decode_field",
    "encode_field",
    "load_field",
    "save_field",
]

KIND = "splats"


@dataclass(frozen=True)
class Bounds:
    """The axis-aligned box around a field's means, relative to the tile's origin."""

    low_m: tuple[float, float, float]
    high_m: tuple[float, float, float]

    def __post_init__(self) -> None:
        corners = (self.low_m, self.high_m)
        if any(len(c) != 3 or not all(map(math.isfinite, c)) for c in corners):
            raise InvalidInput("bounds", f"{corners} must be two corners of three finite metres")

    @staticmethod
    def around(gaussians: Gaussians) -> Bounds:
        """Return the box of the means; of an empty set, the origin."""
        if not len(gaussians):
            return Bounds((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        low, high = gaussians.means.min(axis=0).tolist(), gaussians.means.max(axis=0).tolist()
        return Bounds((low[0], low[1], low[2]), (high[0], high[1], high[2]))


@dataclass(frozen=True)
class FieldMetadata:
    """What is known about a field besides its parameters.

    ``training_digest`` is the digest of the pictures, points and settings it was trained with,
    empty when it was imported. ``held_out_psnr_db`` is the mean PSNR over pictures it was not
    trained on, ``None`` when nobody measured it.
    """

    name: str = ""
    tile_origin: TileOrigin = field(default_factory=TileOrigin)
    training_digest: str = ""
    held_out_psnr_db: float | None = None
    kind: str = KIND

    def __post_init__(self) -> None:
        if self.kind != KIND:
            raise InvalidInput("field.kind", f"'{self.kind}' is not '{KIND}'")
        db = self.held_out_psnr_db
        if db is not None and not math.isfinite(db):
            raise InvalidInput("field.held_out_psnr_db", f"{db} must be finite or not given")


class SplatField:
    """Gaussians with metadata, ready to render.

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
    ) -> None:
        self.gaussians = gaussians
        self.metadata = metadata if metadata is not None else FieldMetadata()
        self._isa = check_backend(threads, isa)
        self._threads = threads

    @cached_property
    def field_id(self) -> str:
        """SHA-256 of the field's archive, in hex."""
        return hashlib.sha256(encode_field(self)).hexdigest()

    @cached_property
    def bounds(self) -> Bounds:
        """The box around the means."""
        return Bounds.around(self.gaussians)

    @cached_property
    def rasterizer(self) -> Rasterizer:
        """The renderer of this field, made when it is first needed."""
        return Rasterizer(self.gaussians, threads=self._threads, isa=self._isa)

    def render_colour(self, camera: Camera) -> NDArray[np.float32]:
        """Render colour alone, float32 [H, W, 3]: the bytes of ``render``, sooner."""
        return self.rasterizer.render_colour(camera)

    def render(self, camera: Camera) -> View:
        """Render colour, depth and opacity as ``camera`` sees them."""
        return self.rasterizer.render(camera)


def encode_field(splats: SplatField) -> bytes:
    """Return the bytes of the field's archive; equal fields give equal bytes."""
    arrays = {f.name: getattr(splats.gaussians, f.name) for f in fields(splats.gaussians)}
    metadata = asdict(splats.metadata)
    del metadata["kind"]
    return encode_archive(Archive(KIND, metadata, arrays))


def decode_field(
    data: bytes, source: str = "field", *, threads: int = 1, isa: str | None = None
) -> SplatField:
    """Return the field of an archive; raise ``FieldFormatError`` naming ``source`` if damaged."""
    archive = decode_archive(data, source)
    if archive.kind != KIND:
        raise FieldFormatError(f"{source}: holds a field of kind '{archive.kind}', not '{KIND}'")
    if set(archive.arrays) != {f.name for f in fields(Gaussians)}:
        raise FieldFormatError(f"{source}: arrays {', '.join(archive.arrays)} are not splats")
    try:
        gaussians = Gaussians(**archive.arrays)
        splats = SplatField(gaussians, _metadata(archive.metadata), threads=threads, isa=isa)
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise FieldFormatError(f"{source}: {error}") from error
    splats.field_id = hashlib.sha256(data).hexdigest()
    return splats


def load_field(path: Path, *, threads: int = 1, isa: str | None = None) -> SplatField:
    """Read a field archive; raise ``FieldFormatError`` naming the file and what is wrong."""
    return decode_field(read_file(path), str(path), threads=threads, isa=isa)


def save_field(splats: SplatField, path: Path) -> str:
    """Write a field's archive, whole or not at all, and return the field's id."""
    data = encode_field(splats)
    write_whole(path, data)
    return hashlib.sha256(data).hexdigest()


def _metadata(stored: Mapping[str, Any]) -> FieldMetadata:
    """Build metadata from an archive's; the types of its values are checked."""
    for key in ("name", "training_digest"):
        if not isinstance(stored[key], str):
            raise InvalidInput(f"field.{key}", f"{stored[key]!r} is not text")
    db = stored["held_out_psnr_db"]
    if db is not None and not isinstance(db, int | float):
        raise InvalidInput("field.held_out_psnr_db", f"{db!r} is not a number")
    origin = TileOrigin(**{axis: float(v) for axis, v in stored["tile_origin"].items()})
    return FieldMetadata(stored["name"], origin, stored["training_digest"], db)
