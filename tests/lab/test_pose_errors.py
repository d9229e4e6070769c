"""Error models of a vehicle's own poses: deterministic by seed, of the size they state."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lab.localisation.pose_errors import (
    ERROR_MODELS,
    PoseErrorModel,
    observed,
    parse_error_model,
)
from rfcore.camera import Pose
from rfcore.errors import InvalidInput
from rfcore.motion import quaternion_from_vector, rotation_vector

TIMES_S = [100.0 + 0.1 * n for n in range(400)]
PATH = [
    Pose((0.8 * n, 0.0, 0.1 * n), quaternion_from_vector((0.0, 0.003 * n, 0.0)))
    for n in range(len(TIMES_S))
]


def _observed(model: PoseErrorModel, seed: int = 1):
    return observed(TIMES_S, PATH, model, np.random.default_rng(seed))


def _errors(observations):
    by_time = dict(zip(TIMES_S, PATH, strict=True))
    between = [by_time[o.taken_s].inverse().compose(o.world_from_cam) for o in observations]
    metres = np.array([b.translation_m for b in between])
    degrees = np.degrees([rotation_vector(b.rotation) for b in between])
    return metres, degrees


def test_without_errors_the_true_poses_come_back():
    metres, degrees = _errors(_observed(ERROR_MODELS["exact"]))
    assert np.abs(metres).max() < 1e-9
    assert np.abs(degrees).max() < 1e-9


@pytest.mark.parametrize("name", ERROR_MODELS)
def test_the_same_seed_gives_the_same_observations_and_another_seed_others(name):
    model = ERROR_MODELS[name]
    assert _observed(model, 3) == _observed(model, 3)
    assert name == "exact" or _observed(model, 3) != _observed(model, 4)


def test_white_noise_has_the_standard_deviation_it_states():
    metres, degrees = _errors(_observed(PoseErrorModel(noise_m=0.2, noise_deg=0.5)))
    # 1200 samples: the standard error of a standard deviation is 2 %; five of them
    assert metres.std() == pytest.approx(0.2, rel=0.1)
    assert degrees.std() == pytest.approx(0.5, rel=0.1)


def test_an_offset_is_the_same_in_the_world_all_along_a_bend():
    observations = _observed(ERROR_MODELS["offset"])
    shifts = np.array([o.world_from_cam.translation_m for o in observations]) - [
        p.translation_m for p in PATH
    ]
    assert np.ptp(shifts, axis=0).max() < 1e-9
    assert np.linalg.norm(shifts[0]) == pytest.approx(0.75)
    _, degrees = _errors(observations)
    assert np.linalg.norm(degrees, axis=1) == pytest.approx(0.5)


def test_a_bias_walk_is_stationary_and_changes_little_from_fix_to_fix():
    model = PoseErrorModel(walk_m=1.5, walk_s=30.0)
    first, steps = [], []
    for seed in range(40):
        metres = np.array([o.world_from_cam.translation_m for o in _observed(model, seed)])
        errors = metres - [p.translation_m for p in PATH]
        first += [errors[0, 0], errors[-1, 0], errors[0, 2], errors[-1, 2]]
        steps.append(np.diff(errors[:, [0, 2]], axis=0))
    assert np.std(first) == pytest.approx(1.5, rel=0.4)
    # a step of 0.1 s of a Gauss-Markov process: sd sqrt(2 (1 - exp(-dt / tau))) of its own
    assert np.std(steps) == pytest.approx(1.5 * math.sqrt(2 * 0.1 / 30), rel=0.1)


def test_the_rate_latency_and_silence_of_gnss_are_its_own():
    model = PoseErrorModel(rate_hz=2.0, latency_s=0.2, silent_from_s=10.0, silent_s=5.0)
    observations = _observed(model)
    taken_s = np.array([o.taken_s for o in observations]) - TIMES_S[0]
    assert len(observations) == 80 - 10
    assert not ((taken_s >= 10.0) & (taken_s < 15.0)).any()
    assert all(o.known_s == o.taken_s + 0.2 for o in observations)


@given(st.floats(0, 30), st.floats(0, 10))
def test_silence_changes_no_observation_that_remains(begin_s, length_s):
    model = PoseErrorModel(noise_m=0.3, walk_m=1.0, rate_hz=1.0)
    silent = PoseErrorModel(
        noise_m=0.3, walk_m=1.0, rate_hz=1.0, silent_from_s=begin_s, silent_s=length_s
    )
    everything = {o.taken_s: o for o in _observed(model)}
    assert all(everything[o.taken_s] == o for o in _observed(silent))


def test_text_names_a_model_and_changes_its_numbers():
    assert parse_error_model("gnss") == ERROR_MODELS["gnss"]
    assert parse_error_model("gnss,silent_s=5").silent_s == 5.0
    assert parse_error_model("noise_m=0.1,noise_deg=0.2") == PoseErrorModel(0.1, 0.2)


@pytest.mark.parametrize("text", ["", "gps", "gnss,noise=3", "noise_m=x", "noise_m=-1", "noise_m="])
def test_text_that_is_no_model_is_refused(text):
    with pytest.raises(InvalidInput):
        parse_error_model(text)


def test_times_that_do_not_fit_the_poses_are_refused():
    rng = np.random.default_rng(1)
    for times_s in ([1.0], [1.0, 1.0], [2.0, 1.0]):
        with pytest.raises(InvalidInput):
            observed(times_s, PATH[:2], PoseErrorModel(), rng)
