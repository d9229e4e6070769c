"""Find the files that a dataset names, below its folder.

Names may be written for Windows, be absolute, or lack their suffix. One that differs from its
file's in upper and lower case alone finds it, if only one file can be meant.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import takewhile
from pathlib import Path, PurePosixPath
from posixpath import normpath

from rfcore.errors import DatasetError
from rfcore.tables import shortened

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".PNG", ".JPG", ".JPEG", ".WEBP")
"""Suffixes that a name without one may stand for."""
MAX_PART_BYTES = 255
"""Longest file name of Linux file systems."""


def inside(where: str, folder: Path, name: str) -> Path:
    """Return ``folder / name``, where ``name`` may be written for Windows, or absolute.

    An absolute name is of a file in the folder, or in another machine's copy of it: the longest end
    of it that is there is taken. Raises ``DatasetError`` for a name that leaves the folder.
    """
    path = _inside(where, folder, name)
    if path is None:
        raise DatasetError(
            f"{where}: path '{name}' leaves the dataset's folder {folder}, and no end of it is "
            "there; name files relative to that folder"
        )
    return path


def _inside(where: str, folder: Path, name: str) -> Path | None:
    """Return the same, None for an absolute name of which no end is in the folder."""
    path = PurePosixPath(name.replace("\\", "/"))
    if any(len(part.encode()) > MAX_PART_BYTES for part in path.parts):
        raise DatasetError(f"{where}: path {shortened(name)} is too long")
    path = PurePosixPath(normpath(path))
    if ".." in path.parts or "\0" in name:
        raise DatasetError(
            f"{where}: path '{name}' leaves the dataset's folder {folder}; put the file that names "
            "it into a folder above all pictures"
        )
    if not is_absolute(name):
        return folder / path
    ends = (folder.joinpath(*path.parts[i:]) for i in range(1, len(path.parts)))
    return next((end for end in ends if end.exists() or _existing(end) is not None), None)


def is_absolute(name: str) -> bool:
    """Tell whether a name is absolute on Linux or Windows."""
    return name[:1] in ("/", "\\") or name[1:3] in (":/", ":\\")


def find_picture(where: str, folder: Path, name: str) -> Path:
    """Return the file of a picture; raise ``DatasetError`` if it is missing."""
    path = file_inside(where, folder, name)
    if path is None:
        raise DatasetError(f"{where}: picture {inside(where, folder, name)} is missing")
    return path


def file_inside(where: str, folder: Path, name: str) -> Path | None:
    """Return the file or ``None``; a name without suffix may mean any of PNG, JPEG, WebP."""
    path = _inside(where, folder, name)
    return None if path is None or path == folder else _existing(path)


def _existing(path: Path) -> Path | None:
    suffixes = ("",) if path.suffix in SUFFIXES else ("", *SUFFIXES)
    named = [path.with_name(path.name + suffix) for suffix in suffixes]
    found = next((candidate for candidate in named if candidate.is_file()), None)
    if found is not None:
        return found
    others = {other for name in named if (other := _in_other_case(name)) and other.is_file()}
    return others.pop() if len(others) == 1 else None


def _in_other_case(path: Path) -> Path | None:
    """Return what is called so but for upper and lower case, ``None`` unless just one is."""
    if path.exists():
        return path
    if path.parent == path or (folder := _in_other_case(path.parent)) is None:
        return None
    if not folder.is_dir() or (folder / path.name).exists():
        return folder / path.name
    names = _names_by_case(folder, folder.stat().st_mtime_ns).get(path.name.casefold(), [])
    return folder / names[0] if len(names) == 1 else None


@lru_cache(maxsize=16)
def _names_by_case(folder: Path, _: int) -> dict[str, list[str]]:
    """Return a folder's names by what they are in lower case, as of its time of change."""
    names: dict[str, list[str]] = {}
    for path in folder.iterdir():
        names.setdefault(path.name.casefold(), []).append(path.name)
    return names


def differs_in_case(path: Path, name: str) -> bool:
    """Return whether the file that was found for a name has other letters in its path."""
    asked = PurePosixPath(normpath(name.replace("\\", "/"))).parts[::-1]
    pairs = list(zip(asked, path.parts[::-1], strict=False))
    if not pairs[0][1].startswith(pairs[0][0]):
        return True
    same = takewhile(lambda pair: pair[0].casefold() == pair[1].casefold(), pairs[1:])
    return any(a != b for a, b in same)
