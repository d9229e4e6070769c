"""Whatever packets are lost, a picture that is passed on is the picture that was sent."""

from __future__ import annotations

import itertools
import random
from fractions import Fraction
from typing import Any

import av
import numpy as np
import pytest
from av.error import InvalidDataError

from cav_agent.live.unbroken import UnbrokenPictures

SIZE_PX = (96, 64)
CODERS = {
    "zerolatency": ("libx264", {"tune": "zerolatency"}, 0),
    "b frames": ("libx264", {"bf": "2", "b-pyramid": "normal"}, 2),
    "baseline, four slices": (
        "libx264",
        {"profile": "baseline", "x264-params": "slices=4:ref=3"},
        0,
    ),
    "open groups": ("libx264", {"x264-params": "open-gop=1:bframes=2"}, 2),
    "gradual refresh": ("libx264", {"tune": "zerolatency", "x264-params": "intra-refresh=1"}, 0),
    "scaling lists": ("libx264", {"tune": "zerolatency", "x264-params": "cqm=jvt"}, 0),
    "hevc": ("libx265", {"x265-params": "bframes=0:log-level=none"}, 0),
}


def packets_of(coder: str, count: int = 60, group: int = 20) -> list[Any]:
    """Return coded pictures of moving noise, in the form of a network's stream, and their coder."""
    name, options, _ = CODERS[coder]
    made = av.CodecContext.create(name, "w")
    made.width, made.height, made.pix_fmt = *SIZE_PX, "yuv420p"
    made.time_base, made.framerate, made.gop_size = Fraction(1, 10), Fraction(10), group
    made.options = {"crf": "30", "sc_threshold": "0", "keyint_min": str(group), **options}
    noise = np.random.default_rng(3).integers(0, 255, (64, 400, 3), np.uint8)
    packets = []
    for i in range(count):
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(noise[:, 2 * i : 2 * i + 96]))
        frame.pts, frame.time_base = i, Fraction(1, 10)
        packets += made.encode(frame)
    return packets + made.encode(None)


def decoded(coder: str, packets: list[Any]) -> tuple[dict[int, bytes], list[int]]:
    """Decode packets; return all pictures by time, and the times of those that are passed."""
    name = "hevc" if coder == "hevc" else "h264"
    context = av.CodecContext.create(name, "r")
    context.thread_count = 1
    chain: UnbrokenPictures[int] = UnbrokenPictures(has_frame_numbers=name == "h264", may_lose=True)
    pictures: dict[int, bytes] = {}
    passed = []
    for packet in [*packets, None]:
        if packet is not None:
            chain.packet(bytes(packet), packet.pts, packet.dts, is_flagged=packet.is_corrupt)
        try:
            frames = context.decode(packet)
        except InvalidDataError:
            chain.broke()
            continue
        for frame in frames:
            assert frame.pts is not None
            pictures[frame.pts] = frame.to_ndarray().tobytes()
            passed += chain.released(
                frame.pts, frame.pts, is_key=frame.key_frame, is_flagged=frame.is_corrupt
            )
    assert len(passed) + chain.left_out >= len(pictures)
    return pictures, passed


@pytest.mark.parametrize("coder", CODERS)
def test_all_pictures_of_a_whole_stream_are_passed(coder):
    pictures, passed = decoded(coder, packets_of(coder))
    assert passed == sorted(pictures) == list(range(60))


@pytest.mark.parametrize("coder", CODERS)
def test_what_is_passed_after_losses_is_what_was_sent(coder):
    packets = packets_of(coder)
    truth, _ = decoded(coder, packets)
    rng = random.Random(7)
    passed_in_all = hidden = 0
    for _ in range(12):
        lost = set(rng.sample(range(4, 36), rng.choice((1, 1, 2, 5))))
        pictures, passed = decoded(coder, [p for i, p in enumerate(packets) if i not in lost])
        wrong = [time for time in passed if pictures[time] != truth[time]]
        assert wrong == [], f"without packets {sorted(lost)}"
        assert passed[-1] == 59 or coder == "gradual refresh", "the last group is whole"
        passed_in_all += len(passed)
        hidden += sum(pictures[time] != truth[time] for time in pictures)
    assert passed_in_all > 12 * 20
    if coder != "hevc":
        assert hidden > 12, "the decoder gives wrong pictures as if nothing were"


@pytest.mark.parametrize("coder", ["zerolatency", "b frames", "baseline, four slices"])
def test_what_is_passed_after_a_packet_was_cut_is_what_was_sent(coder):
    packets = packets_of(coder)
    truth, _ = decoded(coder, packets)
    for at, share in itertools.product((7, 13, 26), (0.3, 0.5, 0.9)):
        cut = av.Packet(bytes(packets[at])[: round(packets[at].size * share)])
        cut.pts, cut.dts = packets[at].pts, packets[at].dts
        pictures, passed = decoded(coder, [*packets[:at], cut, *packets[at + 1 :]])
        assert [time for time in passed if pictures[time] != truth[time]] == []
        assert passed[-1] == 59


def test_a_whole_cycle_of_frame_numbers_that_is_lost_is_noticed_by_the_time_stamps():
    packets = packets_of("zerolatency", count=120, group=120)
    pictures, passed = decoded("zerolatency", packets[:40] + packets[40 + 16 :])
    assert passed == list(range(40)), "16 frame numbers are a cycle of x264's with one reference"
    assert len(pictures) == 120 - 16
