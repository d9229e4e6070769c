"""A soak tells growth from noise."""

from dataclasses import replace

import pytest

from lab.soak import what_grew
from rfedge.loadtest.drive import Sample


def looks(slope_mb: float = 0.0, **late: int) -> list[Sample]:
    """Ten minutes of samples; ``late`` are counts of the last three."""
    counts = {"descriptors": 40, "threads": 9, "children": 2}
    return [
        Sample(
            60.0 * i, 0.0, 0.0, 200.0 + slope_mb * i, **(counts if i < 7 else {**counts, **late})
        )
        for i in range(10)
    ]


def test_nothing_grows_when_nothing_does():
    assert what_grew(looks()) == []
    assert what_grew(looks(slope_mb=0.9)) == []
    assert what_grew(looks(descriptors=30, threads=8)) == []


@pytest.mark.parametrize(
    ("samples", "said"),
    [
        (looks(slope_mb=1.5), "memory grows 1.50 MB a minute"),
        (looks(descriptors=41), "descriptors grew from 40 to 41"),
        (looks(threads=13), "threads grew from 9 to 13"),
        (looks(children=3), "processes grew from 2 to 3"),
    ],
)
def test_what_grows_is_named(samples, said):
    (problem,) = what_grew(samples)
    assert said in problem


def test_a_pool_that_starts_a_thread_late_is_no_growth_and_a_leak_of_one_thread_a_quarter_is():
    assert what_grew(looks(threads=10)) == []
    assert what_grew(looks(threads=12)) == []
    leaking = [replace(sample, threads=9 + k // 3) for k, sample in enumerate(looks() + looks())]
    assert what_grew(leaking) == ["threads grew from 9 to 14"]
    slowly = [replace(sample, threads=9 + k // 2) for k, sample in enumerate(looks())]
    assert what_grew(slowly) == ["threads grew from 9 to 12"]


def test_a_thing_that_comes_and_goes_is_no_growth():
    """A connection that lives for a moment, of a scrape or a check of health."""
    samples = looks()
    samples[9] = Sample(540.0, 0.0, 0.0, 200.0, 41, 9, 2)
    assert what_grew(samples) == []


def test_a_run_too_short_for_quarters_is_judged_all_the_same():
    assert what_grew(looks()[:2]) == []
    assert what_grew(looks(descriptors=41)[5:8]) == ["descriptors grew from 40 to 41"]
