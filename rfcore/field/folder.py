"""Which field archives lie in a folder: regular files ``*.rff``, by the SHA-256 of their content.

A file named ``<field id>.rff`` is listed by its name, any other by its digest. Each is looked at
again only when its time, size or inode changes. What cannot be an archive (a folder, a pipe, a link
to nowhere, a file without the archive's first bytes, too large, or of another length than its
header says) is skipped and named, and hangs or fails nobody. Contents are checked when a field is
loaded.
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

__all__ = ["FIELD_ID", "MAX_ARCHIVE_BYTES", "SUFFIX", "FieldFolder", "FolderListing"]

SUFFIX = ".rff"
FIELD_ID = re.compile(r"[0-9a-f]{64}")
"""What a field id looks like: the hexadecimal digits of a SHA-256."""

MAX_ARCHIVE_BYTES = 4 << 30
"""Longest archive that is listed; vehicles take no longer one."""

Stamp = tuple[int, int, int]


@dataclass(frozen=True)
class FolderListing:
    """``paths`` of the archives by field id, and why other entries were ``skipped``."""

    paths: Mapping[str, Path]
    skipped: Mapping[Path, str]


@dataclass(frozen=True)
class _Entry:
    """What is known of a file with this stamp: its field id, or why it is skipped."""

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
        """Return what is there now.

        ``settled``: leave files out until two looks have found them the same, for one that is
        being copied has a digest nobody wants.
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
        """Return what is known of a file; None while it is not settled."""
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
