"""The experiment of cameras and receivers tells wrong pictures, and shows what was before."""

from __future__ import annotations

import numpy as np

from cav_agent.live.source import LiveFrame
from lab.truth.cameras import Heard, Sent, Watched, row
from lab.truth.run import TruthRow, truth_parts
from lab.truth.stream import CodedStream, Coder, Sending, coded, datagrams, digest
from rfcore.codec.h264.bitstream import split_nals
from rfcore.wire.values import ClockKind
from rfedge.report.tables import Table
from rfedge.results import as_json

STREAM = coded(Coder(count=6, group=3, size_px=(96, 48)))


def watched(*pictures: tuple[bytes, float]) -> Watched:
    made = object.__new__(Watched)
    blank = np.zeros((48, 96, 3), np.uint8)
    made.heard = Heard(damaged=1)
    made.frames = [
        (key, LiveFrame(blank, round(1e9 * at_s), at_s, at_s, ClockKind.ARRIVAL, None))
        for key, at_s in pictures
    ]
    return made


def test_a_picture_that_was_not_sent_is_wrong_and_times_are_those_of_the_others():
    keys = list(STREAM.right)
    sent = Sent(STREAM, Sending(rate_hz=1.0), {n: n + 0.5 for n in range(6)}, 0.0)
    other = digest(np.full((48, 96, 3), 7, np.uint8))
    judged = row(sent, watched((keys[2], 2.75), (other, 3.0), (keys[4], 4.65)))
    assert (judged["pictures"], judged["wrong_pictures"], judged["left_out"]) == (3, 1, 1)
    assert round(judged["delay_ms"]) == 200
    assert round(judged["least_delay_ms"]) == 150
    assert round(judged["time_error_ms"]) == 700


def test_datagrams_carry_the_stream_and_mark_the_end_of_each_picture():
    made = [each for each in datagrams(STREAM, Sending(reports=False), 0.0) if not each.port]
    numbers = [int.from_bytes(each.data[2:4], "big") for each in made]
    assert numbers == list(range(7, 7 + len(made)))
    units, nal = [b""], b""
    for each in made:
        payload = each.data[12:]
        if payload[0] & 31 != 28:
            nal = payload
        elif payload[1] & 0x80:
            nal = bytes((payload[0] & 0xE0 | payload[1] & 31,)) + payload[2:]
        else:
            nal += payload[2:]
        if payload[0] & 31 != 28 or payload[1] & 0x40:
            units[-1] += b"\0\0\0\1" + nal
        if each.data[1] & 0x80:
            units.append(b"")
    assert [list(split_nals(unit)) for unit in units[:-1]] == [
        list(split_nals(packet)) for packet in STREAM.packets
    ]


def test_what_was_before_stands_beside_it():
    now = TruthRow("a picture lost", 50, 0, 9, before={"pictures": 50, "wrong_pictures": 9})
    result = {
        "rows": [as_json(now)], "before_revision": "abc", "load": [0.1, 0.2], "host": {"cores": 2},
    }  # fmt: skip
    tables = [part for part in truth_parts(result) if isinstance(part, Table)]
    assert [table.cells[0][2] for table in tables] == ["0", "9"]


def test_streams_follow_each_other():
    both: CodedStream = STREAM + STREAM
    assert list(both.shown_at) == list(range(12))
