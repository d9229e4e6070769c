"""Finished pieces of an evaluation on disk, so that a stopped run goes on where it was.

A cell is one clip coded by one method at one operating point. Its key names everything the result
depends on: digests of inputs, the method with the options its encoder runs with, the program. Its
file is named by the digest of the key and holds key and result. Files appear whole or not at all
and are never changed; only processor times are forgotten and taken again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from rfcore.errors import InvalidData, InvalidInput
from rfcore.files import write_whole
from rfedge.evaluate.clips import Clip, ClipCoder, CodedClip

__all__ = [
    "CellKey",
    "CellStore",
    "Rows",
    "check_processes",
    "clip_key",
    "each_done",
    "program_version",
]

Item = TypeVar("Item")
Done = TypeVar("Done")
CellKey = Mapping[str, str | float | int | None]
Rows = list[dict[str, Any]]
CHECKOUT = Path(__file__).parents[2]
PROGRAM = ("rfcore", "rfedge/evaluate", "rfedge/offline.py")
"""What decides about a cell, in the folder that the packages lie in."""


def clip_key(clip: Clip, coder: ClipCoder, point: float) -> CellKey:
    """Name the cell of ``clip`` coded by ``coder`` at ``point``."""
    return {
        "scene": clip.scene,
        "hz": clip.rate_hz,
        "frames": clip.frames_digest,
        "method": coder.name,
        "point": point,
        "version": coder.version,
    }


@cache
def program_version(root: Path = CHECKOUT) -> str:
    """Return the digest of the modules and kernels that make a cell.

    A revision would do only in a clean checkout: one with changes keeps its name when they change.
    """
    total = hashlib.sha256()
    for path in sorted(_program_files(root)):
        content = hashlib.sha256(path.read_bytes()).hexdigest()
        total.update(f"{path.relative_to(root)} {content}\n".encode())
    return f"program {total.hexdigest()[:16]}"


def _program_files(root: Path) -> Iterator[Path]:
    for name in PROGRAM:
        path = root / name
        yield from (
            (path,)
            if path.is_file()
            else (found for pattern in ("*.py", "*.so") for found in path.rglob(pattern))
        )


@dataclass(frozen=True)
class CellStore:
    """A folder of cells; made when the first one is written."""

    folder: Path

    def clip(self, key: CellKey, make: Callable[[], CodedClip]) -> CodedClip:
        """Return the clip of ``key``, from the folder or by ``make``, which is then kept.

        Raises ``InvalidData`` naming the file if a stored cell is damaged.
        """
        path = self.path(key)
        if path.exists():
            return _clip_of(path, _stored(path, key))
        clip = make()
        self._keep(key, _fields(clip))
        return clip

    def rows(self, key: CellKey, make: Callable[[], Rows]) -> Rows:
        """Return the rows of ``key``, from the folder or by ``make``; raises as ``clip``."""
        path = self.path(key)
        if path.exists():
            stored = _stored(path, key)
            if not isinstance(stored, list):
                raise _damaged(path, "it holds no rows")
            return stored
        rows = make()
        self._keep(key, rows)
        return rows

    def _keep(self, key: CellKey, result: object) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        content = json.dumps({"key": dict(key), "result": result}, indent=1)
        write_whole(self.path(key), content + "\n")

    def forget(self, key: CellKey) -> None:
        """Remove the cell of ``key``, if there is one: for what the machine disturbed."""
        self.path(key).unlink(missing_ok=True)

    def has(self, key: CellKey) -> bool:
        """Tell whether the cell is there already."""
        return self.path(key).exists()

    def path(self, key: CellKey) -> Path:
        """Return the file that holds, or would hold, the cell of ``key``."""
        canonical = json.dumps(dict(key), sort_keys=True, allow_nan=False)
        return self.folder / f"{hashlib.sha256(canonical.encode()).hexdigest()[:32]}.json"


def check_processes(processes: int) -> None:
    """Raise ``InvalidInput`` for a number that ``each_done`` does not start."""
    if not 1 <= processes <= 256:
        raise InvalidInput("processes", f"{processes} is outside 1..256")


def each_done(do: Callable[[Item], Done], items: Sequence[Item], processes: int) -> Iterator[Done]:
    """Yield what ``do`` returns for every item, in their order, done in so many processes.

    One is this process. Others get ``do`` and the items pickled: cells are what they share.
    """
    if processes == 1:
        yield from map(do, items)
        return
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        yield from pool.map(do, items)


def _fields(clip: CodedClip) -> dict[str, Any]:
    return {
        "point": clip.point,
        "frame_bytes": clip.frame_bytes.tolist(),
        "luma_mse": clip.luma_mse.tolist(),
        "ssim": clip.ssim.tolist(),
        "cpu_ms": clip.cpu_ms,
        "notes": {name: list(values) for name, values in clip.notes.items()},
        "receiver_cpu_ms": clip.receiver_cpu_ms,
    }


def _stored(path: Path, key: CellKey) -> Any:
    try:
        stored = json.loads(path.read_text())
        if stored["key"] != dict(key):
            raise ValueError("it was made for another key")
        return stored["result"]
    except (ValueError, KeyError, TypeError) as error:
        raise _damaged(path, error) from error


def _clip_of(path: Path, clip: Any) -> CodedClip:
    try:
        return CodedClip(
            clip["point"],
            np.array(clip["frame_bytes"], np.int64),
            np.array(clip["luma_mse"], np.float64),
            np.array(clip["ssim"], np.float64),
            clip["cpu_ms"],
            {name: tuple(values) for name, values in clip["notes"].items()},
            clip.get("receiver_cpu_ms"),
        )
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise _damaged(path, error) from error


def _damaged(path: Path, why: object) -> InvalidData:
    return InvalidData(f"{path}: not a finished cell ({why}); delete it to redo it")
