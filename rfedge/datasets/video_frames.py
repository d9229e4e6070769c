"""Write the sharpest picture of each stretch of a video, as structure from motion needs them.

Sharpness is the variance of the luma's Laplacian (Pech-Pacheco et al., ICPR 2000), compared among
neighbours only: it depends on what is shown. A stretch's picture appears whole when the stretch has
been decoded, so that a stopped run goes on at the first one that is missing.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from rfcore.dataset.trajectory import NS_PER_S
from rfcore.dataset.video import Video
from rfcore.errors import DatasetError, InvalidInput
from rfcore.files import write_whole
from rfcore.image import write_png

MAX_PER_SECOND = 100.0
ABOUT = "video.json"


@dataclass(frozen=True)
class FrameSelection:
    """The video that the pictures of a folder were chosen from, and how many a second."""

    video: str
    bytes: int
    per_second: float


@dataclass(frozen=True)
class SharpestFrame:
    """The frame to keep of one stretch of the video."""

    number: int
    frame: av.VideoFrame


def sharpest_frames(
    video: Path, folder: Path, per_second: float, tell: Callable[[str], None]
) -> int:
    """Write ``folder/00000.png``, ...: one picture of each ``1 / per_second`` seconds, in order.

    Takes as done what is there already of the same video and rate. Returns how many there are.
    Raises ``DatasetError`` for a video that cannot be decoded, ``InvalidInput`` for a folder that
    holds something else.
    """
    if not 0 < per_second <= MAX_PER_SECOND:
        raise InvalidInput("per-second", f"{per_second:g} is outside 0..{MAX_PER_SECOND:g}")
    try:
        size_bytes = video.stat().st_size
    except OSError as error:
        raise DatasetError(f"{video}: cannot be read ({error.strerror})") from error
    opened = Video(video)
    _claim(folder, FrameSelection(video.name, size_bytes, per_second))
    for note in opened.index.notes:
        tell(note)
    done = _first_missing(folder)
    total_s = opened.index.times_ns[-1] / NS_PER_S
    for stretch in _stretches(opened, done, per_second):
        write_png(_path(folder, stretch.number), opened.shown(stretch.frame))
        tell(f"sharpest frames: {stretch.number / per_second:.0f} of {total_s:.0f} s")
    return sum(1 for _ in folder.glob("*.png"))


def sharpness(luma: NDArray[np.uint8]) -> float:
    """Return the variance of the Laplacian of ``luma`` [H, W], each side 3 px or more."""
    y = luma.astype(np.int32)
    laplacian = y[1:-1, :-2] + y[1:-1, 2:] + y[:-2, 1:-1] + y[2:, 1:-1] - 4 * y[1:-1, 1:-1]
    return float(laplacian.var())


def _claim(folder: Path, chosen: FrameSelection) -> None:
    about = folder / ABOUT
    content = json.dumps(asdict(chosen))
    if not folder.exists():
        folder.mkdir(parents=True)
        write_whole(about, content)
    elif not about.is_file() or about.read_text() != content:
        raise InvalidInput(
            "out", f"{folder} holds frames of another video or rate, or other files; remove it"
        )


def _first_missing(folder: Path) -> int:
    number = 0
    while _path(folder, number).exists():
        number += 1
    return number


def _path(folder: Path, number: int) -> Path:
    return folder / f"{number:05}.png"


def _stretches(video: Video, from_number: int, per_second: float) -> Iterator[SharpestFrame]:
    """Yield the sharpest frame of each stretch that has any, from stretch ``from_number`` on."""
    best: tuple[float, SharpestFrame] | None = None
    for index, time_ns in enumerate(video.index.times_ns):
        number = int(time_ns / NS_PER_S * per_second + 1e-6)
        if number < from_number:
            continue
        frame = video.frame(index)
        score = sharpness(_luma(frame))
        if best is not None and number > best[1].number:
            yield best[1]
            best = None
        if best is None or score > best[0]:
            best = (score, SharpestFrame(number, frame))
    if best is not None:
        yield best[1]


def _luma(frame: av.VideoFrame) -> NDArray[np.uint8]:
    return np.asarray(frame.reformat(format="gray8").to_ndarray(), np.uint8)
