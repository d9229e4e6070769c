"""Write the sharpest picture of each stretch of a video, as structure from motion needs them.

Sharpness is the variance of the luma's Laplacian (Pech-Pacheco et al., ICPR 2000), compared among
neighbours only: it depends on what is shown. A stretch's picture appears whole when the stretch has
been decoded, so that a stopped run goes on at the first one that is missing.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.container import InputContainer
from av.error import FFmpegError
from av.video.stream import VideoStream
from numpy.typing import NDArray

from rfcore.errors import DatasetError, InvalidInput
from rfcore.files import write_whole
from rfcore.image import rgb_from_video_frame, write_png

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
        _claim(folder, FrameSelection(video.name, video.stat().st_size, per_second))
        done = _first_missing(folder)
        with av.open(str(video)) as container:
            stream = container.streams.video[0]
            total_s = _duration_s(stream)
            frames = _frames(container, stream, done / per_second)
            for stretch in _stretches(frames, per_second):
                if stretch.number >= done:
                    write_png(_path(folder, stretch.number), rgb_from_video_frame(stretch.frame))
                    tell(f"sharpest frames: {stretch.number / per_second:.0f} of {total_s:.0f} s")
    except (FFmpegError, OSError, IndexError) as error:
        raise DatasetError(f"{video}: not a readable video ({error})") from error
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


def _duration_s(stream: VideoStream) -> float:
    if stream.duration is None or stream.time_base is None:
        return float("nan")
    return float(stream.duration * stream.time_base)


def _frames(
    container: InputContainer, stream: VideoStream, from_s: float
) -> Iterator[tuple[float, av.VideoFrame]]:
    """Yield frames with their time from the start, from the key frame before ``from_s`` on."""
    tick_s = stream.time_base or Fraction(1, 90_000)
    start = stream.start_time or 0
    if from_s > 0:
        container.seek(start + int(from_s / tick_s), stream=stream)
    for frame in container.decode(stream):
        if frame.rotation:
            raise DatasetError(
                f"{container.name}: frames are to be turned by {frame.rotation} degrees; encode "
                "it upright first"
            )
        if frame.pts is not None:
            yield float((frame.pts - start) * tick_s), frame


def _stretches(
    frames: Iterator[tuple[float, av.VideoFrame]], per_second: float
) -> Iterator[SharpestFrame]:
    """Yield the sharpest frame of each stretch that has any."""
    best: tuple[float, SharpestFrame] | None = None
    for time_s, frame in frames:
        number = int(time_s * per_second + 1e-6)
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
