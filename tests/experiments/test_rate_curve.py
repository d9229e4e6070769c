"""Curves whose BD-rate is known by algebra, and the published implementation as an oracle."""

import bjontegaard
import numpy as np
import pytest

from rfcore.errors import InvalidInput
from rfedge.experiments.clips import CodedClip
from rfedge.experiments.rate_curve import RateCurve, bd_rate_interval, bd_rate_percent, rate_curve

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


@pytest.mark.parametrize("factor", [0.4, 1.0, 1.02, 3.0])
def test_a_curve_of_rates_times_a_factor_has_that_bd_rate(factor):
    test = RateCurve(DECIBELS, BYTES * factor)
    assert bd_rate_percent(ANCHOR, test, (29, 36)) == pytest.approx(100 * (factor - 1), abs=1e-9)


def test_swapping_curves_inverts_the_ratio():
    test = RateCurve(DECIBELS + 0.7, BYTES * 0.8)
    there = bd_rate_percent(ANCHOR, test, (30, 36))
    back = bd_rate_percent(test, ANCHOR, (30, 36))
    assert (1 + there / 100) * (1 + back / 100) == pytest.approx(1, abs=1e-12)


def test_over_the_whole_overlap_it_is_the_published_implementations_figure():
    test = RateCurve(DECIBELS + 0.9, BYTES * 0.9)
    window = (DECIBELS[0] + 0.9, DECIBELS[-1])
    theirs = bjontegaard.bd_rate(
        ANCHOR.bytes_per_frame,
        ANCHOR.psnr_db,
        test.bytes_per_frame,
        test.psnr_db,
        method="pchip",
    )
    assert bd_rate_percent(ANCHOR, test, window) == pytest.approx(theirs, abs=1e-9)


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


def test_the_interval_of_a_constant_ratio_is_that_ratio():
    low, high = bd_rate_interval(clips(1), clips(0.5), (30, 36), np.random.default_rng(1))
    assert low == pytest.approx(-50, abs=1e-2)  # bytes are whole numbers
    assert high == pytest.approx(-50, abs=1e-2)


def test_the_interval_holds_the_figure_and_repeats_with_its_seed():
    anchor, test = clips(1, seed=3), clips(0.7, seed=4)
    window = (30.0, 36.0)
    low, high = bd_rate_interval(anchor, test, window, np.random.default_rng(1))
    curves = rate_curve(anchor, slice(1, None)), rate_curve(test, slice(1, None))
    assert low < bd_rate_percent(*curves, window) < high
    assert (low, high) == bd_rate_interval(anchor, test, window, np.random.default_rng(1))


def test_points_of_one_quality_count_once_at_the_fewest_bytes():
    several = clips(1.0)
    dearer = CodedClip(9, several[0].frame_bytes * 2, several[0].luma_mse, np.ones(12), 1.0)
    curve = rate_curve([dearer, *several], slice(None))
    np.testing.assert_array_equal(curve.psnr_db, rate_curve(several, slice(None)).psnr_db)
    np.testing.assert_array_equal(
        curve.bytes_per_frame, rate_curve(several, slice(None)).bytes_per_frame
    )
