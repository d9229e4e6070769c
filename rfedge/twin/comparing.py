"""A camera's picture beside the field's render at its pose.

The page renders by itself, with the fields that it shows: a server would have to be asked for each
render, and a drive or several servers over NATS have none to ask. One comparison is made at a
time, on one thread, newest pictures first. Cameras that somebody looks at in full take turns with
all others, which are compared once a second.
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import numpy as np
import structlog
from numpy.typing import NDArray

from rfcore.camera import Camera, Pose
from rfcore.errors import RfedgeError
from rfcore.field import RadianceField
from rfcore.image import Rgb, jpeg_bytes
from rfcore.metrics import psnr
from rfcore.perception.objects import CameraKey
from rfcore.wire.twin import TwinPicture
from rfedge.twin.scene import TwinScene

GAIN = 2
"""Factor by which differences are amplified, around mid-grey."""


@dataclass(frozen=True)
class Comparison:
    """The ``header`` for the page, and its ``parts``: render and difference as JPEG."""

    header: Mapping[str, Any]
    parts: tuple[bytes, bytes]


def compared(picture: TwinPicture, world_from_cam: Pose, field: RadianceField) -> Comparison:
    """Render ``field`` at the pose of ``picture`` and compare; takes a render and 20 ms.

    Raises ``DatasetError`` for a JPEG that cannot be decoded, ``InvalidInput`` for one of another
    size than its intrinsics.
    """
    shown = picture.rgb
    view = field.render(Camera(picture.intrinsics, world_from_cam))
    render = np.round(np.clip(view.colour, 0, 1) * 255).astype(np.uint8)
    difference = shown.astype(np.float32) - render.astype(np.float32)
    header = {"psnr_db": _finite(psnr(shown, render))}
    return Comparison(header, (jpeg_bytes(render), jpeg_bytes(_visible(difference))))


def _visible(difference: NDArray[np.float32]) -> Rgb:
    return np.clip(np.round(128 + GAIN * difference), 0, 255).astype(np.uint8)


def _finite(psnr_db: float) -> float | None:
    return psnr_db if np.isfinite(psnr_db) else None


log = structlog.get_logger()

UNWATCHED_EVERY_S = 1.0
"""Period at which the picture of a camera that nobody views in full is compared."""
IDLE_S = 0.05


class Comparer:
    """Compares the newest pictures with renders, first those of cameras viewed in full."""

    def __init__(
        self,
        scene: TwinScene,
        executor: Executor,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._scene = scene
        self._executor = executor
        self._clock = clock
        self._watched: Counter[CameraKey] = Counter()
        self._done: dict[CameraKey, tuple[int, float]] = {}

    def select(self, key: CameraKey) -> None:
        """Note that one more browser views ``key`` in full."""
        self._watched[key] += 1

    def release(self, key: CameraKey) -> None:
        """Note that one browser left the full view of ``key``."""
        self._watched -= Counter({key: 1})

    async def run(self) -> None:
        """Compare until cancelled."""
        loop = asyncio.get_running_loop()
        while True:
            picture = self.due(self._clock())
            placed = self._scene.field(picture.field_id) if picture is not None else None
            if picture is None or placed is None or picture.pose is None:
                await asyncio.sleep(IDLE_S)
                continue
            self.began(picture, self._clock())
            try:
                made = await loop.run_in_executor(
                    self._executor, compared, picture, picture.pose, placed.field
                )
            except RfedgeError as error:
                log.warning("picture cannot be compared", problem=str(error))
                continue
            if picture.key in self._scene.newest:
                self._scene.compare(picture, made.header, made.parts, self._clock())

    def due(self, now_s: float) -> TwinPicture | None:
        """Return the picture to compare now: of those due, the camera that waits longest."""
        newest = self._scene.newest
        for gone in self._done.keys() - newest.keys():
            del self._done[gone]
        waiting = [key for key, picture in newest.items() if self._is_due(key, picture, now_s)]
        if not waiting:
            return None
        return newest[min(waiting, key=lambda key: self._done.get(key, (0, -1.0))[1])]

    def began(self, picture: TwinPicture, now_s: float) -> None:
        """Note that ``picture`` is being compared."""
        self._done[picture.key] = (picture.sequence, now_s)

    def _is_due(self, key: CameraKey, picture: TwinPicture, now_s: float) -> bool:
        if picture.pose is None or self._scene.field(picture.field_id) is None:
            return False
        sequence, at_s = self._done.get(key, (None, -UNWATCHED_EVERY_S))
        if sequence == picture.sequence:
            return False
        return bool(self._watched[key]) or now_s - at_s >= UNWATCHED_EVERY_S
