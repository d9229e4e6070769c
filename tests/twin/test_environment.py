"""The street as a Gymnasium environment: Gymnasium's check, what is observed, what is refused."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.utils.passive_env_checker import env_render_passive_checker

from rfcore.errors import InvalidInput
from rfcore.perception.objects import StreetObject
from rfedge.twin.environment import (
    MOST_DEPTH_M,
    OBJECTS,
    DriveEnvironment,
    observed,
)
from rfedge.twin.simulation import Observation, Place, RecordedStreet
from server.test_objects import FIELD, INTRINSICS
from twin.test_simulation import START, passing_car

AHEAD = np.array([0.0, 1.0], np.float32)


@pytest.fixture(scope="module")
def street() -> RecordedStreet:
    return RecordedStreet(FIELD, [passing_car()])


def environment(street: RecordedStreet, **options: Any) -> DriveEnvironment:
    return DriveEnvironment(street, INTRINSICS, [START, replace(START, x_m=-0.5)], **options)


def test_it_passes_the_check_of_gymnasium(street: RecordedStreet) -> None:
    made = environment(street)
    check_env(made, skip_render_check=True)  # which asks for a registered name
    env_render_passive_checker(made)


def test_the_same_seed_and_actions_give_the_same_bytes(street: RecordedStreet) -> None:
    def driven() -> list[tuple[bytes, bytes, bytes, float, Any]]:
        made = environment(street)
        made.action_space.seed(3)
        made.reset(seed=7)
        steps = [made.step(made.action_space.sample()) for _ in range(5)]
        return [
            (*(seen[k].tobytes() for k in ("picture", "depth", "objects")), reward, info["place"])
            for seen, reward, _, _, info in steps
        ]

    assert driven() == driven()


def test_a_start_is_drawn_by_the_seed_or_given(street: RecordedStreet) -> None:
    made = environment(street)
    drawn = {made.reset(seed=seed)[1]["place"] for seed in range(6)}
    assert drawn == {START, replace(START, x_m=-0.5)}
    there = replace(START, x_m=0.3)
    assert made.reset(options={"place": there})[1]["place"] == there


def test_the_reward_is_metres_unless_the_caller_says_otherwise(street: RecordedStreet) -> None:
    made = environment(street)
    made.reset()
    _, reward, _, _, info = made.step(AHEAD)
    assert info["place"].speed_mps == pytest.approx(0.3)
    assert reward == pytest.approx(0.3 / 2 * 0.1)
    other = environment(street, reward=lambda _, after: after.place.x_m - 1.0)
    other.reset(options={"place": START})
    assert other.step(AHEAD)[1] == pytest.approx(START.x_m - 1.0)


def test_an_episode_ends_with_the_field_or_with_its_steps(street: RecordedStreet) -> None:
    made = environment(street, most_steps=2)
    made.reset()
    assert made.step(AHEAD)[2:4] == (False, False)
    assert made.step(AHEAD)[2:4] == (False, True)
    with pytest.raises(InvalidInput, match="no episode runs; call reset"):
        made.step(AHEAD)
    leaving = replace(START, y_m=-2.0, heading_rad=-math.pi / 2, speed_mps=15.0)
    made.reset(options={"place": leaving})
    assert made.step(AHEAD)[2:4] == (True, False)
    with pytest.raises(InvalidInput, match="no episode runs"):
        made.step(AHEAD)


def thing(number: int, x_m: float, y_m: float) -> StreetObject:
    return StreetObject(number, (x_m, y_m, 0.0), (0.0, 2.0, 0.0), 1.8, 1.5, 0.9, 1.0, 0.1, ())


def test_objects_are_the_nearest_as_the_car_sees_them() -> None:
    place = Place(1.0, 0.0, 1.6, math.pi / 2)
    things = tuple(thing(n, 0.0, 40.0 - n) for n in range(OBJECTS + 4))
    blank = np.zeros((4, 6, 3), np.uint8)
    depth = np.full((4, 6), 2 * MOST_DEPTH_M, np.float32)
    seen = observed(Observation(place, blank, depth, depth > 0, things))
    assert seen["depth"].max() == MOST_DEPTH_M
    nearest = 40.0 - (OBJECTS + 3)
    assert seen["objects"][0] == pytest.approx([nearest, 1.0, 2.0, 0.0, 1.8, 1.5, 0.9], abs=1e-5)
    assert (np.diff(seen["objects"][:, 0]) > 0).all()
    alone = observed(Observation(place, blank, depth, depth > 0, things[:1]))["objects"]
    assert not alone[1:].any()


@pytest.mark.parametrize(
    ("action", "message"),
    [
        ([1.5, 0.0], "steer: 1.5 is outside -1..1"),
        ([0.0, math.nan], "throttle: nan is outside -1..1"),
        ([0.0], r"action: has the shape \(1,\)"),
    ],
)
def test_actions_no_car_can_take_are_refused(
    street: RecordedStreet, action: list[float], message: str
) -> None:
    made = environment(street)
    made.reset()
    with pytest.raises(InvalidInput, match=message):
        made.step(np.array(action, np.float32))


def test_what_is_no_environment_is_refused(street: RecordedStreet) -> None:
    with pytest.raises(InvalidInput, match="starts: there are none"):
        DriveEnvironment(street, INTRINSICS, [])
    with pytest.raises(InvalidInput, match="most_steps: 0 is not above 0"):
        environment(street, most_steps=0)
    made = environment(street)
    with pytest.raises(InvalidInput, match="render: nothing was seen yet"):
        made.render()
    with pytest.raises(InvalidInput, match="options: 'pose' is none; there is: place"):
        made.reset(options={"pose": START})
    with pytest.raises(InvalidInput, match="outside of the field"):
        made.reset(options={"place": replace(START, x_m=1e4)})
