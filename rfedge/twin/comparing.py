"""Which comparison is made next: one at a time, on one thread, newest pictures first.

Cameras that somebody looks at in full take turns with all others, so that disagreement is marked
everywhere, sooner where somebody looks.
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Executor

import structlog

from rfcore.errors import RfedgeError
from rfedge.twin.comparison import compared
from rfedge.twin.scene import CameraKey, SeenPicture, TwinScene

__all__ = ["Comparer"]

log = structlog.get_logger()

UNWATCHED_EVERY_S = 1.0
"""How often a picture of a camera is compared that nobody looks at in full."""
IDLE_S = 0.05


class Comparer:
    """Compares newest pictures with renders. ``select`` and ``release`` say who looks at what."""

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
        """Note that one more browser looks at ``key``."""
        self._watched[key] += 1

    def release(self, key: CameraKey) -> None:
        """Note that one browser looks no more."""
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

    def due(self, now_s: float) -> SeenPicture | None:
        """Return the picture to compare now: of those due, the camera that waits longest."""
        newest = self._scene.newest
        for gone in self._done.keys() - newest.keys():
            del self._done[gone]
        waiting = [key for key, picture in newest.items() if self._is_due(key, picture, now_s)]
        if not waiting:
            return None
        return newest[min(waiting, key=lambda key: self._done.get(key, (0, -1.0))[1])]

    def began(self, picture: SeenPicture, now_s: float) -> None:
        """Note that ``picture`` is being compared."""
        self._done[picture.key] = (picture.sequence, now_s)

    def _is_due(self, key: CameraKey, picture: SeenPicture, now_s: float) -> bool:
        if picture.pose is None or self._scene.field(picture.field_id) is None:
            return False
        sequence, at_s = self._done.get(key, (None, -UNWATCHED_EVERY_S))
        if sequence == picture.sequence:
            return False
        return bool(self._watched[key]) or now_s - at_s >= UNWATCHED_EVERY_S
