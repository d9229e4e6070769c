"""The throughput of a path is learnt from answers: against a path whose truth is known."""

import itertools

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from cav_agent.path_estimator import MIN_RTT_WINDOW_NS, PathEstimator
from rfcore.errors import InvalidInput

MS = 1_000_000
GAP_NS = 10 * MS


def round_trip_ns(size_bytes: int, min_rtt_ms: float, ns_per_byte: float) -> int:
    return round(min_rtt_ms * MS + ns_per_byte * size_bytes)


def answered(path: PathEstimator, sizes: list[int], min_rtt_ms: float, ns_per_byte: float) -> int:
    """Send packets one after the other, each after the answer to the last; return the time."""
    now = 0
    for key, size_bytes in enumerate(sizes):
        path.sent(key, size_bytes, now)
        now += round_trip_ns(size_bytes, min_rtt_ms, ns_per_byte)
        path.answered(key, now)
        now += GAP_NS
    return now


def remembered(sizes: list[int], min_rtt_ms: float, ns_per_byte: float) -> list[int]:
    """Return the sizes whose answers came within the window of the shortest round trip."""
    kept, before_last_ns = [], 0
    for size_bytes in reversed(sizes):
        if before_last_ns <= MIN_RTT_WINDOW_NS:
            kept.append(size_bytes)
        before_last_ns += round_trip_ns(size_bytes, min_rtt_ms, ns_per_byte) + GAP_NS
    return kept


@given(
    sizes=st.lists(st.integers(200, 100_000), min_size=1, max_size=20),
    min_rtt_ms=st.floats(0, 200),
    ns_per_byte=st.floats(80, 80_000),
    spare_ms=st.integers(1, 1000),
)
@example(sizes=[295], min_rtt_ms=0.0, ns_per_byte=81.5, spare_ms=1)
@example(sizes=[200, 59_876, 59_875], min_rtt_ms=200.0, ns_per_byte=80_000.0, spare_ms=1)
def test_what_it_says_has_room_has(
    sizes: list[int], min_rtt_ms: float, ns_per_byte: float, spare_ms: int
) -> None:
    """On a steady path, wherever its delay is above that of the shortest packet."""
    path = PathEstimator()
    now = answered(path, sizes, min_rtt_ms, ns_per_byte)
    sizes = remembered(sizes, min_rtt_ms, ns_per_byte)
    spare_ns = spare_ms * MS
    room = path.room_bytes(now, now + spare_ns, now)
    shortest_ns = min_rtt_ms * MS + ns_per_byte * min(sizes)
    slack = 1 + 1e-6 + 1 / shortest_ns  # delays are whole nanoseconds
    if spare_ns >= min_rtt_ms * MS + ns_per_byte * max(sizes):
        assert min_rtt_ms * MS + ns_per_byte * room <= spare_ns * slack
    elif spare_ns < shortest_ns:
        assert room <= min(sizes) * spare_ns / shortest_ns * slack


@given(
    sizes=st.lists(st.integers(200, 100_000), min_size=1, max_size=10),
    waits_ms=st.lists(st.integers(1, 1000), min_size=2, max_size=5),
)
def test_later_is_never_less_room(sizes: list[int], waits_ms: list[int]) -> None:
    path = PathEstimator()
    now = answered(path, sizes, 20, 1000)
    path.sent("in flight", 5000, now)
    rooms = [path.room_bytes(now, now + wait * MS, now) for wait in sorted(waits_ms)]
    assert rooms == sorted(rooms)
    assert not any(room != room for room in rooms), "NaN"


def test_the_proven_rate_is_at_most_the_paths() -> None:
    path = PathEstimator()
    assert path.rate_bps is None
    answered(path, [1000, 20_000, 4000], 20, 1000)
    rate_bps = path.rate_bps
    assert rate_bps is not None
    assert rate_bps == pytest.approx(8 * 20_000 / 0.04)
    assert rate_bps < 8e6


def test_an_overdue_packet_leaves_no_room_before_its_answer() -> None:
    path = PathEstimator()
    now = answered(path, [4000] * 8, 20, 1000)
    assert path.room_bytes(now, now + 100 * MS, now) > 4000
    path.sent("late", 4000, now)
    assert path.room_bytes(now + 10 * MS, now + 110 * MS, now + 10 * MS) > 4000
    late = now + 300 * MS
    assert path.room_bytes(late, late + 100 * MS, late) <= 0


def test_what_waits_before_it_takes_from_the_room() -> None:
    rooms = []
    for packets_in_flight in range(4):
        path = PathEstimator()
        now = answered(path, [1000, 8000, 2000, 8000], 20, 1000)
        for key in range(packets_in_flight):
            path.sent(f"in flight {key}", 20_000, now)
        rooms.append(path.room_bytes(now, now + 200 * MS, now))
    assert all(more > less for more, less in itertools.pairwise(rooms))


def test_a_fallen_rate_is_believed_at_once() -> None:
    path = PathEstimator()
    now = answered(path, [8000] * 8, 20, 800)
    assert path.sustained_bytes(100 * MS, now) > 8000
    path.sent("slow", 8000, now)
    now += round(20 * MS + 26_667 * 8000)
    path.answered("slow", now)
    assert path.sustained_bytes(100 * MS, now) < 1.2 * 100 * MS / 26_667


TRUE_BYTES = 100 * MS / 800


def after_a_slow_one(*sizes: int, ns_per_byte: float) -> float:
    """Send eight packets at 800 ns a byte, one that takes 300 ms, then ``sizes``; return the bytes
    that 100 ms are said to carry for ever."""
    path = PathEstimator()
    now = answered(path, [8000] * 8, 20, 800)
    for key, size_bytes in enumerate((8000, *sizes)):
        path.sent(key, size_bytes, now)
        now += 300 * MS if key == 0 else round_trip_ns(size_bytes, 20, ns_per_byte)
        path.answered(key, now)
    return path.sustained_bytes(100 * MS, now)


def test_a_stall_is_forgotten_once_a_packet_is_as_quick_as_before() -> None:
    assert after_a_slow_one(5000, ns_per_byte=800) > TRUE_BYTES


def test_a_small_quick_packet_does_not_tell_a_stall_from_a_fallen_rate() -> None:
    assert after_a_slow_one(300, ns_per_byte=800) < 0.5 * TRUE_BYTES


def test_a_second_slow_packet_confirms_that_the_rate_fell() -> None:
    assert after_a_slow_one(5000, 5000, ns_per_byte=35_000) < 0.1 * TRUE_BYTES


def test_packets_without_answer_are_forgotten() -> None:
    path = PathEstimator()
    path.sent("a", 1000, 0)
    assert path.bytes_in_flight == 1000
    path.lost("a")
    path.lost("unknown")
    path.answered("unknown", 5)
    assert path.bytes_in_flight == 0
    with pytest.raises(InvalidInput, match=r"packet\.size_bytes: 0"):
        path.sent("b", 0, 0)


def test_the_shortest_round_trip_is_forgotten_after_ten_seconds() -> None:
    path = PathEstimator()
    assert path.min_rtt_ns == 0
    for key, (sent_ms, rtt_ms) in enumerate([(0, 20), (1_000, 35), (5_000, 30), (10_100, 40)]):
        path.sent(key, 1000, sent_ms * MS)
        path.answered(key, (sent_ms + rtt_ms) * MS)
    assert path.min_rtt_ns == 30 * MS, "20 ms came 10.12 s ago, 35 ms was undercut"


def test_a_wait_behind_another_packet_is_not_the_paths() -> None:
    """Two packets sent at once: the second is answered when the bottleneck has had both."""
    path = PathEstimator()
    now = answered(path, [1000] * 8, 20, 1000)
    path.sent("first", 10_000, now)
    path.sent("second", 10_000, now)
    path.answered("first", now + 20 * MS + 10_000 * 1000)
    path.answered("second", now + 20 * MS + 20_000 * 1000)
    cost = 100 * MS / path.sustained_bytes(100 * MS, now + 40 * MS)
    assert cost == pytest.approx(1000, rel=0.02), "1900 if the wait counted as the path's time"


@given(
    packets=st.lists(
        st.tuples(st.integers(0, 100), st.integers(200, 20_000)), min_size=1, max_size=15
    ),
    ns_per_byte=st.integers(400, 40_000),
    downloads_ms=st.lists(st.tuples(st.integers(0, 300), st.integers(1, 900)), max_size=4),
)
@example(
    packets=[(0, 7000), (10, 7000), (10, 7000)], ns_per_byte=4000, downloads_ms=[(0, 500)]
).via("answers that came together proved 61 Tbit/s")
def test_answers_that_wait_behind_downloads_prove_no_more_than_the_path_has(
    packets: list[tuple[int, int]], ns_per_byte: int, downloads_ms: list[tuple[int, int]]
) -> None:
    """An answer that would come while something is downloaded comes at the download's end."""
    spans, free_ms = [], 0
    for gap_ms, length_ms in downloads_ms:
        spans.append(((free_ms + gap_ms) * MS, (free_ms + gap_ms + length_ms) * MS))
        free_ms += gap_ms + length_ms + 1

    def own_wait_ns(since_ns: int, until_ns: int) -> int:
        return sum(max(0, min(until_ns, end) - max(since_ns, start)) for start, end in spans)

    path, sent_ns, delivered_ns = PathEstimator(own_wait_ns), 0, 0
    events = []
    for key, (gap_ms, size_bytes) in enumerate(packets):
        sent_ns += gap_ms * MS
        delivered_ns = max(delivered_ns, sent_ns) + ns_per_byte * size_bytes
        held = [end for start, end in spans if start <= delivered_ns < end]
        events += [(sent_ns, 0, key), (max([delivered_ns, *held]), 1, key)]
    for now_ns, is_answer, key in sorted(events):
        if is_answer:
            path.answered(key, now_ns)
        else:
            path.sent(key, packets[key][1], now_ns)
    assert (path.rate_bps or 0.0) <= 8e9 / ns_per_byte * (1 + 1e-6)
