"""Spliced streams mean the same to another decoder: OpenH264, through GStreamer.

FFmpeg's decoder and OpenH264 share no code. They must agree on every picture of a stream with every
mode in it, I_PCM references included. Debian: ``make test-system-packages``.
"""

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rfcore.codec.decoder import DeltaDecoder
from rfcore.image import I420
from rfedge.bench.fuzz import make_stream

NEEDED = ("gst-launch-1.0", "gst-inspect-1.0")
PICTURES = 6 + (1 + 1 + 1 + 3 + 3 + 2)
"""A slice for each frame but the pose-only one, and before it its references, or a grey picture."""


class Recording:
    """A decoder that remembers what it was given and what it made of it."""

    def __init__(self, decoder: Any) -> None:
        self._decoder = decoder
        self.units: list[bytes] = []
        self.pictures: list[I420] = []

    def feed(self, unit: bytes) -> None:
        self.decode(unit)

    def decode(self, unit: bytes) -> I420:
        picture: I420 = self._decoder.decode(unit)
        self.units.append(bytes(unit))  # what is fed may be overwritten afterwards
        self.pictures.append(picture)
        return picture


def record(size_px: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> Recording:
    stream = make_stream(size_px)
    decoder = DeltaDecoder(stream.header)
    recording = Recording(decoder._splice._decoder)
    monkeypatch.setattr(decoder._splice, "_decoder", recording)
    for frame in stream.frames:
        decoder.decode(frame.before, frame.packet, frame.view)
    return recording


@pytest.fixture(scope="module")
def openh264() -> Callable[[bytes, tuple[int, int], Path], list[bytes]]:
    """Return a function that decodes a stream into I420 frames."""
    missing = [program for program in NEEDED if shutil.which(program) is None]
    if missing:
        pytest.fail(f"{', '.join(missing)} not found; make test-system-packages")
    subprocess.run(["gst-inspect-1.0", "openh264dec"], check=True, capture_output=True)

    def decode(stream: bytes, size_px: tuple[int, int], folder: Path) -> list[bytes]:
        (folder / "in.h264").write_bytes(stream)
        elements = f"filesrc location={folder}/in.h264 ! h264parse ! openh264dec"
        command = f"gst-launch-1.0 -q {elements} ! filesink location={folder}/out.yuv"
        subprocess.run(command.split(), check=True, capture_output=True, timeout=60)
        data = (folder / "out.yuv").read_bytes()
        length = size_px[0] * size_px[1] * 3 // 2
        return [data[i : i + length] for i in range(0, len(data), length)]

    return decode


@pytest.mark.slow
@pytest.mark.parametrize("size_px", [(176, 144), (64, 48), (320, 176)])
def test_openh264_and_ffmpeg_show_the_same_pictures(
    size_px: tuple[int, int],
    openh264: Callable[[bytes, tuple[int, int], Path], list[bytes]],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    recording = record(size_px, monkeypatch)
    assert len(recording.pictures) == PICTURES
    shown = openh264(b"".join(recording.units), size_px, tmp_path)
    assert len(shown) == PICTURES
    for number, (theirs, ours) in enumerate(zip(shown, recording.pictures, strict=True)):
        planes = b"".join(np.ascontiguousarray(plane).tobytes() for plane in ours.planes)
        assert theirs == planes, f"picture {number}"
