"""The search finds the largest number that holds, and asks for none twice."""

from hypothesis import given
from hypothesis import strategies as st

from rfedge.loadtest.uplink import CLOSE, largest_held


@given(st.integers(1, 40), st.integers(0, 1200))
def test_the_largest_number_is_found_within_a_tenth(first: int, true_limit: int) -> None:
    asked: list[int] = []

    def held(vehicles: int) -> bool:
        asked.append(vehicles)
        return vehicles <= true_limit

    found = largest_held(first, held, most=1000)
    assert len(asked) == len(set(asked))
    reachable = min(true_limit, 1000)
    assert found <= reachable
    assert reachable < max(found + 1, CLOSE * found) or reachable == found
