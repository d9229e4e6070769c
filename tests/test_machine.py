"""A bound of time that is missed on a busy machine, and one on a quiet machine."""

import pytest

from machine import QUIET, Host, NotQuiet, judge


def test_what_others_took_is_a_share():
    assert 0.0 <= Host().taken() <= 1.0


@pytest.mark.parametrize(
    ("failed", "late", "taken", "raises"),
    [
        (["late"], ["late"], 2 * QUIET, NotQuiet),
        (["late"], ["late"], 0.0, AssertionError),
        (["late", "wrong"], ["late"], 2 * QUIET, AssertionError),
    ],
)
def test_only_lateness_on_a_busy_machine_is_measured_again(failed, late, taken, raises):
    with pytest.raises(AssertionError) as raised:
        judge(failed, late, taken)
    assert raised.type is raises


def test_what_is_good_is_good_on_any_machine():
    judge([], [], 1.0)
