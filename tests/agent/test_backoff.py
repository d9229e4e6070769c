"""Pauses grow, never beyond the longest, and differ between vehicles."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cav_agent.backoff import Backoff
from rfcore.errors import InvalidInput


def test_pauses_double_up_to_the_longest_and_begin_again_after_a_success() -> None:
    backoff = Backoff(0.5, 3.0, lambda: 1.0)
    assert [backoff.next_s() for _ in range(5)] == [0.5, 1.0, 2.0, 3.0, 3.0]
    backoff.reset()
    assert backoff.next_s() == 0.5


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=20))
def test_chance_takes_at_most_half_of_a_pause(chances: list[float]) -> None:
    left = iter(chances)
    jittered, full = Backoff(0.1, 10.0, lambda: next(left)), Backoff(0.1, 10.0, lambda: 1.0)
    for _ in chances:
        most_s = full.next_s()
        assert 0.5 * most_s <= jittered.next_s() <= most_s


def test_a_pause_of_nothing_would_be_a_busy_loop() -> None:
    with pytest.raises(InvalidInput, match="backoff"):
        Backoff(0.0, 1.0)
