"""The resource that is at its limit, or nearest to it, is named with what it was used to."""

from dataclasses import replace

import pytest

from rfedge.loadtest.verdict import Resources, limit, nearest

IDLE = Resources(0.1, 0.1, 0.1, 0.1, 0.2, 0.2, 0.0, 1.0)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"server_loop": 0.98}, "server's event loop, at 98 % of a core"),
        ({"workers": 0.9}, "server's workers, at 90 %"),
        ({"link": 0.9}, "link of the busiest vehicle, at 90 %"),
        ({"machine": 0.97}, "CPU of the machine, at 97 %"),
        (
            {"machine": 0.97, "others": 0.5},
            "CPU of the machine, at 97 %, 0.5 cores of it by others",
        ),
        ({"generator": 0.9, "server_loop": 0.98}, "vehicles of the test, at 90 % of a core"),
        ({"generator_lag_ms": 25.0}, "vehicles of the test, 25 ms late themselves"),
        ({"generator_lag_ms": 25.0, "machine": 0.99}, "CPU of the machine, at 99 %"),
    ],
)
def test_the_resource_at_its_limit_is_named(change: dict[str, float], named: str) -> None:
    assert limit(replace(IDLE, **change)) == named


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({}, "nearest: CPU of the machine, at 20 %"),
        ({"server_loop": 0.6, "machine": 0.65}, "nearest: server's event loop, at 60 % of a core"),
        ({"workers": 0.84, "machine": 0.9}, "nearest: server's workers, at 84 %"),
    ],
)
def test_without_one_at_its_limit_the_nearest_is_named(
    change: dict[str, float], named: str
) -> None:
    assert limit(replace(IDLE, **change)) == named


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"machine": 1.0, "others": 1.6}, "nearest: CPU of the machine, at 20 %"),
        ({"machine": 1.0, "test": 0.8}, "nearest: CPU of the machine, at 80 %"),
        ({"machine": 1.0, "workers": 0.5}, "nearest: server's workers, at 50 %"),
    ],
)
def test_a_held_load_is_nearest_to_a_limit_by_its_own_use(
    change: dict[str, float], named: str
) -> None:
    assert nearest(replace(IDLE, **change)) == named
