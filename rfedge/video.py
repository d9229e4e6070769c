"""MP4 files for people to look at."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import av
from av.container import OutputContainer
from av.video.codeccontext import VideoCodecContext
from av.video.reformatter import ColorRange
from av.video.stream import VideoStream

from rfcore.codec.h264.ffmpeg import SIGNAL, video_frame
from rfcore.errors import InvalidInput
from rfcore.image import I420, Rgb
from rfcore.native.yuv import i420_from_rgb

BT709 = 1
"""The code of ITU-T H.273 for primaries, transfer and matrix."""
X264_SIGNAL = ":".join(f"{name}={value}" for name, value in SIGNAL.items())
"""x264's parameters that say the same."""


def write_mp4(path: Path, frames: Iterable[Rgb | I420], rate_hz: float) -> int:
    """Write pictures of one size and return how many; an odd last row or column is cut off.

    Colours are BT.709 in limited range at every size, and the file says so: players take BT.601
    for small pictures that do not. CRF 16, so that what is seen is the pictures' quality. Raises
    ``InvalidInput`` for none.
    """
    count = 0
    with av.open(str(path), "w") as container:
        rate = Fraction(rate_hz).limit_denominator(1000)
        stream = bt709_stream(container, rate, {"crf": "16", "preset": "fast"})
        for given in frames:
            picture = given if isinstance(given, I420) else i420_from_rgb(given)
            frame = even_frame(picture, count)
            if not count:
                stream.width, stream.height = frame.width, frame.height
            container.mux(stream.encode(frame))
            count += 1
        if count:
            container.mux(stream.encode(None))
    if not count:
        path.unlink()
        raise InvalidInput("video", f"{path}: there is no picture to write")
    return count


def even_frame(picture: I420, pts: int) -> av.VideoFrame:
    """Return a picture as coders of 4:2:0 take it, an odd last row or column cut off."""
    width, height = (side - side % 2 for side in picture.size_px)
    return video_frame(picture.cropped((width, height)), (width, height), pts)


def bt709_stream(
    container: OutputContainer, rate_hz: Fraction | None, options: dict[str, str]
) -> VideoStream:
    """Add a stream of H.264 that is tagged as BT.709 in limited range, which ``I420`` is."""
    options = {**options, "x264-params": X264_SIGNAL}
    stream = container.add_stream("libx264", rate=rate_hz, options=options)
    tag_as_bt709(stream.codec_context)
    return stream


def tag_as_bt709(codec: VideoCodecContext) -> None:
    """Have a coder take the pictures of ``I420``, and say what they are; with ``X264_SIGNAL``."""
    codec.pix_fmt = "yuv420p"
    codec.color_range = ColorRange.MPEG
    codec.colorspace = codec.color_primaries = codec.color_trc = BT709
