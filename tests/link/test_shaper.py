"""Laws of the link: busy time, order, never early, no drift, work conserving; and its meter."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.errors import InvalidInput
from rfcore.link.plan import Arrival, delivery_times
from rfcore.link.shaper import BusyMeter, Link, LinkProfile

profiles = st.builds(
    LinkProfile,
    rate_bps=st.integers(1_000, 1_000_000_000).map(float),
    delay_s=st.sampled_from([0.0, 0.001, 0.02, 0.5]),
)
schedules = st.lists(
    st.builds(
        Arrival,
        at_s=st.integers(0, 5_000_000).map(lambda us: us / 1e6),
        size_bytes=st.integers(1, 70_000),
    ),
    min_size=1,
    max_size=60,
).map(lambda arrivals: sorted(arrivals, key=lambda a: a.at_s))


def tau_s(profile: LinkProfile, size_bytes: int) -> float:
    """The paper's tau: the seconds that so many bytes occupy the link."""
    return size_bytes * 8 / profile.rate_bps


def within(seconds: float) -> float:
    """Two roundings of float64 at the magnitude of ``seconds``, per arithmetic step."""
    return 8 * (1.0 + abs(seconds)) * 2**-52


@given(profiles, schedules)
def test_packets_keep_their_order_and_are_never_early(
    profile: LinkProfile, schedule: list[Arrival]
) -> None:
    times = delivery_times(profile, schedule)
    assert times == sorted(times)
    for arrival, due_s in zip(schedule, times, strict=True):
        earliest = arrival.at_s + tau_s(profile, arrival.size_bytes) + profile.delay_s
        assert due_s >= earliest - within(due_s)


@given(profiles, schedules)
def test_the_link_rests_only_when_it_has_nothing_to_send(
    profile: LinkProfile, schedule: list[Arrival]
) -> None:
    """Lindley's recursion, the textbook form, is the oracle of the busy-period arithmetic."""
    end_s = 0.0
    for arrival, due_s in zip(schedule, delivery_times(profile, schedule), strict=True):
        end_s = max(end_s, arrival.at_s) + tau_s(profile, arrival.size_bytes)
        assert due_s == pytest.approx(end_s + profile.delay_s, rel=1e-12, abs=1e-12)


@given(profiles, st.lists(st.integers(1, 10**6), min_size=1, max_size=50))
def test_a_burst_keeps_the_link_busy_for_exactly_its_bits_over_the_rate(
    profile: LinkProfile, sizes: list[int]
) -> None:
    times = delivery_times(profile, [Arrival(0.0, size) for size in sizes])
    assert times[-1] == sum(sizes) * 8 / profile.rate_bps + profile.delay_s


def test_a_hundred_thousand_packets_do_not_drift() -> None:
    profile = LinkProfile(rate_bps=3e6)
    times = delivery_times(profile, [Arrival(0.0, 1001)] * 100_000)
    assert times[-1] == 100_000 * 1001 * 8 / 3e6


@given(profiles, st.lists(st.integers(1, 5_000), min_size=1, max_size=30), st.floats(0, 3))
def test_a_late_driver_does_not_delay_the_packets_behind(
    profile: LinkProfile, sizes: list[int], late_s: float
) -> None:
    link: Link[int] = Link(LinkProfile(profile.rate_bps, profile.delay_s, 2**40))
    first = [link.push(i, size, 0.0).due_s for i, size in enumerate(sizes)]
    link.pop_due(late_s)
    again = link.push(len(sizes), 1000, 0.0).due_s
    assert again == pytest.approx(first[-1] + tau_s(profile, 1000))


def test_only_what_is_due_is_popped_and_the_next_event_is_named() -> None:
    link: Link[str] = Link(LinkProfile(rate_bps=8000.0, delay_s=0.5))
    assert link.next_event_at() is None
    link.push("a", 1000, now=10.0)
    link.push("b", 500, now=10.0)
    assert link.next_event_at() == 11.5
    assert link.pop_due(11.499) == []
    assert [d.item for d in link.pop_due(11.5)] == ["a"]
    assert link.next_event_at() == 12.0
    assert [d.item for d in link.pop_due(99.0)] == ["b"]
    assert link.held_bytes == 0


def test_a_full_link_refuses_more_and_takes_it_when_the_first_was_sent() -> None:
    link: Link[str] = Link(LinkProfile(rate_bps=8000.0, queue_limit_bytes=1000))
    link.push("a", 1000, now=0.0)
    assert link.is_full(0.999)
    with pytest.raises(InvalidInput, match="1000 bytes are waiting"):
        link.push("b", 1, now=0.0)
    link.push("end", 0, now=0.0)
    assert link.room_at() == 1.0
    link.push("b", 1, now=1.0)


def test_what_is_in_propagation_does_not_count_against_the_queue() -> None:
    link: Link[str] = Link(LinkProfile(rate_bps=8e6, delay_s=0.1, queue_limit_bytes=1000))
    link.push("a", 1000, now=0.0)
    assert link.room_bytes(0.0005) == 0
    assert link.room_bytes(0.001) == 1000
    assert link.held_bytes == 1000
    assert link.room_at() is None


@pytest.mark.parametrize(
    ("rate_bps", "delay_s", "queue_limit_bytes", "named"),
    [
        (0.0, 0.0, 1, "link.rate_bps: 0.0"),
        (-4e6, 0.0, 1, "link.rate_bps"),
        (float("nan"), 0.0, 1, "link.rate_bps: nan"),
        (float("inf"), 0.0, 1, "link.rate_bps: inf"),
        (4e6, -0.1, 1, "link.delay_s: -0.1"),
        (4e6, 200.0, 1, "link.delay_s: 200"),
        (4e6, 0.0, 0, "link.queue_limit_bytes: 0"),
    ],
)
def test_a_bad_profile_is_refused_by_name(
    rate_bps: float, delay_s: float, queue_limit_bytes: int, named: str
) -> None:
    with pytest.raises(InvalidInput, match=named):
        LinkProfile(rate_bps, delay_s, queue_limit_bytes)


def test_a_negative_size_is_refused() -> None:
    with pytest.raises(InvalidInput, match=r"link.size_bytes: -1"):
        Link[str](LinkProfile(1e6)).push("a", -1, 0.0)


def test_a_schedule_out_of_order_is_refused() -> None:
    with pytest.raises(InvalidInput, match=r"schedule\[1\].at_s: 1.0 s is before 2.0 s"):
        delivery_times(LinkProfile(1e6), [Arrival(2.0, 1), Arrival(1.0, 1)])


# --- the meter reports what happened, not what was planned


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
