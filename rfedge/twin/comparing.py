"""A camera's picture beside the field's render at its pose, and where the two disagree.

One comparison is made at a time, on one thread, newest pictures first. Cameras that somebody looks
at in full take turns with all others, so that disagreement is marked everywhere, sooner where
somebody looks.

A mark of disagreement stands for something that is not in the field, or no longer: blocks of
``BLOCK_PX`` whose mean luma differs by more than ``DISAGREEMENT`` levels are grouped, and the
largest group is placed in the street by the render's depth at its lower edge, where an object
touches the ground.
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
from rfcore.image import Rgb, jpeg_bytes, rgb_from_bytes
from rfcore.metrics import psnr
from rfedge.twin.scene import CameraKey, SeenPicture, TwinScene

__all__ = ["Comparer", "Comparison", "compared", "largest_disagreement"]

BLOCK_PX = 16
DISAGREEMENT = 24.0
"""Levels of 255: above what light and noise leave in a block's mean on the sample street, below the
difference between a street and a car."""
SMALLEST_BLOCKS = 3
"""Blocks that a group must have to be marked."""
GAIN = 2
"""By which differences are shown, around mid-grey."""
LUMA = np.array([0.2126, 0.7152, 0.0722], np.float32)

F32 = NDArray[np.float32]


@dataclass(frozen=True)
class Comparison:
    """``header`` for the page; ``parts``: render and difference as JPEG."""

    header: Mapping[str, Any]
    parts: tuple[bytes, bytes]


def compared(picture: SeenPicture, world_from_cam: Pose, field: RadianceField) -> Comparison:
    """Render ``field`` at the pose of ``picture`` and compare; takes a render and 20 ms.

    Raises ``DatasetError`` for a JPEG that cannot be decoded, ``InvalidInput`` for one that is not
    of the size its intrinsics say.
    """
    shown = rgb_from_bytes(picture.jpeg, "/".join(picture.key))
    camera = Camera(picture.intrinsics, world_from_cam)
    view = field.render(camera)
    render = np.round(np.clip(view.colour, 0, 1) * 255).astype(np.uint8)
    header: dict[str, Any] = {"psnr_db": _finite(psnr(shown, render)), "mark": None}
    difference = shown.astype(np.float32) - render.astype(np.float32)
    blocks = largest_disagreement(difference @ LUMA)
    if blocks is not None:
        header["mark"] = _mark(blocks, view.depth, camera)
    return Comparison(header, (jpeg_bytes(render), jpeg_bytes(_visible(difference))))


def largest_disagreement(luma_difference: F32) -> NDArray[np.bool_] | None:
    """Return which blocks [rows, columns] the largest group of disagreeing ones has, if any.

    ``luma_difference`` [H, W] in levels of 255; blocks at the right and lower edge that are not
    whole are left out. Groups are joined over edges, not corners.
    """
    rows, columns = (side // BLOCK_PX for side in luma_difference.shape)
    whole = luma_difference[: rows * BLOCK_PX, : columns * BLOCK_PX]
    means = whole.reshape(rows, BLOCK_PX, columns, BLOCK_PX).mean(axis=(1, 3))
    labels = _groups(np.abs(means) > DISAGREEMENT)
    sizes = np.bincount(labels.ravel(), minlength=2)
    sizes[0] = 0
    largest = int(sizes.argmax())
    return labels == largest if sizes[largest] >= SMALLEST_BLOCKS else None


def _groups(chosen: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return labels [rows, columns], 0 where not chosen: each spreads until it meets a larger."""
    labels = np.where(chosen, np.arange(1, chosen.size + 1).reshape(chosen.shape), 0)
    while True:
        padded = np.pad(labels, 1)
        neighbours = (padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:])
        spread = np.where(chosen, np.maximum.reduce([labels, *neighbours]), 0)
        if np.array_equal(spread, labels):
            return labels
        labels = spread


def _mark(blocks: NDArray[np.bool_], depth_m: F32, camera: Camera) -> dict[str, Any] | None:
    """Return where the lower edge of ``blocks`` lies, tile-relative; None where nothing was hit."""
    rows, columns = np.nonzero(blocks)
    u_px = (float(columns.mean()) + 0.5) * BLOCK_PX
    v_px = min((int(rows.max()) + 1) * BLOCK_PX, depth_m.shape[0]) - 0.5
    z_m = float(depth_m[int(v_px), int(u_px)])
    if not z_m > 0:
        return None
    k = camera.intrinsics
    point = ((u_px - k.cx_px) / k.fx_px * z_m, (v_px - k.cy_px) / k.fy_px * z_m, z_m)
    width_m = (int(columns.max()) - int(columns.min()) + 1) * BLOCK_PX / k.fx_px * z_m
    position_m = camera.world_from_cam.apply(point)
    return {"position_m": position_m, "width_m": width_m, "blocks": int(blocks.sum())}


def _visible(difference: F32) -> Rgb:
    return np.clip(np.round(128 + GAIN * difference), 0, 255).astype(np.uint8)


def _finite(psnr_db: float) -> float | None:
    return psnr_db if np.isfinite(psnr_db) else None


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
