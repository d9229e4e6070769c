"""Splats as the content of an archive: raw float32 arrays by the names of ``Gaussians``."""

from __future__ import annotations

from dataclasses import fields

from rfcore.errors import InvalidInput
from rfcore.field.archive import Archive
from rfcore.field.interface import SPLATS, Bounds, FieldMetadata
from rfcore.field.metadata import stored_metadata
from rfcore.raster.gaussians import Gaussians

__all__ = ["splat_archive", "splats_of_archive"]


def splat_archive(gaussians: Gaussians, metadata: FieldMetadata) -> Archive:
    """Return the archive of ``gaussians``."""
    arrays = {f.name: getattr(gaussians, f.name) for f in fields(gaussians)}
    return Archive(SPLATS, stored_metadata(metadata, Bounds.around(gaussians.means)), arrays)


def splats_of_archive(archive: Archive) -> Gaussians:
    """Return the Gaussians of an archive; raise ``InvalidInput`` if it does not hold any."""
    if set(archive.arrays) != {f.name for f in fields(Gaussians)}:
        raise InvalidInput("archive", f"arrays {', '.join(archive.arrays)} are not splats")
    return Gaussians(**archive.arrays)
