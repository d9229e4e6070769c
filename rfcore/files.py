"""Files and folders that appear whole or not at all.

The content goes to ``NAME.part`` beside the file, which is renamed over it at the end; when writing
fails, the part is removed and what stood there before is untouched. A file is on the disk before it
gets its name, and the name before the function returns, so that a power cut leaves the old file or
the new one. A folder is not replaced: it must not exist before.

``open_at_once`` opens what others put into folders, which may be no file but a pipe.
"""

from __future__ import annotations

import os
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import BinaryIO

from rfcore.errors import InvalidInput

DECODED_BYTES = 2 << 30
"""Default limit of the memory for a file's decoded content: 9 million splats of SH degree 3."""


def open_at_once(path: Path) -> BufferedReader:
    """Open a file for reading; a pipe that nobody writes to would keep ``open`` waiting for ever.

    Raises ``OSError``.
    """
    return os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb")


def is_regular(file: BinaryIO) -> bool:
    """Return whether an open file is one, and no pipe, folder or device."""
    return stat.S_ISREG(os.fstat(file.fileno()).st_mode)


@contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """Open a file for writing that replaces ``path`` when the block ends. Raises ``OSError``."""
    partial = path.with_name(path.name + ".part")
    try:
        with partial.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
        _sync_folder(path.parent)
    finally:
        partial.unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    """Write the names in ``folder`` to the disk."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _sync_contents(folder: Path) -> None:
    """Write everything in ``folder`` to the disk: files, and the names of what it holds."""
    for path in folder.rglob("*"):
        if path.is_dir():
            _sync_folder(path)
        elif path.is_file():
            with path.open("rb") as file:
                os.fsync(file.fileno())
    _sync_folder(folder)


def write_whole(path: Path, content: bytes | str) -> None:
    """Write ``content`` (text as UTF-8) as one whole file. Raises ``OSError``."""
    with whole_file(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Make a new folder to fill; it becomes ``path`` when the block ends.

    Raises ``InvalidInput`` when ``path`` is there already, ``OSError``.
    """
    if path.exists():
        raise InvalidInput("out", f"{path} exists; remove it or name another folder")
    partial = path.with_name(path.name + ".part")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        yield partial
        _sync_contents(partial)
        partial.replace(path)
        _sync_folder(path.parent)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
