"""A load is held when every bound is kept, and a broken one is named."""

import math
from dataclasses import replace

import pytest

from rfedge.loadtest.plan import (
    Bounds,
    Measured,
    Resources,
    VehicleReport,
    judge,
    limit,
    nearest,
    share_at_least,
)

IDLE = Resources(0.1, 0.1, 0.1, 0.1, 0.2, 0.2, 0.0, 1.0)


def vehicle(on_time: int, due: int = 100, ms: float = 20.0) -> VehicleReport:
    return VehicleReport(due, [ms] * on_time)


def run_of(*vehicles: VehicleReport, growth_mb: float = 0.0) -> Measured:
    return Measured(vehicles, len(vehicles), growth_mb, 1.0, IDLE)


@pytest.mark.parametrize(
    ("successes", "trials", "lower"), [(10, 10, 0.7225), (95, 100, 0.8882), (0, 10, 0.0)]
)
def test_wilsons_bound_is_the_published_one(successes, trials, lower):
    """Against tables of the score interval (Newcombe 1998)."""
    assert share_at_least(successes, trials) == pytest.approx(lower, abs=5e-5)


def test_wilsons_bound_solves_its_equation():
    """The bound is the share p from which the observed one is 1.96 standard errors away."""
    p = share_at_least(870, 1000)
    assert (0.87 - p) / math.sqrt(p * (1 - p) / 1000) == pytest.approx(1.959964, abs=1e-5)


def test_a_good_run_is_held():
    verdict = judge(run_of(vehicle(100), vehicle(99)), Bounds())
    assert verdict.held
    assert (verdict.p50_ms, verdict.on_time_percent) == (20.0, 99.5)


@pytest.mark.parametrize(
    ("measured", "said"),
    [
        (run_of(vehicle(98)), "98.00 % on time"),
        (run_of(vehicle(100, ms=130.0)), "p99 130 ms above 100 ms"),
        (run_of(*[vehicle(100)] * 200, vehicle(40)), "fairness 0.40"),
        (run_of(vehicle(100), growth_mb=9.5), "memory grew 9.5 MB, 9.0 may be"),
        (replace(run_of(vehicle(100)), wanted_vehicles=3), "2 of 3 vehicles were not admitted"),
        (run_of(vehicle(0)), "p99 inf ms"),
    ],
)
def test_a_broken_bound_is_named(measured, said):
    verdict = judge(measured, Bounds())
    assert not verdict.held
    assert said in "; ".join(verdict.broken)


def test_pictures_that_never_came_count_against_the_share():
    verdict = judge(run_of(VehicleReport(100, [5.0] * 90)), Bounds())
    assert verdict.on_time_percent == 90.0
    assert verdict.p99_ms == 5.0, "of those acknowledged"
    assert (verdict.answered, verdict.due) == (90, 100)


def test_what_others_use_is_the_limit_only_where_a_bound_was_broken():
    crowded = replace(IDLE, machine=1.0, test=0.3, server_loop=0.6, others=1.4)
    held = replace(run_of(vehicle(100)), resources=crowded)
    broken = replace(run_of(vehicle(90)), resources=crowded)
    assert judge(held, Bounds()).limited_by == "nearest: server's event loop, at 60 % of a core"
    said = "other programs on this machine: they took 1.4 cores of it, the test 30 % of all"
    assert judge(broken, Bounds()).limited_by == said


def test_a_link_that_is_too_slow_for_an_instant_is_the_limit_whatever_the_machine_does():
    """Four pictures of 7383 bytes take 118 ms of 2 Mbit/s, though the link is not full at 5 Hz."""
    busy = replace(IDLE, machine=1.0, test=0.3, others=1.4, link=0.59)
    late = replace(run_of(vehicle(40)), resources=busy, instant_ms=118.0)
    said = "link of the busiest vehicle: an instant's pictures take 118 ms of it"
    assert judge(late, Bounds()).limited_by == said
    assert "other programs" in judge(late, Bounds(deadline_ms=150.0)).limited_by


@pytest.mark.parametrize("vehicles", [[vehicle(0), vehicle(0)], [vehicle(40)], []])
def test_where_there_is_nothing_to_compare_there_is_no_fairness(vehicles):
    verdict = judge(run_of(*vehicles), Bounds())
    assert verdict.fairness is None
    assert not any("fairness" in problem for problem in verdict.broken)


# --- the resource that is named


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"server_loop": 0.98}, "server's event loop, at 98 % of a core"),
        ({"workers": 0.9}, "server's workers, at 90 %"),
        ({"link": 0.9}, "link of the busiest vehicle, at 90 %"),
        ({"machine": 0.97}, "CPU of the machine, at 97 %"),
        (
            {"machine": 0.97, "others": 0.5, "test": 0.9},
            "CPU of the machine, at 97 %, 0.5 cores of it by others",
        ),
        (
            {"machine": 0.93, "others": 1.2, "test": 0.4, "workers": 0.9},
            "other programs on this machine: they took 1.2 cores of it, the test 40 % of all",
        ),
        (
            {"link": 1.0, "machine": 0.93, "others": 1.2, "test": 0.4},
            "link of the busiest vehicle, at 100 %",
        ),
        ({"generator": 0.9, "server_loop": 0.98}, "vehicles of the test, at 90 % of a core"),
        ({"generator_lag_ms": 25.0}, "vehicles of the test, 25 ms late themselves"),
        ({"generator_lag_ms": 25.0, "machine": 0.99}, "CPU of the machine, at 99 %"),
    ],
)
def test_the_resource_at_its_limit_is_named(change, named):
    assert limit(replace(IDLE, **change)) == named


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({}, "nearest: CPU of the machine, at 20 %"),
        ({"server_loop": 0.6, "machine": 0.65}, "nearest: server's event loop, at 60 % of a core"),
        ({"workers": 0.84, "machine": 0.9}, "nearest: server's workers, at 84 %"),
    ],
)
def test_without_one_at_its_limit_the_nearest_is_named(change, named):
    assert limit(replace(IDLE, **change)) == named


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"machine": 1.0, "others": 1.6}, "nearest: CPU of the machine, at 20 %"),
        ({"machine": 1.0, "test": 0.8}, "nearest: CPU of the machine, at 80 %"),
        ({"machine": 1.0, "workers": 0.5}, "nearest: server's workers, at 50 %"),
    ],
)
def test_a_held_load_is_nearest_to_a_limit_by_its_own_use(change, named):
    assert nearest(replace(IDLE, **change)) == named
