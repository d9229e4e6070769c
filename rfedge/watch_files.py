"""What a consumer of the twin keeps on disk: pictures in folders, or one camera as a video."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path
from types import TracebackType

import av
import numpy as np

from rfcore.files import write_whole
from rfcore.image import I420, png_bytes
from rfcore.native.yuv import rgb_from_i420
from rfcore.wire.twin import PictureEncoding, TwinPicture

__all__ = ["PictureFolder", "PictureVideo"]

TICKS_PER_S = 90_000
"""Of a video's clock, as in MPEG systems."""


class PictureFolder:
    """FOLDER/VEHICLE/CAMERA/SESSION-EPOCH-SEQUENCE.png or .jpg, with a line each in index.jsonl."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def keep(self, picture: TwinPicture) -> None:
        """Write a picture; one that travelled as I420 becomes PNG."""
        folder = self._folder / picture.vehicle_id / picture.camera_id
        folder.mkdir(parents=True, exist_ok=True)
        is_jpeg = picture.encoding is PictureEncoding.JPEG
        name = f"{picture.session_id}-e{picture.epoch:04}-{picture.sequence:06}"
        name += ".jpg" if is_jpeg else ".png"
        data = picture.picture
        if picture.encoding is PictureEncoding.I420:
            data = png_bytes(rgb_from_i420(_planes(picture)))
        write_whole(folder / name, data)
        line = {
            "file": name,
            "session": picture.session_id,
            "epoch": picture.epoch,
            "sequence": picture.sequence,
            "capture_time_ns": picture.capture_time_ns,
            "age_ms": picture.age_ns / 1e6,
            "translation_m": picture.pose.translation_m,
            "rotation_wxyz": picture.pose.rotation,
            "field": picture.field_id,
            "digest": picture.reconstruction_digest.hex(),
            "missed": picture.skipped,
        }
        with (folder / "index.jsonl").open("a") as index:
            index.write(json.dumps(line) + "\n")


class PictureVideo:
    """One camera as H.264 in MP4; pictures of others, or of another size, are left out.

    A picture's time is its capture, so a gap in the stream is a still in the video.
    """

    def __init__(self, path: Path) -> None:
        self._container = av.open(str(path), "w", format="mp4")
        self._stream: av.VideoStream | None = None
        self._first: TwinPicture | None = None
        self._last_tick = -1

    def __enter__(self) -> PictureVideo:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._stream is not None:
            self._container.mux(self._stream.encode(None))
        self._container.close()

    def keep(self, picture: TwinPicture) -> None:
        """Append a picture, unless it is of another camera or not later than the last one."""
        first = self._first = self._first or picture
        if _camera(picture) != _camera(first):
            return
        tick = (picture.capture_time_ns - first.capture_time_ns) * TICKS_PER_S // 10**9
        if tick <= self._last_tick:
            return
        self._last_tick = tick
        stream = self._stream = self._stream or self._open(picture)
        frame = av.VideoFrame.from_ndarray(_even(_planes(picture)), format="yuv420p")
        frame.pts, frame.time_base = tick, Fraction(1, TICKS_PER_S)
        self._container.mux(stream.encode(frame))

    def _open(self, picture: TwinPicture) -> av.VideoStream:
        stream = self._container.add_stream(
            "libx264", options={"crf": "18", "preset": "veryfast", "bf": "0"}
        )
        k = picture.intrinsics
        stream.width, stream.height = k.width_px // 2 * 2, k.height_px // 2 * 2
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = Fraction(1, TICKS_PER_S)
        return stream


def _camera(picture: TwinPicture) -> tuple[str, str, int, int]:
    k = picture.intrinsics
    return (picture.vehicle_id, picture.camera_id, k.width_px, k.height_px)


def _planes(picture: TwinPicture) -> I420:
    k = picture.intrinsics
    return I420.unpacked((k.width_px, k.height_px), picture.picture)


def _even(picture: I420) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    """Return the planes as PyAV wants them, [3/2 H, W], an odd row or column cut off."""
    height, width = (n // 2 * 2 for n in picture.y.shape)
    chroma = (plane[: height // 2, : width // 2].reshape(-1) for plane in (picture.u, picture.v))
    flat = np.concatenate([picture.y[:height, :width].reshape(-1), *chroma])
    return flat.reshape(height * 3 // 2, width)
