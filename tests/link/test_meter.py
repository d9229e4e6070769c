"""The meter reports what happened, not what was planned."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.link import Link, LinkProfile
from rfcore.link.shaper import BusyMeter


def measure(profile: LinkProfile, pushes: list[tuple[float, int]], late_s: float) -> BusyMeter:
    """Push everything, then release each packet ``late_s`` after it is due."""
    link: Link[int] = Link(LinkProfile(profile.rate_bps, profile.delay_s, 2**40))
    meter = BusyMeter()
    for at_s, size_bytes in pushes:
        link.push(0, size_bytes, at_s)
    for delivery in link.pop_due(1e9):
        meter.released(delivery, delivery.due_s + late_s)
    return meter


@given(
    st.lists(
        st.tuples(st.integers(0, 1_000_000).map(lambda us: us / 1e6), st.integers(1, 20_000)),
        min_size=1,
        max_size=40,
    ).map(sorted),
    st.sampled_from([0.0, 0.02]),
)
def test_a_punctual_driver_measures_bytes_over_rate(
    pushes: list[tuple[float, int]], delay_s: float
) -> None:
    meter = measure(LinkProfile(4e6, delay_s), pushes, late_s=0.0)
    assert meter.busy_s == pytest.approx(meter.expected_s, rel=1e-9)
    assert meter.wire_bytes == sum(size for _, size in pushes)


def test_a_late_release_shows_once_per_busy_period() -> None:
    profile = LinkProfile(8e3, delay_s=0.5)
    meter = measure(profile, [(0.0, 1000), (0.0, 1000), (10.0, 1000)], late_s=0.1)
    assert meter.busy_s == pytest.approx(3.0 + 2 * 0.1)
    assert meter.tau_error_percent == pytest.approx(100 * 0.2 / 3)
    assert meter.largest_lateness_s == pytest.approx(0.1)


def test_an_interval_is_not_counted_twice_when_late_periods_overlap() -> None:
    profile = LinkProfile(8e3)
    meter = measure(profile, [(0.0, 1000), (1.05, 1000)], late_s=0.1)
    assert meter.busy_s == pytest.approx(2.15), "from 0 to 2.15 without a pause"


def test_an_unused_link_has_no_error_to_report() -> None:
    meter = BusyMeter()
    assert (meter.busy_s, meter.expected_s, meter.tau_error_percent) == (0.0, 0.0, None)
