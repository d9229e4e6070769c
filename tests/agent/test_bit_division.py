"""The division of an instant's bytes: it spends what there is, and starves nobody."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cav_agent.rate_control import LEAST_CAMERA_SHARE, BitDivision
from rfcore.errors import InvalidInput

NAMES = [f"cam{i}" for i in range(18)]

cameras = st.lists(st.sampled_from(NAMES), min_size=1, max_size=18, unique=True)
codings = st.lists(
    st.tuples(st.sampled_from(NAMES), st.integers(0, 1_000_000), st.floats(1.0, 51.0)), max_size=60
)
priorities = st.dictionaries(st.sampled_from(NAMES), st.floats(0.1, 10.0))


@given(cameras, codings, priorities, st.floats(1.0, 1e9))
def test_shares_sum_to_the_budget_and_none_starves(
    names: list[str], coded: list[tuple[str, int, float]], weights: dict[str, float], total: float
) -> None:
    division = BitDivision(weights)
    for coding in coded:
        division.coded(*coding)
    shares = division.divide(total, names)
    assert set(shares) == set(names)
    assert sum(shares.values()) == pytest.approx(total, rel=1e-9)
    assert min(shares.values()) >= LEAST_CAMERA_SHARE * total / len(names) * (1 - 1e-9)


@given(codings, st.floats(1.0, 1e9))
def test_a_single_camera_gets_everything(coded: list[tuple[str, int, float]], total: float) -> None:
    division = BitDivision({})
    for coding in coded:
        division.coded(*coding)
    assert division.divide(total, ["cam0"]) == {"cam0": pytest.approx(total)}


def test_before_anything_was_coded_all_get_the_same() -> None:
    assert BitDivision({}).divide(300.0, ["a", "b", "c"]) == pytest.approx(
        {"a": 100.0, "b": 100.0, "c": 100.0}
    )


def test_a_camera_that_needs_more_at_the_same_crf_gets_more() -> None:
    division = BitDivision({})
    division.coded("still", 1000, 30.0)
    division.coded("moving", 3000, 30.0)
    shares = division.divide(4000.0, ["still", "moving"])
    assert shares["still"] < 2000.0 < shares["moving"]


def test_bytes_at_another_crf_are_compared_at_one() -> None:
    division = BitDivision({})
    division.coded("a", 1000, 30.0)
    division.coded("b", 500, 36.0)
    shares = division.divide(1000.0, ["a", "b"])
    assert shares["a"] == pytest.approx(shares["b"])


def test_priority_weighs() -> None:
    shares = BitDivision({"front": 3.0}).divide(1000.0, ["front", "rear"])
    assert shares["front"] == pytest.approx(
        1000 * (LEAST_CAMERA_SHARE / 2 + (1 - LEAST_CAMERA_SHARE) * 0.75)
    )


@pytest.mark.parametrize("priority", [0.0, -1.0, float("nan"), float("inf")])
def test_a_priority_that_is_none_is_refused(priority: float) -> None:
    with pytest.raises(InvalidInput, match="priority"):
        BitDivision({"front": priority})
