"""Files and folders that appear whole or not at all.

The content goes to ``NAME.part`` beside the file, which is renamed over it at the end; when writing
fails the part is removed and what stood there before is untouched. A folder is not replaced: it
must not exist before.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from rfcore.errors import InvalidInput

__all__ = ["whole_file", "whole_folder", "write_whole"]


@contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """Open a file for writing that replaces ``path`` when the block ends. Raises ``OSError``."""
    partial = path.with_name(path.name + ".part")
    try:
        with partial.open("wb") as file:
            yield file
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


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
        partial.replace(path)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
