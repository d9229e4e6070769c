"""Run a detector (.onnx) by OpenCV on square tiles of a picture.

An ``Adapter`` knows one kind of network: the side of its input, and how its output says boxes. The
tiles overlap by a quarter at least; of boxes of one class that overlap by half or more the surest
is kept. Boxes are (left, top, width, height) in pixels.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidData, InvalidInput
from rfcore.extras import needs
from rfcore.image import Rgb
from rfcore.named_class import make_named

with needs("eval"):
    import cv2

F32 = NDArray[np.float32]
LEAST_SCORE = 0.05
"""Boxes that are less sure than this are left out."""
SAME = 0.5
"""Overlap (intersection over union) from which two boxes are one."""
OVERLAP = 0.25
MOST_BYTES = 300_000_000
NAMES = """
person bicycle car motorcycle airplane bus train truck boat trafficlight hydrant stopsign meter
bench bird cat dog horse sheep cow elephant bear zebra giraffe backpack umbrella handbag tie
suitcase frisbee skis snowboard ball kite bat glove skateboard surfboard racket bottle glass cup
fork knife spoon bowl banana apple sandwich orange broccoli carrot hotdog pizza donut cake chair
couch plant bed table toilet tv laptop mouse remote keyboard phone microwave oven toaster sink
refrigerator book clock vase scissors teddy dryer toothbrush
"""
COCO = tuple(NAMES.split())
"""The 80 classes of COCO, by number."""


@dataclass(frozen=True)
class Box:
    """A box in a picture, what is in it, and how sure the detector is of it."""

    left: float
    top: float
    width: float
    height: float
    class_: str
    score: float = 1.0


class DetectorFailed(InvalidData):
    """A detector that gave nothing usable for a picture."""


class Adapter(Protocol):
    """One kind of network: its input and its output."""

    input_px: int
    """Side of its square input."""
    classes: Sequence[str]
    """Names of its classes, by number."""

    def blob(self, tile: Rgb) -> F32:
        """Return a tile uint8 RGB [side, side, 3] as the network's input."""

    def boxes(self, outputs: Sequence[F32]) -> tuple[F32, F32, NDArray[np.intp]]:
        """Return boxes [N, 4] as (left, top, width, height) in shares of the tile, scores [N] and
        classes [N] by number; raise ``ValueError`` for outputs of another network."""


class FastestDet:
    """FastestDet of dog-qiuqiu, COCO: BGR of 0..1, one output [1, 85, N, N]."""

    input_px = 352
    classes: Sequence[str] = COCO

    def blob(self, tile: Rgb) -> F32:
        """Return the tile in shares of white, blue first."""
        return cast(F32, cv2.dnn.blobFromImage(tile, 1 / 255, swapRB=True))

    def boxes(self, outputs: Sequence[F32]) -> tuple[F32, F32, NDArray[np.intp]]:
        """Return the box of each cell: its class, and offset and size by tanh and sigmoid."""
        wanted = (1, 5 + len(COCO))
        if len(outputs) != 1 or outputs[0].ndim != 4 or outputs[0].shape[:2] != wanted:
            shapes = [output.shape for output in outputs]
            raise ValueError(f"outputs {shapes} are not one of [1, {wanted[1]}, rows, columns]")
        out = outputs[0][0]
        rows, columns = np.indices(out.shape[1:])
        middle = np.stack([columns + np.tanh(out[1]), rows + np.tanh(out[2])])
        middle /= np.array(out.shape[:0:-1])[:, None, None]
        size = 1 / (1 + np.exp(-out[3:5]))
        classes = out[5:].argmax(axis=0)
        scores = out[0] ** 0.6 * out[5:].max(axis=0) ** 0.4
        boxes = np.concatenate([middle - size / 2, size]).reshape(4, -1).T
        return boxes.astype(np.float32), scores.ravel(), classes.ravel()


ADAPTERS = {"fastestdet": FastestDet}


class Detector:
    """A detector of one file. ``failed`` counts the pictures that it gave nothing usable for.

    Raises ``InvalidInput`` for a file that is missing, too large or no network of the adapter's
    kind; ``licence`` says whose it is, or None.
    """

    def __init__(self, path: Path, adapter: str = "fastestdet") -> None:
        self._adapter = _adapter(adapter)
        if not path.is_file():
            raise InvalidInput("detector", f"{path} is no file; name an .onnx file")
        size = path.stat().st_size
        if size > MOST_BYTES:
            raise InvalidInput("detector", f"{path} has {size:,} bytes, at most {MOST_BYTES:,}")
        content = path.read_bytes()
        self.version = f"detector {hashlib.sha256(content).hexdigest()[:16]} by {adapter}"
        self.licence = next((p for p in path.parent.iterdir() if _is_licence(p.name)), None)
        try:
            self._net = cv2.dnn.readNetFromONNX(np.frombuffer(content, np.uint8))
            self._outputs = self._net.getUnconnectedOutLayersNames()
        except cv2.error as error:
            raise InvalidInput("detector", f"{path}: OpenCV cannot read it ({error.err})") from None
        side = self._adapter.input_px
        try:
            self._tile_boxes(np.full((side, side, 3), 128, np.uint8))
        except DetectorFailed as error:
            raise InvalidInput("detector", f"{path} is not for {adapter}: {error}") from None

    def boxes(self, picture: Rgb) -> list[Box]:
        """Return what is in a picture, surest first; raise ``DetectorFailed``."""
        places = tiles(picture)
        seen = [self._tile_boxes(picture[rows, columns]) for rows, columns in places]
        boxes = np.concatenate(
            [
                each[0] + (columns.start, rows.start, 0, 0)
                for each, (rows, columns) in zip(seen, places, strict=True)
            ]
        )
        scores, classes = (np.concatenate([each[k] for each in seen]) for k in (1, 2))
        if not len(boxes):
            return []
        kept = cv2.dnn.NMSBoxesBatched(boxes.tolist(), scores.tolist(), classes.tolist(), 0.0, SAME)
        order = sorted(np.asarray(kept).ravel().tolist(), key=lambda k: -scores[k])
        found = []
        for k in order:
            left, top, width, height = boxes[k].tolist()
            name = self._adapter.classes[classes[k]]
            found.append(Box(left, top, width, height, name, float(scores[k])))
        return found

    def _tile_boxes(self, tile: Rgb) -> tuple[F32, F32, NDArray[np.intp]]:
        side, height = self._adapter.input_px, len(tile)
        try:
            fitted = cast(Rgb, cv2.resize(tile, (side, side), interpolation=cv2.INTER_AREA))
            self._net.setInput(self._adapter.blob(fitted))
            outputs = cast("Sequence[F32]", self._net.forward(self._outputs))
            boxes, scores, classes = self._adapter.boxes(outputs)
        except cv2.error as error:
            raise DetectorFailed(f"OpenCV: {error.err}") from None
        except (ValueError, IndexError, TypeError) as error:
            raise DetectorFailed(str(error)) from None
        if not (np.isfinite(boxes).all() and np.isfinite(scores).all()):
            raise DetectorFailed("boxes or scores are not finite")
        sure = scores >= LEAST_SCORE
        return boxes[sure] * height, scores[sure], classes[sure]


def _adapter(name: str) -> Adapter:
    if name in ADAPTERS:
        return ADAPTERS[name]()
    if ":" not in name:
        raise InvalidInput("adapter", f"{name!r} is none of {', '.join(ADAPTERS)}, or MODULE:CLASS")
    made = cast(Any, make_named("adapter", name))
    lacking = [n for n in ("input_px", "classes", "blob", "boxes") if not hasattr(made, n)]
    if lacking:
        raise InvalidInput("adapter", f"{name!r} lacks {', '.join(lacking)}")
    return cast(Adapter, made)


def _is_licence(name: str) -> bool:
    return name.upper().startswith(("LICENSE", "LICENCE", "COPYING"))


def tiles(picture: Rgb) -> list[tuple[slice, slice]]:
    """Return rows and columns of the fewest square tiles that overlap by ``OVERLAP`` at least."""
    height, width = picture.shape[:2]
    side, length = sorted((height, width))
    count = math.ceil((length - side) / (side * (1 - OVERLAP))) + 1
    firsts = [round((length - side) * k / max(1, count - 1)) for k in range(count)]
    along = [slice(first, first + side) for first in firsts]
    whole = slice(0, side)
    return [(whole, each) if width >= height else (each, whole) for each in along]


def as_text(boxes: Sequence[Box] | None) -> str:
    """Return boxes as a note of a frame; None where the detector failed."""
    if boxes is None:
        return "null"
    numbers = ([round(v, 2) for v in (b.left, b.top, b.width, b.height)] for b in boxes)
    return json.dumps(
        [[*n, b.class_, round(b.score, 4)] for n, b in zip(numbers, boxes, strict=True)]
    )


def of_text(text: str) -> list[Box] | None:
    """Read a note back."""
    rows = json.loads(text)
    return None if rows is None else [Box(*row) for row in rows]
