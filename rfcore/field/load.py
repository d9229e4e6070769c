"""Field files of every kind: bytes in, a field that renders out, and back.

``READERS`` is the one place that knows which kinds there are.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from rfcore.errors import FieldFormatError, InvalidInput
from rfcore.field.archive import Archive, decode_archive, encode_archive, read_file
from rfcore.field.interface import NGP, SPLATS, FieldMetadata, RadianceField
from rfcore.field.metadata import bounds_of_header, metadata_of_header
from rfcore.field.ngp import NgpField
from rfcore.field.ngp_archive import ngp_of_archive
from rfcore.field.splat_archive import splats_of_archive
from rfcore.field.splats import SplatField
from rfcore.files import write_whole

__all__ = ["READERS", "FieldFile", "decode_field", "encode_field", "load_field", "save_field"]


@dataclass(frozen=True)
class FieldFile:
    """A checked archive, and how the field in it is to render."""

    archive: Archive
    metadata: FieldMetadata
    field_id: str
    threads: int
    isa: str | None


def _splats(file: FieldFile) -> RadianceField:
    gaussians, rungs = splats_of_archive(file.archive)
    field = SplatField(
        gaussians,
        file.metadata,
        rungs=rungs,
        threads=file.threads,
        isa=file.isa,
        archive=file.archive,
    )
    field.field_id = file.field_id
    stated = bounds_of_header(file.archive.metadata)
    if stated is not None and stated != field.bounds:
        raise InvalidInput("field.bounds", f"{stated} are not those of the means, {field.bounds}")
    return field


def _ngp(file: FieldFile) -> RadianceField:
    numbers = ngp_of_archive(file.archive)
    field = NgpField(numbers, file.metadata, threads=file.threads, isa=file.isa)
    field.field_id = file.field_id
    stated = bounds_of_header(file.archive.metadata)
    if stated != field.bounds:
        raise InvalidInput("field.bounds", f"{stated} are not those of the grid, {field.bounds}")
    return field


READERS: Mapping[str, Callable[[FieldFile], RadianceField]] = {SPLATS: _splats, NGP: _ngp}
"""Makes the field of a file, by its archive's kind."""


def encode_field(field: RadianceField) -> bytes:
    """Return the bytes of the field's archive; equal fields give equal bytes."""
    return encode_archive(field.archive())


def decode_field(
    data: bytes, source: str = "field", *, threads: int = 1, isa: str | None = None
) -> RadianceField:
    """Return the field of an archive; raise ``FieldFormatError`` naming ``source`` if damaged."""
    archive = decode_archive(data, source)
    if archive.kind not in READERS:
        known = ", ".join(READERS)
        raise FieldFormatError(f"{source}: holds a field of kind '{archive.kind}', not {known}")
    try:
        metadata = metadata_of_header(archive.kind, archive.metadata)
        field_id = hashlib.sha256(data).hexdigest()
        return READERS[archive.kind](FieldFile(archive, metadata, field_id, threads, isa))
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise FieldFormatError(f"{source}: {error}") from error


def load_field(path: Path, *, threads: int = 1, isa: str | None = None) -> RadianceField:
    """Read a field archive; raise ``FieldFormatError`` naming the file and what is wrong."""
    return decode_field(read_file(path), str(path), threads=threads, isa=isa)


def save_field(field: RadianceField, path: Path) -> str:
    """Write a field's archive, whole or not at all, and return the field's id.

    A field that was loaded is written as it was; ``SplatField.compressed`` makes the small form.
    """
    data = encode_field(field)
    write_whole(path, data)
    return hashlib.sha256(data).hexdigest()
