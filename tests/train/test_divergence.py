"""A run that leaves the ground stops and says which parameters took off."""

import math
from dataclasses import replace

import numpy as np
import pytest

from rfcore.errors import InvalidInput, TrainingDiverged
from rfcore.raster.gaussians import Gaussians
from rfcore.train.schedule import DensityControl
from rfcore.train.trainer import WINDOW, DivergenceWatch


def gaussians(scale: float = 1.0) -> Gaussians:
    shapes = ((5, 3), (5, 4), (5, 3), (5,), (5, 1, 3))
    made = Gaussians(*(np.ones(shape, np.float32) for shape in shapes))
    return replace(made, log_scales=made.log_scales * np.float32(scale))


def feed(watch: DivergenceWatch, loss: float, begin: int, scale: float = 1.0) -> None:
    for iteration in range(begin, begin + WINDOW):
        watch.see(iteration, loss, lambda: gaussians(scale))


def test_a_loss_that_falls_or_wobbles_is_fine():
    watch = DivergenceWatch()
    for window, loss in enumerate((0.4, 0.2, 0.1, 0.14, 0.1)):
        feed(watch, loss, 1 + window * WINDOW)


def test_a_loss_above_where_it_began_stops_with_iteration_and_group():
    watch = DivergenceWatch()
    feed(watch, 0.2, 1)
    feed(watch, 0.1, 101)
    with pytest.raises(TrainingDiverged, match="iteration 300, log_scales") as caught:
        feed(watch, 0.21, 201, scale=50.0)
    assert (caught.value.iteration, caught.value.group) == (300, "log_scales")


@pytest.mark.parametrize("loss", [math.nan, math.inf])
def test_a_loss_that_is_no_number_stops_at_once(loss):
    with pytest.raises(TrainingDiverged, match="iteration 7"):
        DivergenceWatch().see(7, loss, gaussians)


def test_it_goes_on_from_what_it_knew():
    watch, resumed = DivergenceWatch(), DivergenceWatch()
    feed(watch, 0.2, 1)
    resumed.restore(watch.values())
    with pytest.raises(TrainingDiverged):
        feed(resumed, 0.4, 101)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"limit": -1}, "density.limit"),
        ({"interval": 0}, "density.interval"),
        ({"growth": 1.5}, "density.growth"),
        ({"start": 0.7, "stop": 0.2}, "density.start"),
        ({"noise": math.nan}, "density.noise"),
    ],
)
def test_density_settings_that_make_no_sense_are_refused(change, named):
    with pytest.raises(InvalidInput, match=named):
        DensityControl(**change)


def test_the_set_grows_to_its_limit_and_no_further():
    control = DensityControl(limit=110, growth=0.08)
    assert control.step_after(100, 100, seed=0).added == 8
    assert control.step_after(200, 108, seed=0).added == 2
    assert control.step_after(300, 120, seed=0).added == 0


def test_rounds_take_place_in_their_share_of_the_run_only():
    control = DensityControl(limit=9, interval=10, start=0.2, stop=0.5)
    due = [i for i in range(1, 101) if control.is_due(i, i / 100)]
    assert due == [20, 30, 40]
    assert not DensityControl().is_due(10, 0.3)
