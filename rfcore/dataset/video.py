"""Frames of a video file by their number, with the times the container states.

Times count from the first frame. A frame that does not state its colour matrix is taken as BT.709
from 720 lines up and as BT.601 below, as players do. A display rotation, which phones write, is
refused, since intrinsics would belong to the other orientation.
"""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from threading import Lock

import av
from av.error import FFmpegError

from rfcore.camera import Intrinsics
from rfcore.errors import DatasetError
from rfcore.image import Rgb, rgb_from_video_frame

__all__ = ["Video"]


class Video:
    """A video file; frames are decoded when read, cheaply when they are read in order.

    Raises ``DatasetError``, naming the file, when it cannot be decoded or is of another size than
    the camera's.
    """

    def __init__(self, file: Path, intrinsics: Intrinsics) -> None:
        self.file = file
        self._lock = Lock()
        try:
            self._container = av.open(str(file))
            self._stream = self._container.streams.video[0]
            self._pts = self._presentation_times()
            if not self._pts:
                raise DatasetError(f"{file}: holds no frames")
            self._check_size(intrinsics)
        except (FFmpegError, OSError, IndexError, StopIteration) as error:
            raise DatasetError(f"{file}: not a readable video ({error})") from error
        self._frames = self._container.decode(self._stream)
        self._next = -1

    @property
    def times_ns(self) -> tuple[int, ...]:
        """When each frame is shown, from the first one on."""
        tick_s = self._stream.time_base or Fraction(1, 90_000)
        return tuple(round((pts - self._pts[0]) * tick_s * 1_000_000_000) for pts in self._pts)

    def read(self, index: int) -> Rgb:
        """Return frame ``index`` as uint8 [H, W, 3]."""
        with self._lock:
            try:
                return rgb_from_video_frame(self._frame(index))
            except (FFmpegError, StopIteration) as error:
                raise DatasetError(
                    f"{self.file}: frame {index} cannot be decoded ({error})"
                ) from error

    def _frame(self, index: int) -> av.VideoFrame:
        """Decode on to a frame, from the key frame before it unless it is the next one."""
        wanted = self._pts[index]
        if index != self._next:
            self._container.seek(wanted, stream=self._stream)
            self._frames = self._container.decode(self._stream)
        frame = next(self._frames)
        while frame.pts is None or frame.pts < wanted:
            frame = next(self._frames)
        if frame.pts != wanted:
            raise DatasetError(f"{self.file}: seeking to frame {index} ends at another frame")
        self._next = index + 1
        return frame

    def _presentation_times(self) -> list[int]:
        """Every frame's time in the stream's ticks, without decoding."""
        packets = self._container.demux(self._stream)
        return sorted({packet.pts for packet in packets if packet.pts is not None and packet.size})

    def _check_size(self, intrinsics: Intrinsics) -> None:
        if self._stream.codec_context is None:
            raise DatasetError(f"{self.file}: is of a codec that is not known")
        found = (self._stream.codec_context.width, self._stream.codec_context.height)
        if found != (intrinsics.width_px, intrinsics.height_px):
            raise DatasetError(
                f"{self.file}: video is {found[0]}x{found[1]} px, its camera says "
                f"{intrinsics.width_px}x{intrinsics.height_px}"
            )
        self._container.seek(self._pts[0], stream=self._stream)
        first = next(self._container.decode(self._stream), None)
        if first is None or first.rotation:
            turned = "nothing" if first is None else f"frames to be turned by {first.rotation}"
            raise DatasetError(f"{self.file}: holds {turned} degrees; encode it upright first")
        self._container.seek(self._pts[0], stream=self._stream)
