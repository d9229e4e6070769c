"""Average precision by COCO's rules (pycocotools), and what lies between two curves of it.

Averaged over overlaps of 0.5 to 0.95 and over the classes of which the truth has ``LEAST_BOXES``.
A curve is one of rates over average precision in percent; a point that another one beats in both is
left out of it, for precision does not rise evenly with the rate.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from contextlib import redirect_stdout
from copy import deepcopy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.detect.detector import Box
from rfcore.errors import InvalidInput
from rfedge.evaluate.rate_curve import QUICK_POINTS, RateCurve, Window, bd_rate_percent

ALL = "all"
SIZES = (ALL, "small", "medium", "large")
"""COCO's sizes of objects: below 32x32 px, below 96x96 px, and above."""
MOST_BOXES = [100]
"""The surest of a picture, as COCO counts."""
LEAST_BOXES = 10
LEAST_WINDOW = 5.0
"""Least width of a window that curves are compared over, in percent of average precision."""
REPETITIONS, LEAST_SHARE = 200, 0.9
Frames = Sequence[Sequence[Box]]


class Precision:
    """Boxes found in each frame, matched once with the true ones of the ``classes``."""

    def __init__(self, truth: Frames, found: Frames, classes: Sequence[str]) -> None:
        self.classes = tuple(classes)
        from pycocotools.coco import COCO
        from pycocotools.cocoeval import COCOeval

        truly, really = (self._rows(frames) for frames in (truth, found))
        with redirect_stdout(io.StringIO()):
            true, seen = COCO(), COCO()
            for coco, rows in ((true, truly), (seen, really)):
                coco.dataset = {
                    "info": {},
                    "images": [{"id": k} for k in range(len(truth))],
                    "categories": [{"id": k, "name": n} for k, n in enumerate(classes)],
                    "annotations": rows,
                }
                coco.createIndex()
            self._evaluated: Any = COCOeval(true, seen, "bbox")
            self._evaluated.params.maxDets = MOST_BOXES
            self._evaluated.evaluate()
        self._ranges = self._evaluated.params.areaRng
        shape = (len(self.classes), len(SIZES), len(truth))
        self._matched = np.array(self._evaluated.evalImgs, dtype=object).reshape(shape)

    def _rows(self, frames: Frames) -> list[dict[str, Any]]:
        rows = [
            {
                "image_id": k,
                "category_id": self.classes.index(box.class_),
                "bbox": [box.left, box.top, box.width, box.height],
                "area": box.width * box.height,
                "iscrowd": 0,
                "score": box.score,
            }
            for k, boxes in enumerate(frames)
            for box in boxes
            if box.class_ in self.classes
        ]
        return [{"id": number, **row} for number, row in enumerate(rows, 1)]

    def percent(
        self, frames: Sequence[int] | slice = slice(None), sizes: int = len(SIZES)
    ) -> dict[tuple[str, str], float]:
        """Return the average precision of ``frames``, which may repeat, by class and the first
        ``sizes`` of ``SIZES``.

        What the truth has nothing of is left out.
        """
        chosen = self._matched[:, :sizes, frames]
        evaluated = self._evaluated
        evaluated.params.areaRng = self._ranges[:sizes]
        evaluated.params.imgIds = list(range(chosen.shape[2]))
        evaluated._paramsEval = deepcopy(evaluated.params)
        evaluated.evalImgs = chosen.ravel().tolist()
        with redirect_stdout(io.StringIO()):
            evaluated.accumulate()
        precision = evaluated.eval["precision"][..., -1]  # of overlap, recall, class, size
        found = {}
        for s, size in enumerate(SIZES[:sizes]):
            by_class = [precision[:, :, k, s] for k in range(len(self.classes))]
            means = [float(p[p > -1].mean()) if (p > -1).any() else math.nan for p in by_class]
            known = [mean for mean in means if not math.isnan(mean)]
            if known:
                found[ALL, size] = 100 * float(np.mean(known))
            found |= {(n, size): 100 * m for n, m in zip(self.classes, means, strict=True)}
        return {key: value for key, value in found.items() if not math.isnan(value)}


Measured = tuple[Precision, NDArray[np.int64]]
"""A point's precision, and the sizes of its frames."""


def counted_classes(truth: Frames) -> list[str]:
    """Return the classes of which there are enough boxes to average over."""
    names = [box.class_ for boxes in truth for box in boxes]
    return [name for name in sorted(set(names)) if names.count(name) >= LEAST_BOXES]


def precision_curve(percents: Sequence[float], bytes_per_frame: Sequence[float]) -> RateCurve:
    """Return the curve of points that no other one beats; raises as ``RateCurve`` for too few."""
    best: list[tuple[float, float]] = []
    for rate, percent in sorted(zip(bytes_per_frame, percents, strict=True)):
        if not best or percent > best[-1][1]:
            best.append((rate, percent))
    rates, qualities = np.array(best).T
    return RateCurve(qualities, rates, QUICK_POINTS)


def shared_window(curves: Sequence[RateCurve]) -> Window | None:
    """Return what all curves span, None if that is hardly anything."""
    low, high = max(c.psnr_db[0] for c in curves), min(c.psnr_db[-1] for c in curves)
    return (float(low), float(high)) if high - low >= LEAST_WINDOW else None


def drawn_curves(
    points: Sequence[Measured], draws: Sequence[NDArray[np.intp]]
) -> list[RateCurve | None]:
    """Return the curve of each draw of frames, None where it has too few points."""
    curves: list[RateCurve | None] = []
    for frames in draws:
        chosen = frames.tolist()
        percents = [p.percent(chosen, sizes=1).get((ALL, ALL), math.nan) for p, _ in points]
        rates = [float(sizes[chosen].mean()) for _, sizes in points]
        try:
            curves.append(precision_curve(percents, rates))
        except InvalidInput:
            curves.append(None)
    return curves


def interval(
    ours: Sequence[RateCurve | None], theirs: Sequence[RateCurve | None]
) -> tuple[float, float] | None:
    """Return the 95 % interval of the BD-rate over the curves of the same draws; None where too
    many share hardly anything."""
    figures = []
    for one, other in zip(ours, theirs, strict=True):
        if one is not None and other is not None:
            window = shared_window([one, other])
            if window is not None:
                figures.append(bd_rate_percent(other, one, window))
    if len(figures) < LEAST_SHARE * len(ours):
        return None
    low, high = np.percentile(figures, (2.5, 97.5))
    return float(low), float(high)
