"""How much is kept of what a server records: by bytes and by age, the oldest part first.

A part is one folder ROOT/<vehicle>/<camera>/<start>-<session>, all of one recording file; ``start``
is when it was begun, milliseconds of the Unix epoch. A part is closed early enough that whole parts
can be deleted to keep both bounds; a part that is still written is deleted, too, when it must be.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

__all__ = ["KeepLimits", "RecordingRoom"]

PARTS = 16
"""Parts are closed at this fraction of either bound, so that at least so many fill it."""


@dataclass(frozen=True)
class KeepLimits:
    """What a recording may take: bytes of all files, and seconds since a picture was written."""

    max_bytes: int
    max_age_s: float


class RecordingRoom:
    """Counts the bytes of every part under ``root``, also those of earlier runs, and deletes.

    Used by one thread. What is in the folder and no part is neither counted nor deleted.
    """

    def __init__(self, root: Path, limits: KeepLimits) -> None:
        self._root = root
        self._limits = limits
        self._begun_ms = 0
        self._bytes: dict[Path, int] = {part: _bytes_of(part) for part in _parts(root)}

    def begin(self, vehicle_id: str, camera_id: str, session_id: str, now_ms: int) -> Path:
        """Make the folder of a new part; no two of this run have the same start."""
        self._begun_ms = max(now_ms, self._begun_ms + 1)
        part = self._root / vehicle_id / camera_id / f"{self._begun_ms:013}-{session_id}"
        part.mkdir(parents=True)
        self._bytes[part] = 0
        return part

    def is_full(self, part: Path, now_ms: int) -> bool:
        """Tell whether a part has its share of the bytes or of the time, or was deleted."""
        size_bytes = self._bytes.get(part)
        if size_bytes is None or size_bytes >= self._limits.max_bytes / PARTS:
            return True
        return now_ms - _start_ms(part) >= 1e3 * self._limits.max_age_s / PARTS

    def make(self, wanted_bytes: int, now_ms: int) -> None:
        """Delete the oldest parts until ``wanted_bytes`` more fit and none is too old.

        Raises ``OSError`` where one cannot be.
        """
        parts = sorted(self._bytes, key=_start_ms)
        total_bytes = sum(self._bytes.values()) + wanted_bytes
        oldest_ms = now_ms - 1e3 * self._limits.max_age_s
        for part in parts:
            if total_bytes <= self._limits.max_bytes and _start_ms(part) > oldest_ms:
                break
            shutil.rmtree(part)
            total_bytes -= self._bytes.pop(part)

    def add(self, part: Path, written_bytes: int) -> None:
        """Count what was written to a part."""
        self._bytes[part] += written_bytes


def _parts(root: Path) -> list[Path]:
    return [path for path in root.glob("*/*/*-*") if path.is_dir() and _is_start(path)]


def _is_start(part: Path) -> bool:
    start = part.name.partition("-")[0]
    return len(start) >= 13 and start.isascii() and start.isdigit()


def _start_ms(part: Path) -> int:
    return int(part.name.partition("-")[0])


def _bytes_of(part: Path) -> int:
    return sum(path.stat().st_size for path in part.iterdir() if path.is_file())
