"""A prerecorded vehicle keeps its pace whatever the server does, and its packets stay decodable."""

import zlib
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.camera import Intrinsics, Pose
from rfcore.codec.h264.bitstream import StreamHeader
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.packet import DeltaPacket
from rfcore.errors import RejectReason
from rfcore.wire.conventions import RENDERER_CONTRACT
from rfcore.wire.convert import client_message_from_bytes
from rfcore.wire.head import FrameReader, FrameWriter
from rfcore.wire.messages import (
    Ack,
    CameraDescription,
    Credit,
    Frame,
    Hello,
    Nack,
    RendererContract,
    StageTimes,
)
from rfedge.loadtest.prerecorded import End, PrerecordedDrive, Replay, Schedule

PICTURES = 4


def prerecorded_frame(payload: bytes) -> Frame:
    digest = zlib.crc32(payload).to_bytes(6, "big")
    packet = DeltaPacket(0, 0, digest[-2:], b"", digest, payload)
    return Frame("front", 0, Pose.identity(), "", packet)


@pytest.fixture(scope="module")
def drive() -> PrerecordedDrive:
    header = StreamHeader(CodecConfig(32, 16), b"\x67" * 20, b"\x68" * 5)
    camera = CameraDescription("front", Intrinsics(32, 16, 20.0, 20.0, 16.0, 8.0), header)
    hello = Hello("v", (camera,), ("ab" * 32,), RendererContract(RENDERER_CONTRACT, exact=True))
    chain = tuple(prerecorded_frame(f"chain {i}".encode()) for i in range(PICTURES))
    alone = tuple(prerecorded_frame(f"alone {i}".encode()) for i in range(PICTURES))
    return PrerecordedDrive(hello, chain, alone)


class ReadReplay(Replay):
    """Hands out the frames as a server reads them."""

    def __init__(self, drive: PrerecordedDrive) -> None:
        super().__init__("front", drive, lambda s: round(s * 1e9), FrameWriter(drive.hello))
        self._reader = FrameReader(drive.hello)

    def frame_to_send(self, now: float) -> Frame | None:
        message = super().frame_to_send(now)
        return message and self._reader.read(client_message_from_bytes(message))


def replay_of(drive: PrerecordedDrive, seconds: float = 2.0, hz: float = 10.0) -> Replay:
    replay = ReadReplay(drive)
    replay.begin(Schedule(0.0, seconds, hz))
    return replay


def answer(frame: Frame) -> Ack:
    return Ack(frame.address, StageTimes(), frame.packet.reconstruction_digest)


def test_nothing_is_due_before_the_departure(drive):
    replay = ReadReplay(drive)
    replay.receive(Credit("front", 9), 0.0)
    assert replay.get_timer() is None
    assert replay.frame_to_send(1e9) is None


def test_a_late_answer_does_not_move_what_is_due(drive):
    """The server stalls for half a second: the pictures of that time count, as dropped, and the
    one that waited counts from when it was due (no coordinated omission)."""
    replay = replay_of(drive)
    replay.receive(Credit("front", 1), 0.0)
    assert replay.frame_to_send(0.0) is not None
    assert replay.frame_to_send(0.5) is None, "no credit"
    replay.receive(Credit("front", 2), 0.55)
    late = replay.frame_to_send(0.55)
    replay.receive(answer(late), 0.57)
    assert [shot.end for shot in replay.shots] == [End.OPEN, *[End.DROPPED] * 4, End.ACKED]
    assert replay.shots[5].latency_s == pytest.approx(0.57 - 0.5)
    assert late.capture_time_ns == 500_000_000


def test_pictures_follow_each_other_as_a_vehicle_sends_them(drive):
    replay = replay_of(drive)
    replay.receive(Credit("front", 99), 0.0)
    sent = [replay.frame_to_send(i / 10) for i in range(PICTURES + 1)]
    assert [f.packet.payload for f in sent if f] == [
        *(f"chain {i}".encode() for i in range(PICTURES)),
        b"chain 0",
    ]
    assert [(f.packet.epoch, f.packet.sequence) for f in sent if f] == [
        (0, 0),
        (0, 1),
        (0, 2),
        (0, 3),
        (1, 0),
    ]


def test_after_a_refusal_pictures_are_sent_alone_until_the_drive_begins_again(drive):
    replay = replay_of(drive)
    replay.receive(Credit("front", 99), 0.0)
    first = replay.frame_to_send(0.0)
    replay.receive(Nack(first.address, RejectReason.CRC_MISMATCH, "flipped"), 0.05)
    sent = [replay.frame_to_send(i / 10) for i in range(1, PICTURES + 2)]
    assert [f.packet.payload for f in sent if f] == [
        b"alone 1",
        b"alone 2",
        b"alone 3",
        b"chain 0",
        b"chain 1",
    ]
    epochs = [f.packet.epoch for f in sent if f]
    assert epochs == sorted(epochs)
    assert [f.packet.sequence for f in sent if f] == [0, 0, 0, 0, 1]


def test_what_a_lost_stream_could_not_send_counts(drive):
    replay = replay_of(drive, seconds=1.0)
    replay.frame_to_send(0.3)
    replay.give_up()
    assert len(replay.shots) == 10
    assert replay.get_timer() is None


def test_a_vehicle_that_needs_time_sends_later_and_counts_from_due(drive):
    replay = ReadReplay(drive)
    replay.begin(replace(Schedule(0.0, 1.0, 10.0), ready_s=0.06))
    replay.receive(Credit("front", 9), 0.0)
    assert replay.frame_to_send(0.05) is None
    frame = replay.frame_to_send(0.06)
    assert frame is not None
    replay.receive(answer(frame), 0.08)
    assert replay.shots[0].latency_s == pytest.approx(0.08)


@given(st.lists(st.floats(0, 3), max_size=40), st.integers(0, 30))
def test_every_picture_that_was_due_is_accounted_for(drive, moments, credit):
    replay = replay_of(drive)
    replay.receive(Credit("front", credit), 0.0)
    sent = [frame for now in sorted(moments) if (frame := replay.frame_to_send(now))]
    assert len(sent) <= credit
    last = max(moments, default=-1.0)
    due = sum(i / 10 <= last for i in range(20))
    assert len(replay.shots) == due
    open_or_waiting = sum(shot.end is End.OPEN for shot in replay.shots)
    assert len(sent) <= open_or_waiting <= len(sent) + 1
