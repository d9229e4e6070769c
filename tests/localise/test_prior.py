"""Measurements are checked where they are made; a search looks at its prior, then around it."""

import math
from itertools import pairwise
from typing import Any

import pytest

from rfcore.camera import Pose
from rfcore.errors import InvalidInput
from rfcore.localise.estimate import (
    AROUND,
    MOST_RINGS,
    MOST_TURNS,
    PLAUSIBLE,
    REACH_DEG,
    PoseMeasurement,
    PosePrior,
    hypotheses,
    moved,
)

POSE = Pose((3.0, -2.0, 1.5), (0.5, -0.5, 0.5, -0.5))


def distances_m(prior: PosePrior, depth_m: float) -> list[float]:
    """Return the distance of each hypothesis from the prior."""
    back = prior.world_from_cam.inverse()
    return [math.hypot(*back.compose(pose).translation_m) for pose in hypotheses(prior, depth_m)]


def test_the_prior_is_the_first_hypothesis():
    first = next(hypotheses(PosePrior(POSE, 2.0, 3.0), 10.0))
    assert first.translation_m == pytest.approx(POSE.translation_m)
    assert first.rotation == pytest.approx(POSE.rotation)


def test_hypotheses_come_nearest_first_and_reach_the_standard_deviation():
    far_m = distances_m(PosePrior(POSE, 4.0, 3.0), 10.0)
    assert all(near <= far + 1e-9 for near, far in pairwise(far_m))
    assert max(far_m) >= 4.0


def test_a_vague_prior_has_more_hypotheses_and_never_more_than_the_rings_allow():
    counts = [len(distances_m(PosePrior(POSE, s, s), 10.0)) for s in (0.1, 4.0, 20.0, 2e4)]
    assert counts == sorted(counts)
    assert len(set(counts[:3])) == 3
    rings = 1 + AROUND * MOST_RINGS * (MOST_RINGS + 1) // 2
    assert counts[-1] == rings * (1 + 2 * MOST_TURNS)


def test_the_search_does_not_depend_on_the_unit_of_length():
    metres = distances_m(PosePrior(POSE, 4.0, 3.0), 10.0)
    millimetres = distances_m(PosePrior(POSE, 4000.0, 3.0), 10_000.0)
    assert millimetres == pytest.approx([1000 * far for far in metres], abs=1e-6)


def test_a_field_that_shows_nothing_at_the_prior_is_searched_around_it():
    assert max(distances_m(PosePrior(POSE, 3.0, 3.0), 0.0)) == pytest.approx(3.0)


def test_a_compass_of_many_degrees_adds_turns_to_both_sides():
    prior = PosePrior(POSE, 1e-3, REACH_DEG)
    forward = Pose.identity().inverse()
    turns = []
    for pose in list(hypotheses(prior, 1.0))[:3]:
        local = POSE.inverse().compose(pose).compose(forward)
        x, _, z = local.rotation_matrix()[0][2], 0.0, local.rotation_matrix()[2][2]
        turns.append(math.degrees(math.atan2(x, z)))
    assert sorted(turns) == pytest.approx([-REACH_DEG, 0.0, REACH_DEG], abs=1e-9)


@pytest.mark.parametrize(("share", "allowed"), [(0.99, True), (1.01, False)])
def test_a_pose_beyond_four_standard_deviations_is_implausible(share, allowed):
    prior = PosePrior(POSE, 0.5, 2.0)
    turn_rad = math.radians(share * PLAUSIBLE * 2.0)
    assert prior.allows(moved(POSE, (share * PLAUSIBLE * 0.5, 0.0, 0.0))) is allowed
    assert prior.allows(moved(POSE, (0.0, 0.0, 0.0), (0.0, turn_rad, 0.0))) is allowed


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf])
def test_a_deviation_that_is_none_is_refused(bad):
    with pytest.raises(InvalidInput, match=r"prior.position_m: .* must be finite and above 0"):
        PosePrior(POSE, bad, 1.0)
    with pytest.raises(InvalidInput, match=r"prior.rotation_deg: .* must be finite and above 0"):
        PosePrior(POSE, 1.0, bad)


GOOD: dict[str, Any] = {
    "time_ns": 1,
    "position_m": (1.0, 2.0, 3.0),
    "position_std_m": (1.0, 1.0, 2.0),
    "rotation": (1.0, 0.0, 0.0, 0.0),
    "rotation_std_deg": 1.0,
}


def test_a_measurement_with_a_rotation_is_a_pose():
    assert PoseMeasurement(**GOOD).world_from_cam == Pose((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0))
    assert PoseMeasurement(**{**GOOD, "rotation": None}).world_from_cam is None


@pytest.mark.parametrize(
    ("name", "value", "reported"),
    [
        ("time_ns", -1, "time_ns"),
        ("time_ns", 1 << 64, "time_ns"),
        ("position_m", (math.nan, 0.0, 0.0), "translation_m"),
        ("position_m", (0.0, math.inf, 0.0), "translation_m"),
        ("rotation", (2.0, 0.0, 0.0, 0.0), "rotation"),
        ("rotation", (math.nan, 0.0, 0.0, 0.0), "rotation"),
        ("position_std_m", (1.0, 0.0, 1.0), "position_std_m"),
        ("position_std_m", (1.0, math.nan, 1.0), "position_std_m"),
        ("rotation_std_deg", math.inf, "rotation_std_deg"),
        ("rotation_std_deg", -1.0, "rotation_std_deg"),
    ],
)
def test_what_no_sensor_can_mean_is_refused(name, value, reported):
    with pytest.raises(InvalidInput, match=reported):
        PoseMeasurement(**{**GOOD, name: value})
