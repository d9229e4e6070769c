"""Times of capture, from sender reports or arrivals, and instants of several cameras."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cav_agent.live.source import CaptureClock, Stamp
from cav_agent.live_cameras import InstantClock
from rfcore.wire.values import ClockKind

MS, S = 1_000_000, 1_000_000_000
BEGAN = 1_700_000_000 * S


def test_a_senders_word_is_taken() -> None:
    clock = CaptureClock()
    stamp = clock.stamp(0, BEGAN + 80 * MS, BEGAN)
    assert stamp == Stamp(BEGAN, ClockKind.SENDER_REPORT)


def test_without_it_the_jitter_is_taken_out() -> None:
    clock = CaptureClock()
    delays = [50, 20, 90, 60, 20]
    stamps = [
        clock.stamp(i * 100 * MS, BEGAN + (i * 100 + delay) * MS, None)
        for i, delay in enumerate(delays)
    ]
    times = [(stamp.time_ns - BEGAN) // MS for stamp in stamps if stamp]
    assert times == [50, 120, 220, 320, 420]
    assert {stamp.clock for stamp in stamps if stamp} == {ClockKind.ARRIVAL}


def test_a_frame_held_up_is_as_old_as_it_is() -> None:
    clock = CaptureClock()
    clock.stamp(0, BEGAN, None)
    stamp = clock.stamp(100 * MS, BEGAN + 4 * S, None)  # a stall of the network
    assert stamp is not None
    assert stamp.time_ns == BEGAN + 100 * MS


def test_time_stamps_that_begin_anew_count_from_the_arrival() -> None:
    clock = CaptureClock()
    clock.stamp(3600 * S, BEGAN, None)
    stamp = clock.stamp(0, BEGAN + 100 * MS, None)
    assert stamp == Stamp(BEGAN + 100 * MS, ClockKind.ARRIVAL)


def test_the_first_report_leaves_out_frames_that_would_go_back() -> None:
    clock = CaptureClock()
    clock.stamp(0, BEGAN, None)
    assert clock.stamp(100 * MS, BEGAN + 100 * MS, BEGAN - 4 * MS) is None
    stamp = clock.stamp(200 * MS, BEGAN + 200 * MS, BEGAN + 96 * MS)
    assert stamp == Stamp(BEGAN + 96 * MS, ClockKind.SENDER_REPORT)


def test_a_senders_clock_that_is_wrong_is_not_believed() -> None:
    clock = CaptureClock()
    for i in range(3):
        at = BEGAN + i * 100 * MS
        assert clock.stamp(i * 100 * MS, at, at - 3600 * S) == Stamp(at, ClockKind.ARRIVAL)


def test_a_senders_clock_that_stands_still_is_given_up() -> None:
    clock = CaptureClock()
    stamps = [clock.stamp(None, BEGAN + i * 100 * MS, BEGAN) for i in range(20)]
    assert stamps[0] == Stamp(BEGAN, ClockKind.SENDER_REPORT)
    assert stamps[1:11] == [None] * 10
    assert all(stamp and stamp.clock is ClockKind.ARRIVAL for stamp in stamps[12:])


def test_this_machines_clock_may_be_set_back() -> None:
    clock = CaptureClock(after_ns=BEGAN + 3600 * S)
    stamps = [clock.stamp(i * 100 * MS, BEGAN + i * 100 * MS, None) for i in range(20)]
    assert any(stamps)
    assert stamps[-1] == Stamp(BEGAN + 1900 * MS, ClockKind.ARRIVAL)


TIMES = st.integers(0, 20 * S)


@given(st.lists(st.tuples(st.none() | TIMES, TIMES, st.none() | TIMES), max_size=60))
def test_times_never_lie_ahead_of_the_arrival(
    frames: list[tuple[int | None, int, int | None]],
) -> None:
    clock = CaptureClock()
    for pts_ns, after_ns, sender_ns in frames:
        received_ns = BEGAN + after_ns
        stamp = clock.stamp(pts_ns, received_ns, sender_ns and BEGAN + sender_ns)
        assert stamp is None or 0 < stamp.time_ns <= received_ns


# --- when the live cameras of a rig are due together: in phase or not, with one late, or lost


@pytest.fixture
def clock() -> InstantClock:
    """Three cameras at 10 Hz that sent lately."""
    clock = InstantClock(3, 10.0)
    clock.taken([0.0, 0.0, 0.0])
    return clock


def test_nothing_is_due_without_a_frame(clock: InstantClock) -> None:
    assert clock.due_s([None, None, None]) is None


def test_an_instant_is_due_at_once_when_every_camera_has_a_new_frame(clock: InstantClock) -> None:
    assert clock.due_s([0.11, 0.10, 0.14]) == 0.10


def test_a_camera_that_is_late_is_waited_for_half_a_period(clock: InstantClock) -> None:
    assert clock.due_s([0.10, None, 0.12]) == pytest.approx(0.15)


def test_a_camera_that_was_lost_is_not_waited_for(clock: InstantClock) -> None:
    for at in (0.1, 0.2, 0.3, 0.4):
        clock.taken([at, None, at])
    assert clock.due_s([0.5, None, 0.5]) == 0.5
    assert clock.due_s([0.5, None, None]) == pytest.approx(0.55)
    clock.taken([0.5, 0.52, 0.5])
    assert clock.due_s([0.6, None, 0.6]) == pytest.approx(0.65)


def test_a_camera_that_never_sent_is_not_waited_for() -> None:
    assert InstantClock(2, 10.0).due_s([0.3, None]) == 0.3
