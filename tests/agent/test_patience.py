"""How long a vehicle waits for an answer."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cav_agent.answer_timeout import SLOWEST_BPS, STALL_S, AnswerTimeout


def test_a_first_answer_may_take_the_longest_there_is() -> None:
    patience = AnswerTimeout(5.0)
    assert patience.limit_s(1000) == 5.0
    patience.answered(0.05)
    patience.begin()
    assert patience.limit_s(1000) == 5.0


def test_a_small_frame_of_a_quick_server_is_given_up_after_little_more_than_a_second() -> None:
    patience = AnswerTimeout(5.0)
    patience.answered(0.1)
    assert patience.limit_s(3000) == pytest.approx(STALL_S + 0.08 + 0.2)


@given(st.lists(st.floats(0, 3), min_size=1), st.integers(0, 200_000))
def test_what_was_usual_and_what_the_slowest_link_takes_is_always_waited_for(
    usual_s: list[float], size_bytes: int
) -> None:
    patience = AnswerTimeout(5.0)
    for spent_s in usual_s:
        patience.answered(spent_s)
    needed_s = 8 * size_bytes / SLOWEST_BPS + max(usual_s[-8:])
    assert min(5.0, needed_s) <= patience.limit_s(size_bytes) <= 5.0
