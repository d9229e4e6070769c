"""Rates hold, then fall; every view comes once before any comes twice."""

from dataclasses import fields
from itertools import islice

import numpy as np
import pytest

from rfcore.errors import InvalidInput
from rfcore.train.schedule import RateSchedule, view_order

RATES = RateSchedule(held_share=0.5, final_factor=0.1, means_fall=0.01)


def test_rates_hold_and_then_fall_to_their_final_share():
    start, held, middle, end = (RATES.at(u, 1.0) for u in (0.0, 0.5, 0.75, 1.0))
    assert start.log_scales == held.log_scales == RATES.log_scales
    assert middle.sh_dc == pytest.approx(RATES.sh_dc * 0.1**0.5)
    assert end.opacity == pytest.approx(RATES.opacity_logits * 0.1)


def test_the_rate_of_the_means_falls_all_the_way_and_scales_with_the_unit():
    assert RATES.at(0.5, 1.0).means == pytest.approx(RATES.means * 0.1)
    assert RATES.at(0.5, 30.0).means == pytest.approx(RATES.means * 3.0)


def test_no_rate_ever_rises():
    runs = [RateSchedule().at(u, 1.0) for u in np.linspace(0, 1, 50)]
    for name in ("means", "log_scales", "quaternions", "opacity", "sh_dc", "sh_rest"):
        values = [getattr(rates, name) for rates in runs]
        assert values == sorted(values, reverse=True)
        assert values[-1] > 0


@pytest.mark.parametrize("name", [f.name for f in fields(RateSchedule)])
@pytest.mark.parametrize("value", [-0.1, float("nan"), 11.0])
def test_a_rate_that_makes_no_sense_is_refused_by_name(name, value):
    with pytest.raises(InvalidInput, match=f"rates.{name}"):
        RateSchedule(**{name: value})


def test_every_view_comes_once_before_any_comes_twice():
    order = list(islice(view_order(7, np.random.default_rng(3)), 21))
    for epoch in (order[:7], order[7:14], order[14:]):
        assert sorted(epoch) == list(range(7))
    assert order == list(islice(view_order(7, np.random.default_rng(3)), 21))
