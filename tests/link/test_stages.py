"""Jitter, delay traces, outages, lost connections: laws each has to keep, whatever is drawn."""

import math
from collections.abc import Callable
from pathlib import Path
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.errors import InvalidData, InvalidInput
from rfcore.link.plan import (
    Arrival,
    DirectionPlan,
    Impairment,
    Jitter,
    JitterDistribution,
    LinkPlan,
    Outage,
    RandomOutage,
    delivery_times,
)
from rfcore.link.shaper import ConstantRate, LinkParts, LinkProfile
from rfcore.link.traces import CapacityTrace, DelayTrace, read_cicv5g

SAMPLES = Path(__file__).parents[2] / "samples" / "links"

PROFILE = LinkProfile(1e6, 0.02)
MS = st.integers(0, 4_000).map(lambda ms: ms / 1e3)
schedules = st.lists(
    st.builds(Arrival, at_s=MS, size_bytes=st.integers(1, 9_000)), min_size=1, max_size=30
).map(lambda arrivals: sorted(arrivals, key=lambda a: a.at_s))
impairments: st.SearchStrategy[Impairment] = st.one_of(
    st.builds(Jitter, st.floats(0, 1), st.sampled_from(JitterDistribution)),
    st.builds(RandomOutage, st.floats(0.01, 2), st.floats(0.01, 2)),
    st.just(Outage(((0.0, 0.1), (0.5, 1.5)), repeat_s=2.0)),
    st.just(Outage(((1.0, 3.0),))),
    st.just(DelayTrace((0.0, 0.5, 1.0), (0.5, 0.0, 0.1))),
    st.just(CapacityTrace((5, 5, 100, 400))),
)


def within(seconds: float) -> float:
    """Roundings of float64 at the magnitude of ``seconds``, a few dozen of them."""
    return 64 * (1.0 + abs(seconds)) * 2**-52


# --- laws of any combination


@given(st.lists(impairments, max_size=3), schedules, st.text(max_size=3))
def test_whatever_the_stages_every_packet_arrives_in_order_and_after_it_was_sent(
    named: list[Impairment], schedule: list[Arrival], seed: str
) -> None:
    times = delivery_times(DirectionPlan(PROFILE, tuple(named), seed), schedule)
    assert len(times) == len(schedule)
    assert all(map(math.isfinite, times))
    assert times == sorted(times)
    for arrival, due_s in zip(schedule, times, strict=True):
        assert due_s >= arrival.at_s + PROFILE.delay_s - within(due_s)


@given(st.lists(impairments, max_size=3), schedules, st.text(max_size=3))
def test_the_same_seed_gives_the_same_times(
    named: list[Impairment], schedule: list[Arrival], seed: str
) -> None:
    plan = DirectionPlan(PROFILE, tuple(named), seed)
    assert delivery_times(plan, schedule) == delivery_times(plan, schedule)


@given(st.lists(impairments, max_size=3), schedules, st.integers(1, 50_000))
def test_bytes_are_conserved_and_the_queue_never_holds_more_than_it_may(
    named: list[Impairment], schedule: list[Arrival], limit_bytes: int
) -> None:
    link = DirectionPlan(LinkProfile(1e6, 0.02, limit_bytes), tuple(named), "s").link()
    pushed = popped = 0
    for arrival in schedule:
        size_bytes = min(arrival.size_bytes, link.room_bytes(arrival.at_s))
        link.push(None, size_bytes, arrival.at_s)
        pushed += size_bytes
        popped += sum(d.size_bytes for d in link.pop_due(arrival.at_s))
        assert link.held_bytes == pushed - popped
        assert 0 <= link.room_bytes(arrival.at_s) <= limit_bytes
    assert popped + sum(d.size_bytes for d in link.pop_due(1e9)) == pushed
    assert link.held_bytes == 0
    assert link.next_event_at() is None


@given(st.lists(impairments, min_size=1, max_size=2), schedules)
def test_no_impairment_makes_a_link_faster(
    named: list[Impairment], schedule: list[Arrival]
) -> None:
    slower = [stage for stage in named if stage.name != "trace"]  # a trace is another rate
    plain = delivery_times(PROFILE, schedule)
    staged = delivery_times(DirectionPlan(PROFILE, tuple(slower), "s"), schedule)
    for before_s, after_s in zip(plain, staged, strict=True):
        assert after_s >= before_s - within(after_s)


# --- each stage


def test_an_outage_stops_a_packet_halfway_and_lets_it_go_on() -> None:
    """A second of transmission that begins 0.4 s before an outage of 2 s ends 0.6 s after it."""
    plan = DirectionPlan(LinkProfile(8e3), (Outage(((1.0, 3.0),)),))
    assert delivery_times(plan, [Arrival(0.6, 1000)]) == [pytest.approx(3.6)]
    assert delivery_times(plan, [Arrival(0.0, 1000)]) == [pytest.approx(1.0)], "just in time"
    assert delivery_times(plan, [Arrival(2.0, 1000)]) == [pytest.approx(4.0)], "came meanwhile"
    assert delivery_times(plan, [Arrival(3.0, 1000)]) == [pytest.approx(4.0)]


def test_outages_repeat() -> None:
    plan = DirectionPlan(LinkProfile(8e6), (Outage(((1.0, 1.5),), repeat_s=2.0),))
    times = delivery_times(plan, [Arrival(t, 1) for t in (0.5, 1.2, 3.2, 1001.2)])
    assert times == [pytest.approx(t, abs=2e-6) for t in (0.5, 1.5, 3.5, 1001.5)]


@given(st.integers(0, 1000), st.floats(0.05, 1), st.floats(0.05, 1))
def test_random_outages_take_the_share_of_time_that_their_means_say(
    seed: int, up_s: float, down_s: float
) -> None:
    windows = RandomOutage(up_s, down_s).windows(Random(seed))
    taken = [next(windows) for _ in range(2000)]
    out_s = sum(end - begin for begin, end in taken)
    share = out_s / taken[-1][1]
    # The sum of n exponentials has a relative spread of 1/sqrt(n): six of them, for both means.
    assert share == pytest.approx(down_s / (up_s + down_s), rel=12 / math.sqrt(2000))


def test_an_outage_after_hours_costs_no_memory() -> None:
    outage = Outage(((0.5, 1.0),), repeat_s=1.0)
    transmission = outage.apply(LinkParts(ConstantRate(1e6)), Random(0)).transmission
    for second in range(20_000):
        transmission.schedule(1, float(second))
    assert len(transmission._ahead) <= 3  # type: ignore[attr-defined]


@given(st.integers(0, 100), st.sampled_from(JitterDistribution))
def test_jitter_has_the_mean_of_its_distribution(
    seed: int, distribution: JitterDistribution
) -> None:
    """Packets far apart, so that none waits for another."""
    plan = DirectionPlan(LinkProfile(1e12), (Jitter(0.1, distribution),), str(seed))
    schedule = [Arrival(10.0 * i, 1) for i in range(1000)]
    extra = [d - a.at_s for d, a in zip(delivery_times(plan, schedule), schedule, strict=True)]
    mean_s, spread_s = (0.05, 0.029) if distribution is JitterDistribution.UNIFORM else (0.1, 0.1)
    assert sum(extra) / 1000 == pytest.approx(mean_s, abs=6 * spread_s / math.sqrt(1000))
    assert min(extra) >= -within(10_000.0)


def test_a_delay_trace_holds_each_sample_until_the_next_and_begins_again() -> None:
    trace = DelayTrace((0.0, 1.0, 2.0), (0.1, 0.2, 0.3))
    assert trace.period_s == 3.0
    assert [trace.delay_s(t) for t in (0.0, 0.99, 1.0, 2.5, 3.0, 4.2)] == [
        0.1, 0.1, 0.2, 0.3, 0.1, 0.2,
    ]  # fmt: skip


def test_a_cicv5g_recording_is_read_and_shared_between_directions(tmp_path: Path) -> None:
    (tmp_path / "d.txt").write_text(
        "pub_time(ms) sub_time(ms) delay(ms) utmX(m)\n1000 1040 40 1.5 \n1050 1070 20 1.6\n"
    )
    trace = read_cicv5g(tmp_path / "d.txt", share=0.25)
    assert trace.times_s == (0.0, 0.05)
    assert trace.delays_s == (0.01, 0.005)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "line 1 must begin with pub_time"),
        ("a b c\n", "line 1 must begin with pub_time"),
        ("pub_time(ms) sub_time(ms) delay(ms)\n1 2 3\n", "1 samples of delay"),
        ("pub_time(ms) sub_time(ms) delay(ms)\n1 2 3\nx y z\n", "line 3 has no three numbers"),
        ("pub_time(ms) sub_time(ms) delay(ms)\n1 2 3\n2 3\n", "line 3 has no three numbers"),
        ("pub_time(ms) sub_time(ms) delay(ms)\n1 2 nan\n2 3 4\n", "line 2: .* is not finite"),
        ("pub_time(ms) sub_time(ms) delay(ms)\n2 2 1\n1 3 4\n", "must begin at 0 and ascend"),
        ("pub_time(ms) sub_time(ms) delay(ms)\n1 2 3\n1 3 4\n", "every sample is at 0 s"),
        ("pub_time(ms) sub_time(ms) delay(ms)\n1 2 3\n2 3 -4\n", "is outside 0..60 s"),
    ],
)
def test_a_file_that_is_no_recording_is_refused(text: str, problem: str, tmp_path: Path) -> None:
    (tmp_path / "d.txt").write_text(text)
    with pytest.raises(InvalidData, match=problem):
        read_cicv5g(tmp_path / "d.txt")


def test_connections_live_as_long_as_they_should_on_average() -> None:
    direction = DirectionPlan(PROFILE)
    lives_s = LinkPlan(direction, direction, mean_life_s=5.0).connection_lives_s()
    assert lives_s is not None
    drawn = [next(lives_s) for _ in range(4000)]
    assert sum(drawn) / 4000 == pytest.approx(5.0, rel=6 / math.sqrt(4000))
    assert min(drawn) > 0


def test_adding_a_stage_changes_no_other_stages_chance(read: Callable[..., LinkPlan]) -> None:
    jitter = "rate_mbps = 1000.0\n[uplink.jitter]\nspread_ms = 100.0\n"
    tunnel = "[uplink.outage]\nmean_up_s = 1e5\nmean_down_s = 1.0\n"
    schedule = [Arrival(float(i), 10) for i in range(20)]
    alone = delivery_times(read(jitter).uplink, schedule)
    assert delivery_times(read(jitter + tunnel).uplink, schedule) == alone


@pytest.mark.parametrize(
    "make",
    [
        lambda: Outage(()),
        lambda: Outage(((2.0, 1.0),)),
        lambda: Outage(((1.0, 2.0), (1.5, 3.0))),
        lambda: Outage(((1.0, 2.0),), repeat_s=1.5),
        lambda: Outage(((float("nan"), 2.0),)),
        lambda: Jitter(-1.0),
        lambda: Jitter(float("nan")),
    ],
)
def test_a_value_that_makes_no_sense_is_refused(make: Callable[[], object]) -> None:
    with pytest.raises(InvalidInput):
        make()
