"""The bytes of heads, part by part."""

import pytest

from codec.sent_streams import make_adapting_stream, make_stream, sent_frames
from lab.head import PARTS, head_row, on_rig, part_bits
from rfcore.wire.drive_file import CodedDrive
from rfcore.wire.head import FrameWriter


@pytest.mark.parametrize("make", [make_stream, make_adapting_stream])
def test_the_parts_of_a_message_are_all_of_it_but_the_payload(make):
    hello, sent = sent_frames(make())
    frames = [frame for _, frame in sent]
    for frame, message in zip(frames, FrameWriter(hello).in_order(frames), strict=True):
        payload_bytes = len(frame.packet.payload)
        parts = part_bits(message, payload_bytes)
        assert set(parts) == set(PARTS)
        assert sum(parts.values()) == 8 * (len(message) - payload_bytes)
        assert 0 <= parts["fill"] < 8
        assert parts["other"] >= 8 * len(frame.packet.light)


def test_a_camera_of_a_rig_costs_what_one_alone_does():
    hello, sent = sent_frames(make_stream())
    alone = CodedDrive(hello, tuple(frame for _, frame in sent))
    rows = [
        head_row("", drive.frames, FrameWriter(drive.hello).in_order(drive.frames))
        for drive in (alone, on_rig(alone))
    ]
    assert rows[1].frames == 4 * rows[0].frames
    assert rows[1].head[0] <= rows[0].head[0] + 1
