"""Frames wait for both processors and the link: by arithmetic, and by laws of any such queue."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lab.latency.run import WINDOW, AheadWork, FrameWork, play, show
from rfcore.link.plan import DirectionPlan
from rfcore.link.shaper import LinkProfile

QUICK = DirectionPlan(LinkProfile(1e12))
works = st.builds(FrameWork, st.integers(100, 50_000), st.floats(0.0, 400.0), st.floats(0.0, 400.0))


def frames(count: int, sender_ms: float = 0.0, receiver_ms: float = 0.0) -> list[FrameWork]:
    return [FrameWork(1000, sender_ms, receiver_ms)] * count


def test_without_waiting_a_frame_takes_what_both_ends_and_the_link_take():
    link = DirectionPlan(LinkProfile(1e6, delay_s=0.02))  # 8 ms of transmission, 20 on the way
    shown = show(frames(5, sender_ms=30, receiver_ms=12), 10, link)
    np.testing.assert_allclose(shown.latency_ms, [30 + 8 + 20 + 12] * 5)
    assert shown.dropped == 0
    assert (shown.sender_busy, shown.receiver_busy) == pytest.approx((0.3, 0.12))


def test_a_vehicle_that_is_too_slow_codes_the_newest_picture_and_drops_the_others():
    """150 ms of work at 10 Hz: every second picture waits 50 ms, every third is overtaken."""
    shown = show(frames(10, sender_ms=150), 10, QUICK)
    np.testing.assert_allclose(shown.latency_ms, [*[150, 200] * 3, 150], atol=1e-3)
    assert (shown.dropped, shown.frames) == (3, 10)
    assert shown.sender_busy == pytest.approx(1.0, abs=0.01)


def test_a_server_that_is_too_slow_makes_frames_wait_and_then_the_vehicle():
    shown = show(frames(5, receiver_ms=150), 10, QUICK)
    # Shown at 150, 300, 450, 600 ms, ...; the fourth is coded at 300, when the second is shown.
    np.testing.assert_allclose(shown.latency_ms[:4], [150, 200, 250, 300], atol=1e-3)


def test_a_slow_frame_delays_those_behind_it():
    work = frames(4, sender_ms=10)
    work[1] = FrameWork(1000, 180.0, 0.0)
    np.testing.assert_allclose(show(work, 10, QUICK).latency_ms, [10, 180, 90, 10], atol=1e-3)


def test_dropped_frames_are_late_in_shares_and_quantiles():
    shown = show(frames(10, sender_ms=150), 10, QUICK)
    assert shown.share_within(160) == pytest.approx(4 / 10)
    assert shown.quantile_ms(0.25) == pytest.approx(150, abs=1e-3)
    assert shown.quantile_ms(0.99) == np.inf


def test_with_the_pose_ahead_the_server_works_while_the_vehicle_codes_and_the_slice_travels():
    link = DirectionPlan(LinkProfile(1e6, delay_s=0.02))  # 8 ms of a frame, 0.12 of a pose
    work = [FrameWork(1000, 30.0, 28.0, AheadWork(15, 2.0, 24.0))] * 5
    shown = show(work, 10, link)
    np.testing.assert_allclose(shown.latency_ms, [30 + 8 + 20 + 4] * 5)
    late = [FrameWork(1000, 30.0, 58.0, AheadWork(15, 2.0, 54.0))] * 5
    np.testing.assert_allclose(show(late, 10, link).latency_ms, [2 + 0.12 + 20 + 54 + 4] * 5)


@given(st.lists(works, min_size=1, max_size=40), st.floats(0.5, 60.0), st.floats(1e5, 1e8))
def test_laws(work, rate_hz, rate_bps):
    shown = show(work, rate_hz, DirectionPlan(LinkProfile(rate_bps, delay_s=0.01)))
    assert shown.frames == len(work)
    least_ms = min(
        each.sender_ms + 8e3 * each.size_bytes / rate_bps + 10 + each.receiver_ms for each in work
    )
    assert shown.latency_ms.min() >= least_ms - 1e-6
    assert 0 <= shown.sender_busy <= 1 + 1e-9
    assert 0 <= shown.receiver_busy <= 1 + 1e-9
    # With at most ``WINDOW`` under way, a frame waits for no more than those, and for its turn.
    most_ms = max(
        each.sender_ms + 8e3 * each.size_bytes / rate_bps + 20 + each.receiver_ms for each in work
    )
    assert shown.latency_ms.max() <= (WINDOW + 1) * most_ms + 1e3 / rate_hz


@given(st.lists(st.integers(100, 20_000), min_size=1, max_size=40))
def test_without_computing_it_is_what_the_link_makes_of_frames_it_keeps_up_with(sizes):
    link = DirectionPlan(LinkProfile(8 * 20_000 * 10.0))  # the largest in one period
    played = play(sizes, 10, link)
    shown = show([FrameWork(size, 0.0, 0.0) for size in sizes], 10, link)
    assert played.dropped == shown.dropped == 0
    np.testing.assert_allclose(shown.latency_ms, played.network_ms, atol=1e-6)
