"""Field files of every kind, and a directory of them addressed by field id.

``decode_field`` makes a field that renders out of an archive's bytes, ``encode_field`` the reverse;
``READERS`` is the one place that knows which kinds of field there are.

In a directory (``FieldStore``) a file named ``<field id>.rff`` is listed by its name, any other
``.rff`` file by its SHA-256, so that ``street.rff`` may simply be put there. Contents are checked
when a field is added or loaded.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from rfcore.errors import FieldFormatError, InvalidInput, UnknownField
from rfcore.field.archive import Archive, decode_archive, encode_archive, read_file
from rfcore.field.interface import (
    NGP,
    SPLATS,
    FieldMetadata,
    RadianceField,
    bounds_of_header,
    metadata_of_header,
)
from rfcore.field.ngp import NgpField, ngp_of_archive
from rfcore.field.splat_archive import splats_of_archive
from rfcore.field.splats import SplatField
from rfcore.files import write_whole

__all__ = [
    "FIELD_ID",
    "READERS",
    "FieldFile",
    "FieldStore",
    "decode_field",
    "encode_field",
    "load_field",
    "save_field",
]


@dataclass(frozen=True)
class FieldFile:
    """A checked archive, and how the field in it is to render."""

    archive: Archive
    metadata: FieldMetadata
    field_id: str
    threads: int
    isa: str | None


def _splats(file: FieldFile) -> RadianceField:
    gaussians, levels = splats_of_archive(file.archive)
    field = SplatField(
        gaussians,
        file.metadata,
        levels=levels,
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


SUFFIX = ".rff"
FIELD_ID = re.compile(r"[0-9a-f]{64}")
"""What a field id looks like: the hexadecimal digits of a SHA-256."""
Stamp = tuple[Path, int, int]


class FieldStore:
    """The fields of one directory, which is made if it is not there. Safe to share by processes."""

    def __init__(self, directory: Path) -> None:
        directory.mkdir(parents=True, exist_ok=True)
        self._directory = directory
        self._hashed: dict[Stamp, str] = {}

    def ids(self) -> tuple[str, ...]:
        """Return the ids of the fields that are here, sorted."""
        return tuple(sorted(self._files()))

    def path(self, field_id: str) -> Path:
        """Return the file of a field; raise ``UnknownField`` naming it and what is here."""
        files = self._files()
        if field_id not in files:
            here = ", ".join(sorted(files)) or "nothing"
            raise UnknownField(f"field {field_id!r} is not in {self._directory}; it holds {here}")
        return files[field_id]

    def load(self, field_id: str, *, threads: int = 1, isa: str | None = None) -> RadianceField:
        """Load a field; raise ``UnknownField``, or ``FieldFormatError`` if it is damaged."""
        path = self.path(field_id)
        data = read_file(path)
        _checked_id(data, field_id, str(path))
        return decode_field(data, str(path), threads=threads, isa=isa)

    def add(self, source: bytes | Path, field_id: str | None = None) -> str:
        """Add an archive and return its id; the file appears whole or not at all.

        When ``field_id`` is given the SHA-256 is compared before anything is parsed. Raises
        ``FieldFormatError`` and leaves the store as it was when the archive is not whole.
        """
        data = read_file(source) if isinstance(source, Path) else source
        name = str(source) if isinstance(source, Path) else "field"
        found = _checked_id(data, field_id, name)
        decode_field(data, name)
        write_whole(self._directory / f"{found}{SUFFIX}", data)
        return found

    def _files(self) -> dict[str, Path]:
        return {self._id_of(path): path for path in sorted(self._directory.glob(f"*{SUFFIX}"))}

    def _id_of(self, path: Path) -> str:
        if FIELD_ID.fullmatch(path.stem):
            return path.stem
        stat = path.stat()
        stamp = (path, stat.st_mtime_ns, stat.st_size)
        if stamp not in self._hashed:
            self._hashed[stamp] = hashlib.sha256(read_file(path)).hexdigest()
        return self._hashed[stamp]


def _checked_id(data: bytes, expected: str | None, source: str) -> str:
    found = hashlib.sha256(data).hexdigest()
    if expected not in (None, found):
        raise FieldFormatError(f"{source}: its sha256 is {found}, not the field id {expected}")
    return found
