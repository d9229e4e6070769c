"""A Mahimahi trace gives what it says, never more, never sooner; its oracle is a plain loop."""

import itertools
from bisect import bisect_right
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.errors import InvalidData
from rfcore.link.plan import Arrival, DirectionPlan, delivery_times
from rfcore.link.shaper import LinkProfile
from rfcore.link.traces import CapacityTrace, TraceTransmission, read_mahimahi

SAMPLES = Path(__file__).parents[2] / "samples" / "links"

traces = (
    st.lists(st.integers(0, 300), min_size=1, max_size=30)
    .map(lambda times: CapacityTrace(tuple(sorted([*times, 300]))))
)  # fmt: skip
schedules = st.lists(
    st.builds(
        Arrival,
        at_s=st.integers(0, 2_000).map(lambda ms: ms / 1e3),
        size_bytes=st.integers(1, 9_000),
    ),
    min_size=1,
    max_size=25,
).map(lambda arrivals: sorted(arrivals, key=lambda a: a.at_s))


def through(trace: CapacityTrace, schedule: list[Arrival]) -> list[float]:
    plan = DirectionPlan(LinkProfile(trace.mean_rate_bps), (trace,))
    return delivery_times(plan, schedule)


def opportunities(trace: CapacityTrace, until_s: float) -> list[float]:
    """Every opportunity of the repeated trace up to ``until_s``, in seconds."""
    period_ms = trace.times_ms[-1]
    rounds = range(int(until_s * 1e3 // period_ms) + 1)
    return [(number * period_ms + t) / 1e3 for number in rounds for t in trace.times_ms]


def by_a_loop(trace: CapacityTrace, schedule: list[Arrival]) -> list[float]:
    """Mahimahi as it works: at each opportunity, 1500 bytes of what waits leave."""
    waiting = [[a.at_s, a.size_bytes, None] for a in schedule]
    needed_s = schedule[-1].at_s + trace.period_s * (
        2 + sum(a.size_bytes for a in schedule) // 1500
    )
    for time_s in opportunities(trace, needed_s):
        left = 1500
        for packet in waiting:
            if packet[2] is None and packet[0] <= time_s and left:
                taken = min(left, packet[1])
                packet[1] -= taken
                left -= taken
                if not packet[1]:
                    packet[2] = time_s
    return [packet[2] for packet in waiting]


@given(traces, schedules)
def test_a_trace_delivers_when_a_plain_loop_does(
    trace: CapacityTrace, schedule: list[Arrival]
) -> None:
    assert through(trace, schedule) == by_a_loop(trace, schedule)


@given(traces, schedules)
def test_no_window_of_time_lets_more_through_than_its_opportunities(
    trace: CapacityTrace, schedule: list[Arrival]
) -> None:
    times = through(trace, schedule)
    chances = opportunities(trace, times[-1])
    for first in range(len(times)):
        before_s = times[first - 1] if first else -1.0
        sent = sum(a.size_bytes for a, t in zip(schedule, times, strict=True) if before_s < t)
        inside = bisect_right(chances, times[-1]) - bisect_right(chances, before_s)
        carried_over = max(a.size_bytes for a in schedule)
        assert sent <= 1500 * inside + carried_over


def test_small_packets_share_an_opportunity_and_a_large_one_takes_several() -> None:
    trace = CapacityTrace((10, 10, 20, 30))
    packets = [Arrival(0.0, 700), Arrival(0.0, 800), Arrival(0.0, 3001)]
    assert through(trace, packets) == [0.010, 0.010, 0.030]


def test_a_long_rest_is_skipped_at_once() -> None:
    """Nine years of wraps in one step, since the position is computed and not walked."""
    transmission = TraceTransmission(CapacityTrace((1, 1000)))
    assert transmission.schedule(100, 3e8 + 0.5) == (3e8 + 0.5, 3e8 + 1.0)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "0 delivery opportunities"),
        ("0\n0\n", "every opportunity is at 0 ms"),
        ("5\n4\n", "line 2: 4 ms comes after 5 ms"),
        ("1\nx\n", "line 2: 'x' must be a whole"),
        ("1\n-2\n", "line 2: '-2' must be a whole"),
        ("1\n2.5\n", "must be a whole"),
        ("1\nnan\n", "must be a whole"),
        ("9" * 5000, "must be a whole"),
    ],
)
def test_a_file_that_is_no_trace_is_refused_by_line(
    text: str, problem: str, tmp_path: Path
) -> None:
    (tmp_path / "t.up").write_text(text)
    with pytest.raises(InvalidData, match=problem):
        read_mahimahi(tmp_path / "t.up")


@given(st.binary(max_size=200))
def test_no_bytes_make_the_reader_fail_otherwise(data: bytes) -> None:
    path = Path("/dev/shm") / "rfedge-trace-fuzz"
    path.write_bytes(data)
    try:
        assert read_mahimahi(path).mean_rate_bps > 0
    except InvalidData:
        pass
    finally:
        path.unlink()


def test_the_sample_trace_has_the_rate_and_the_gaps_it_claims() -> None:
    trace = read_mahimahi(SAMPLES / "drive.up")
    assert trace.period_s == 30.0
    gaps_ms = [b - a for a, b in itertools.pairwise(trace.times_ms)]
    assert max(gaps_ms) >= 600
    assert 1e6 < trace.mean_rate_bps < 4e6
