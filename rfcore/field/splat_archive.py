"""Splats as the content of an archive.

Raw float32 arrays by the names of ``Gaussians``; what a lower rung has of its own follows as
``detail_50.log_scales`` and ``detail_50.opacity_logits``, likewise for 25 and 10. Where the header
has an ``encoding``, ``rfcore.field.splat_codec`` says what the arrays are.
"""

from __future__ import annotations

from dataclasses import fields

from rfcore.errors import InvalidInput
from rfcore.field.archive import Archive, Array
from rfcore.field.detail import Rung, Rungs
from rfcore.field.interface import SPLATS, Bounds, FieldMetadata
from rfcore.field.metadata import stored_metadata
from rfcore.field.quality import DETAILS
from rfcore.field.splat_codec import splats_of_compressed
from rfcore.raster.gaussians import Gaussians

__all__ = ["splat_archive", "splats_of_archive"]

NAMES = tuple(f.name for f in fields(Gaussians))
RUNG_NAMES = tuple(f.name for f in fields(Rung))


def splat_archive(gaussians: Gaussians, rungs: Rungs, metadata: FieldMetadata) -> Archive:
    """Return the archive of ``gaussians`` and what their ``rungs`` have of their own."""
    arrays: dict[str, Array] = {name: getattr(gaussians, name) for name in NAMES}
    for detail in DETAILS:
        if detail in rungs:
            own = {_own(detail, name): getattr(rungs[detail], name) for name in RUNG_NAMES}
            arrays.update(own)
    return Archive(SPLATS, stored_metadata(metadata, Bounds.around(gaussians.means)), arrays)


def splats_of_archive(archive: Archive) -> tuple[Gaussians, Rungs]:
    """Return the content of an archive, raw or compressed.

    Raises ``InvalidInput`` if it does not hold splats; see also ``splats_of_compressed``.
    """
    if "encoding" in archive.metadata:
        return splats_of_compressed(archive)
    arrays = dict(archive.arrays)
    rungs = {
        detail: Rung(*(arrays.pop(_own(detail, name)) for name in RUNG_NAMES))
        for detail in DETAILS[1:]
        if all(_own(detail, name) in arrays for name in RUNG_NAMES)
    }
    if set(arrays) != set(NAMES):
        raise InvalidInput("archive", f"arrays {', '.join(archive.arrays)} are not splats")
    return Gaussians(**arrays), rungs


def _own(detail: float, name: str) -> str:
    return f"detail_{round(detail * 100)}.{name}"
