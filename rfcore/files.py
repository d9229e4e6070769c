"""Files and folders that appear whole or not at all.

The content goes to ``NAME.part`` beside the file, which is renamed over it at the end; when writing
fails, the part is removed and what stood there before is untouched. Processes that write the same
file take turns; a part that was left by one that was killed is written anew. A file is on the disk
before it gets its name, and the name before the function returns, so that a power cut leaves the
old file or the new one. A folder is not replaced: it must not exist before.

``open_at_once`` opens what others put into folders, which may be no file but a pipe.

``manifest.json`` lists a directory's files with their SHA-256, so that damage is noticed before
use. It is ``{"sha256": {"train/000.jpg": "<hex>", ...}}`` with paths relative to it;
other keys say how the directory was made and are not read. The directory's ``README.md`` is not
listed: its words may change, and the data stay the same.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shutil
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO

from rfcore.errors import DatasetError, InvalidData, InvalidInput

DECODED_BYTES = 2 << 30
"""Default limit of the memory for a file's decoded content: 9 million splats of SH degree 3."""


def open_at_once(path: Path) -> BufferedReader:
    """Open a file for reading; a pipe that nobody writes to would keep ``open`` waiting for ever.

    Raises ``OSError``.
    """
    return os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb")


def read_regular(path: Path, max_bytes: int) -> bytes:
    """Return a file's bytes; whoever names it may not be trusted.

    Raises ``InvalidData`` for a pipe, folder or device, and for more than ``max_bytes``, and
    ``OSError``.
    """
    with open_at_once(path) as file:
        if not is_regular(file):
            raise InvalidData("is no file, but a pipe, a folder or a device")
        data = file.read(max_bytes + 1)
    if len(data) > max_bytes:
        raise InvalidData(f"more than {max_bytes} bytes; split it")
    return data


def is_regular(file: BinaryIO) -> bool:
    """Return whether an open file is one, and no pipe, folder or device."""
    return stat.S_ISREG(os.fstat(file.fileno()).st_mode)


def open_alone(path: Path) -> BinaryIO:
    """Open a file for reading and writing as it is, new if it is missing, and lock it until it is
    closed.

    Raises ``BlockingIOError`` while another process or thread has it, and ``OSError``.
    """
    return _locked(path, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _locked(path: Path, operation: int) -> BinaryIO:
    while True:
        file = os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666), "r+b")
        try:
            fcntl.flock(file, operation)
            if path.exists() and os.path.samestat(os.fstat(file.fileno()), path.stat()):
                return file
        except BaseException:
            file.close()
            raise
        file.close()  # whoever had it has renamed or removed it by now


@contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """Open a file for writing that replaces ``path`` when the block ends. Raises ``OSError``."""
    partial = path.with_name(path.name + ".part")
    with _locked(partial, fcntl.LOCK_EX) as file:
        try:
            file.truncate()
            yield file
            file.flush()
            os.fsync(file.fileno())
            partial.replace(path)
        except BaseException:
            partial.unlink(missing_ok=True)
            raise
    _sync_folder(path.parent)


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


MANIFEST_NAME = "manifest.json"


def write_manifest(directory: Path, about: Mapping[str, Any] | None = None) -> Path:
    """List the files under ``directory`` with their SHA-256; return the manifest's path.

    ``about`` stands before the list: what made the directory.
    """
    files = sorted(path for path in directory.rglob("*") if path.is_file())
    target = directory / MANIFEST_NAME
    unlisted = (target, directory / "README.md")
    digests = {
        path.relative_to(directory).as_posix(): _sha256(path)
        for path in files
        if path not in unlisted
    }
    write_whole(target, json.dumps({**(about or {}), "sha256": digests}, indent=1) + "\n")
    return target


def verify_manifest(directory: Path) -> None:
    """Raise ``DatasetError`` naming the first file that is missing or not as it was listed."""
    for name, digest in _listed(directory / MANIFEST_NAME).items():
        path = directory / name
        if not path.is_file():
            raise DatasetError(f"{path}: listed in {MANIFEST_NAME} but missing; restore it")
        found = _sha256(path)
        if found != digest:
            raise DatasetError(
                f"{path}: damaged, its sha256 is {found[:16]}... and should be {digest[:16]}...; "
                "restore it"
            )


def _listed(manifest: Path) -> dict[str, str]:
    try:
        digests = json.loads(manifest.read_bytes())["sha256"]
        items = {str(name): str(digest) for name, digest in digests.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DatasetError(f"{manifest}: not a readable manifest ({error!r})") from error
    for name in items:
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
            raise DatasetError(f"{manifest}: '{name}' leaves the directory")
    return items


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
