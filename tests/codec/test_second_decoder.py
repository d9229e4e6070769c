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

from codec.sent_streams import make_stream
from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.bitstream import stream_header
from rfcore.codec.h264.config import REFERENCE_FRAMES, CodecConfig
from rfcore.codec.h264.slice_coder import Effort, MacroblockMode, SliceCoder
from rfcore.codec.h264.splice import SpliceDecoder
from rfcore.image import I420

NEEDED = ("gst-launch-1.0", "gst-inspect-1.0")
PICTURES = 8 + (1 + 1 + 1 + 3 + 3 + 2 + 2 + 1)
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


def pattern(rng: np.random.Generator, size_px: tuple[int, int], shift: int) -> I420:
    """Blocks with noise, shifted by so many samples."""
    width_px, height_px = size_px
    cells = np.random.default_rng(1).integers(30, 220, (height_px // 7 + 3, width_px // 7 + 9))
    blocks = np.kron(cells, np.ones((7, 7), np.int64))
    planes = []
    for step in (1, 2, 2):
        at = shift // step
        part = blocks[at : at + height_px // step, 2 * at : 2 * at + width_px // step]
        planes.append((part + rng.integers(-5, 6, part.shape)).astype(np.uint8))
    return I420(*planes)


def record_own_slices(
    size_px: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> tuple[Recording, int]:
    """A stream of our own slices, every mode forced at low and high quantisers, filtered or not;
    and how many pictures it has, references included."""
    config = CodecConfig(*size_px)
    coder, splice = SliceCoder(config), SpliceDecoder(stream_header(config))
    recording = Recording(splice._decoder)
    monkeypatch.setattr(splice, "_decoder", recording)
    rng = np.random.default_rng(2)
    macroblocks = config.macroblocks
    pictures = 0
    for number in range(4 * len(MacroblockMode)):
        mode = MacroblockMode(number % len(MacroblockMode))
        inter = mode < MacroblockMode.INTRA_16X16
        references = [
            pattern(rng, size_px, 2 * k)
            for k in range(number % (REFERENCE_FRAMES + 1) or int(inter))
        ]
        forced = np.where(rng.integers(0, 3, macroblocks) > 0, int(mode), -1).astype(np.int8)
        coded = coder.encode(
            pattern(rng, size_px, 1),
            references,
            12 + 11 * (number // len(MacroblockMode)),
            effort=list(Effort)[number % 3],
            deblocked=number % 5 > 0,
            offsets=rng.integers(-6, 7, macroblocks).astype(np.int8),
            forced=forced,
        )
        splice.predict_from(*references)
        shown = splice.decode(coded.payload)
        assert np.array_equal(shown.y, coded.reconstruction.y)
        pictures += max(1, len(references)) + 1
    return recording, pictures


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
def test_openh264_and_ffmpeg_show_the_same_pictures(size_px, openh264, monkeypatch, tmp_path):
    recording = record(size_px, monkeypatch)
    assert len(recording.pictures) == PICTURES
    check_both_show(recording, PICTURES, openh264(b"".join(recording.units), size_px, tmp_path))


@pytest.mark.slow
@pytest.mark.parametrize("size_px", [(176, 144), (72, 56), (1280, 720)])
def test_openh264_and_ffmpeg_agree_on_every_mode_of_our_own_slices(
    size_px, openh264, monkeypatch, tmp_path
):
    recording, pictures = record_own_slices(size_px, monkeypatch)
    check_both_show(recording, pictures, openh264(b"".join(recording.units), size_px, tmp_path))


def check_both_show(recording: Recording, pictures: int, shown: list[bytes]) -> None:
    assert len(shown) == len(recording.pictures) == pictures
    for number, (theirs, ours) in enumerate(zip(shown, recording.pictures, strict=True)):
        planes = b"".join(np.ascontiguousarray(plane).tobytes() for plane in ours.planes)
        assert theirs == planes, f"picture {number}"
