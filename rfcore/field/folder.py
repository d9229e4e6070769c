"""Lists the field archives of a folder: regular files ``*.rff``, by the SHA-256 of their content.

A file named ``<field id>.rff`` is listed by its name, any other by its digest. A file is examined
again only when its time, size or inode changes. Entries that cannot be archives (a folder, a pipe,
a dangling link, a file with other first bytes, too large, or of another length than its header
says) are skipped and reported; they block nothing. Contents are checked when a field is loaded.
"""

from __future__ import annotations

import hashlib
import os
import re
import stat
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from rfcore.errors import FieldFormatError
from rfcore.field.archive import HEAD_BYTES, MAGIC, check_length
from rfcore.files import open_at_once

SUFFIX = ".rff"
FIELD_ID = re.compile(r"[0-9a-f]{64}")
"""A field id: the hexadecimal digits of a SHA-256."""

MAX_ARCHIVE_BYTES = 4 << 30
"""Longest archive that is listed, and that vehicles accept."""

Stamp = tuple[int, int, int]


@dataclass(frozen=True)
class FolderListing:
    """``paths`` of the archives by field id, and the reasons why other entries were ``skipped``."""

    paths: Mapping[str, Path]
    skipped: Mapping[Path, str]


@dataclass(frozen=True)
class _Entry:
    """A file with this stamp has this field id, or is skipped because of ``problem``."""

    stamp: Stamp
    field_id: str = ""
    problem: str = ""


class FieldFolder:
    """The archives of ``directory``. ``look`` reads files: never call it on an event loop."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._known: dict[Path, _Entry] = {}
        self._seen: dict[Path, Stamp] = {}

    def look(self, *, settled: bool = False) -> FolderListing:
        """Return the present archives.

        ``settled``: leave out files that have changed since the last look, because they may still
        be being copied.
        """
        paths: dict[str, Path] = {}
        skipped: dict[Path, str] = {}
        before, self._seen = self._seen, {}
        for path in sorted(self._directory.glob(f"*{SUFFIX}")):
            entry = self._entry(path, before if settled else None)
            if entry is None:
                continue
            if entry.problem:
                skipped[path] = entry.problem
            else:
                paths[entry.field_id] = path
        self._known = {path: self._known[path] for path in self._seen if path in self._known}
        return FolderListing(paths, skipped)

    def _entry(self, path: Path, before: Mapping[Path, Stamp] | None) -> _Entry | None:
        """Return the entry of a file; None while it is not settled."""
        try:
            status = path.stat()
        except OSError as error:
            return _Entry((0, 0, 0), problem=f"cannot be read ({error.strerror})")
        stamp = status.st_mtime_ns, status.st_size, status.st_ino
        self._seen[path] = stamp
        known = self._known.get(path)
        if known is not None and known.stamp == stamp:
            return known
        if before is not None and before.get(path) != stamp:
            return None
        self._known[path] = entry = _examined(path, status, stamp)
        return entry


def _examined(path: Path, status: os.stat_result, stamp: Stamp) -> _Entry:
    if not stat.S_ISREG(status.st_mode):
        return _Entry(stamp, problem="is no regular file")
    if status.st_size > MAX_ARCHIVE_BYTES:
        return _Entry(
            stamp, problem=f"has {status.st_size} bytes, above {MAX_ARCHIVE_BYTES}: not listed"
        )
    try:
        with open_at_once(path) as file:  # a pipe may have been put there since
            if file.read(len(MAGIC)) != MAGIC:
                return _Entry(stamp, problem="is no field archive: its first bytes are others")
            if FIELD_ID.fullmatch(path.stem):
                return _Entry(stamp, path.stem)
            file.seek(0)
            check_length(file.read(HEAD_BYTES), status.st_size)  # before gigabytes are hashed
            file.seek(0)
            return _Entry(stamp, hashlib.file_digest(file, "sha256").hexdigest())
    except FieldFormatError as error:
        return _Entry(stamp, problem=f"is no field archive: {error}")
    except OSError as error:
        return _Entry(stamp, problem=f"cannot be read ({error.strerror})")
