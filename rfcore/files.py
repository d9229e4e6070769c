"""Files that appear whole or not at all.

The content goes to ``NAME.part`` beside the file, which is renamed over it at the end; when writing
fails the part is removed and what stood there before is untouched.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

__all__ = ["whole_file", "write_whole"]


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
