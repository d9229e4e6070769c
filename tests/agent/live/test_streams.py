"""Streams of unusual kinds: pictures come right, or the source is refused by name."""

from __future__ import annotations

from pathlib import Path

import pytest

from cav_agent.live.reader import EndRecord, FrameRecord
from cav_agent.live.settings import ReaderSettings, parse_address
from cav_agent.live.source import ReaderProcess
from lab.truth.stream import CodedStream, Coder, coded, digest

KINDS = {
    "cropped": Coder(count=12, size_px=(90, 50)),
    "cropped on the left": Coder(
        count=12, size_px=(96, 48), params="crop-rect=8,0,0,0:", crop_left_px=8
    ),
    "grey": Coder(count=12, size_px=(96, 48), pix_fmt="gray"),
    "4:4:4": Coder(count=12, size_px=(96, 48), pix_fmt="yuv444p"),
}


def played(stream: CodedStream, folder: Path) -> tuple[list[FrameRecord], str]:
    """Return the pictures that a reader gives of a stream, and the words with which it ends."""
    stream.write(folder / "stream.mkv")
    address = parse_address(str(folder / "stream.mkv"))
    reader = ReaderProcess(ReaderSettings(address, 60.0, 1000.0))
    frames: list[FrameRecord] = []
    try:
        while not isinstance(record := reader.read(60.0), EndRecord):
            assert record is not None
            frames.append(record)
    finally:
        reader.close()
    return frames, record.problem


@pytest.mark.parametrize("kind", KINDS)
def test_every_picture_is_one_that_was_coded(kind, tmp_path):
    stream = coded(KINDS[kind])
    frames, _ = played(stream, tmp_path)
    assert frames
    assert {frame.rgb.shape[1::-1] for frame in frames} == {stream.size_px}
    assert [digest(frame.rgb) in stream.right for frame in frames] == [True] * len(frames)


def test_parameters_that_change_within_a_stream_are_followed(tmp_path):
    one = coded(Coder(count=12, group=12, size_px=(96, 48)))
    other = Coder(count=12, group=12, size_px=(96, 48), params="ref=4:cabac=0:slices=3", seed=4)
    stream = one + coded(other)
    frames, _ = played(stream, tmp_path)
    numbers = [stream.right[digest(frame.rgb)] for frame in frames]
    assert numbers == sorted(numbers)
    assert numbers[-1] == 23


def test_fields_of_two_instants_are_refused_by_name(tmp_path):
    frames, end = played(coded(Coder(count=12, params="interlaced=1", is_read=False)), tmp_path)
    assert not frames
    assert "interlaced" in end
