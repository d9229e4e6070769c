"""The camera that both sides have: a drive's pictures there and back, for as long as it runs.

Picture ``number`` is the drive's picture ``there_and_back(count)[number % len(...)]``. A drive that
began again at its end would have a cut, which costs a coder that knows no street a key frame.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rfcore.image import I420


def there_and_back(count: int) -> list[int]:
    """Return the indices of ``count`` pictures, forward and then backward, without cuts."""
    return [*range(count), *range(count - 2, 0, -1)]


@dataclass(frozen=True)
class CameraPictures:
    """The pictures of a drive, all of one size, as planes."""

    pictures: Sequence[I420]

    @property
    def cycle(self) -> list[int]:
        """The indices of the pictures that the camera shows before it begins again."""
        return there_and_back(len(self.pictures))

    def at(self, number: int) -> I420:
        """Return picture ``number`` of the camera."""
        cycle = self.cycle
        return self.pictures[cycle[number % len(cycle)]]

    def write(self, path: Path) -> None:
        """Write the pictures for another process."""
        size_px = np.array(self.pictures[0].size_px)
        packed = [np.frombuffer(picture.packed(), np.uint8) for picture in self.pictures]
        np.savez(path, size_px=size_px, packed=np.stack(packed))

    @staticmethod
    def read(path: Path) -> CameraPictures:
        """Read what ``write`` wrote."""
        with np.load(path) as held:
            width, height = held["size_px"].tolist()
            packed: NDArray[np.uint8] = held["packed"]
        return CameraPictures([I420.unpacked((width, height), one.tobytes()) for one in packed])


@dataclass(frozen=True)
class Capture:
    """Picture ``number`` of the camera, and when it was captured."""

    number: int
    time_ns: int
    picture: I420


async def captured(camera: CameraPictures, hz: float) -> AsyncIterator[Capture]:
    """Yield pictures at ``hz`` for ever; a consumer that is slow misses those in between."""
    began_s, number = time.monotonic(), 0
    while True:
        await asyncio.sleep(max(0.0, began_s + number / hz - time.monotonic()))
        yield Capture(number, time.time_ns(), camera.at(number))
        number = max(number + 1, int((time.monotonic() - began_s) * hz))
