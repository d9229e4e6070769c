"""Curves whose BD-rate is known by algebra, and the published implementation as an oracle."""

from dataclasses import replace
from itertools import pairwise

import bjontegaard
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rfcore.errors import InvalidInput
from rfedge.evaluate.clips import CodedClip
from rfedge.evaluate.rate_curve import (
    LPIPS,
    SSIM,
    RateCurve,
    bd_rate_interval,
    bd_rate_percent,
    rate_curve,
)

DECIBELS = np.array([28.0, 29.5, 31.0, 33.0, 35.0, 37.0])
BYTES = np.exp(np.array([7.0, 7.4, 7.9, 8.6, 9.2, 9.9]))
ANCHOR = RateCurve(DECIBELS, BYTES)


def clips(rate_factor, frames=12, seed=3):
    """Clips along ANCHOR, frames of unequal size, all rates times ``rate_factor``."""
    share = np.random.default_rng(seed).uniform(0.5, 1.5, frames)
    share /= share.mean()
    return [
        CodedClip(
            point,
            np.round(rate * rate_factor * share * 1000).astype(np.int64),
            np.full(frames, 255.0**2 / 10 ** (db / 10)),
            np.ones(frames),
            1.0,
        )
        for point, (db, rate) in enumerate(zip(DECIBELS, BYTES, strict=True))
    ]


def test_swapping_curves_inverts_the_ratio():
    test = RateCurve(DECIBELS + 0.7, BYTES * 0.8)
    there = bd_rate_percent(ANCHOR, test, (30, 36))
    back = bd_rate_percent(test, ANCHOR, (30, 36))
    assert (1 + there / 100) * (1 + back / 100) == pytest.approx(1, abs=1e-12)


def test_a_point_on_the_curve_is_returned_as_it_is():
    assert ANCHOR.bytes_at(33.0) == pytest.approx(BYTES[3], rel=1e-12)


@pytest.mark.parametrize("window", [(27.9, 35), (30, 37.1)])
def test_a_window_the_curve_does_not_span_is_refused_by_its_limits(window):
    with pytest.raises(InvalidInput, match=r"28\.00\.\.37\.00 dB"):
        bd_rate_percent(ANCHOR, ANCHOR, window)


def test_quality_is_the_psnr_of_the_mean_error_not_the_mean_of_psnrs():
    mse = np.array([1.0, 99.0])
    points = [
        CodedClip(k, np.array([10, 10]) * (9 - k), mse * 2**k, np.ones(2), 0.0) for k in range(6)
    ]
    curve = rate_curve(points, slice(None))
    assert curve.psnr_db[-1] == pytest.approx(10 * np.log10(255**2 / 50))


def test_five_points_are_too_few():
    with pytest.raises(InvalidInput, match="5 points"):
        RateCurve(DECIBELS[:5], BYTES[:5])


def test_two_points_of_one_quality_are_refused():
    with pytest.raises(InvalidInput, match="differ"):
        RateCurve(np.array([28.0, 29, 29, 31, 32, 33]), BYTES)


def test_a_lossless_point_has_no_place_on_a_curve():
    with pytest.raises(InvalidInput, match="finite"):
        RateCurve(np.array([28.0, 29, 30, 31, 32, np.inf]), BYTES)


def test_the_interval_holds_the_figure_and_repeats_with_its_seed():
    anchor, test = clips(1, seed=3), clips(0.7, seed=4)
    window = (30.0, 36.0)
    low, high = bd_rate_interval(anchor, test, window, np.random.default_rng(1))
    curves = rate_curve(anchor, slice(1, None)), rate_curve(test, slice(1, None))
    assert low < bd_rate_percent(*curves, window) < high
    assert (low, high) == bd_rate_interval(anchor, test, window, np.random.default_rng(1))


def test_the_first_frame_is_never_drawn():
    """Bytes that differ in the first frame alone leave the interval of a ratio at that ratio."""
    test = [
        CodedClip(
            clip.point,
            np.concatenate([clip.frame_bytes[:1] * 1000, clip.frame_bytes[1:]]),
            clip.luma_mse,
            clip.ssim,
            1.0,
        )
        for clip in clips(0.5)
    ]
    interval = bd_rate_interval(clips(1), test, (30, 36), np.random.default_rng(1))
    assert interval == pytest.approx((-50, -50), abs=1e-2)


def test_more_frames_narrow_the_interval():
    def width(frames):
        anchor, test = clips(1, frames, seed=3), clips(0.7, frames, seed=4)
        low, high = bd_rate_interval(anchor, test, (30, 36), np.random.default_rng(1))
        return high - low

    assert width(400) < 0.5 * width(12)


def of_uneven_quality(clips):
    return [
        CodedClip(c.point, c.frame_bytes, c.luma_mse * np.linspace(0.2, 1.8, 12), c.ssim, 1.0)
        for c in clips
    ]


def test_an_interval_that_most_draws_leave_is_refused():
    uneven = of_uneven_quality(clips(1))
    window = (float(rate_curve(uneven, slice(1, None)).psnr_db[0]) + 0.01, 35.0)
    with pytest.raises(InvalidInput, match=r"only \d+ of 400 resampled clips span"):
        bd_rate_interval(uneven, uneven, window, np.random.default_rng(1))


def test_draws_that_leave_the_window_count_with_what_they_reach_of_it():
    uneven, half = of_uneven_quality(clips(1)), of_uneven_quality(clips(0.5))
    window = (float(rate_curve(uneven, slice(1, None)).psnr_db[0]) + 0.01, 35.0)

    def interval(least_share):
        rng = np.random.default_rng(1)
        return bd_rate_interval(uneven, half, window, rng, least_share=least_share)

    assert interval(0.2) == pytest.approx((-50, -50), abs=1e-2)
    with pytest.raises(InvalidInput, match="resampled clips span"):
        interval(0.99)


def test_frames_that_resemble_their_neighbours_widen_the_interval():
    """The same frames in order of their ratio and shuffled: blocks of the first differ more."""
    anchor, ratios = clips(1, 49), np.linspace(0.4, 0.9, 49)
    shuffled = np.random.default_rng(2).permutation(ratios)

    def width(factors):
        test = [replace(c, frame_bytes=(c.frame_bytes * factors).astype(np.int64)) for c in anchor]
        low, high = bd_rate_interval(anchor, test, (30, 36), np.random.default_rng(1))
        return high - low

    assert width(ratios) > 1.5 * width(shuffled)


def test_a_quality_in_decibels_counts_what_lacks_to_equal_pictures():
    assert [LPIPS.db(d) for d in (0.1, 0.01)] == pytest.approx([10, 20])
    assert [SSIM.db(s) for s in (0.9, 0.99)] == pytest.approx([10, 20])


def test_a_curve_over_ssim_is_of_the_mean_over_frames():
    ssim = np.array([0.1, 0.90, 0.94])
    points = [
        CodedClip(k, np.array([9, 8, 8]) * (9 - k), np.ones(3), ssim - 0.01 * k, 0.0)
        for k in range(6)
    ]
    curve = SSIM.curve(points, slice(1, None))
    assert curve.psnr_db[-1] == pytest.approx(SSIM.db(0.92))
    assert curve.bytes_per_frame[-1] == 72


increments = st.lists(st.floats(0.3, 4.0), min_size=7, max_size=7)
factors = st.floats(0.05, 20.0)


def curve_of(decibel_steps, log_steps):
    return RateCurve(28 + np.cumsum(decibel_steps), np.exp(5 + np.cumsum(log_steps) / 4))


@settings(max_examples=30)
@given(increments, increments)
def test_a_curve_against_itself_is_nought(decibels, logs):
    curve = curve_of(decibels, logs)
    window = (float(curve.psnr_db[0]), float(curve.psnr_db[-1]))
    assert bd_rate_percent(curve, curve, window) == 0


@settings(max_examples=30)
@given(increments, increments, factors)
def test_times_k_the_bytes_are_k_minus_one_more_in_any_window(decibels, logs, factor):
    curve = curve_of(decibels, logs)
    test = RateCurve(curve.psnr_db, factor * curve.bytes_per_frame)
    low, high = float(curve.psnr_db[0]), float(curve.psnr_db[-1])
    for window in ((low, high), (low, (low + high) / 2), (curve.psnr_db[2], curve.psnr_db[3])):
        assert bd_rate_percent(curve, test, window) == pytest.approx(100 * (factor - 1), rel=1e-6)


@settings(max_examples=30)
@given(increments, increments, increments)
def test_the_figure_of_a_window_lies_between_those_of_its_halves(decibels, logs, other):
    anchor, test = curve_of(decibels, logs), curve_of(decibels, other)
    low, high = float(anchor.psnr_db[0]), float(anchor.psnr_db[-1])
    middle = (low + high) / 2
    halves = [bd_rate_percent(anchor, test, w) for w in ((low, middle), (middle, high))]
    assert min(halves) - 1e-6 <= bd_rate_percent(anchor, test, (low, high)) <= max(halves) + 1e-6


@settings(max_examples=30)
@given(increments, increments, increments)
def test_any_curves_have_the_published_implementations_figure(decibels, logs, other):
    anchor, test = curve_of(decibels, logs), curve_of(decibels, other)
    window = (float(anchor.psnr_db[0]), float(anchor.psnr_db[-1]))
    theirs = bjontegaard.bd_rate(
        anchor.bytes_per_frame, anchor.psnr_db, test.bytes_per_frame, test.psnr_db, method="pchip"
    )
    assert bd_rate_percent(anchor, test, window) == pytest.approx(theirs, rel=1e-6, abs=1e-6)


@settings(max_examples=30)
@given(increments, increments)
def test_a_better_quality_never_takes_fewer_bytes_where_points_do_not(decibels, logs):
    curve = curve_of(decibels, logs)
    at = [curve.bytes_at(db) for db in np.linspace(curve.psnr_db[0], curve.psnr_db[-1], 50)]
    assert all(a <= b * (1 + 1e-12) for a, b in pairwise(at))


def test_points_of_one_quality_count_once_at_the_fewest_bytes():
    several = clips(1.0)
    dearer = CodedClip(9, several[0].frame_bytes * 2, several[0].luma_mse, np.ones(12), 1.0)
    curve = rate_curve([dearer, *several], slice(None))
    np.testing.assert_array_equal(curve.psnr_db, rate_curve(several, slice(None)).psnr_db)
    np.testing.assert_array_equal(
        curve.bytes_per_frame, rate_curve(several, slice(None)).bytes_per_frame
    )
