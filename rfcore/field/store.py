"""A directory of field archives, addressed by field id.

A file named ``<field id>.rff`` is listed by its name; any other ``.rff`` file by its SHA-256, so
that ``street.rff`` may simply be put there. Contents are checked when a field is added or loaded.
"""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

from rfcore.errors import FieldFormatError, UnknownField
from rfcore.field.archive import read_file
from rfcore.field.interface import RadianceField
from rfcore.field.load import decode_field
from rfcore.files import write_whole

__all__ = ["FieldStore"]

SUFFIX = ".rff"
FIELD_ID = re.compile(r"[0-9a-f]{64}")
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
