"""Directions and ranges of several moments and cameras place a thing where it is."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from rfcore.errors import InvalidInput
from rfcore.perception.triangulation import Sighting, placed

Point = tuple[float, float]
PLACES = st.tuples(st.floats(-40, 40), st.floats(-40, 40))
VELOCITIES = st.tuples(st.floats(-15, 15), st.floats(-15, 15))
BEARING_SIGMA, RANGE_SIGMA_M = 0.01, 0.5


def sighting(
    thing_m: Point,
    eye_m: Point,
    time_s: float = 0.0,
    ranged: bool = True,
    moved_m: Point = (0.0, 0.0),
) -> Sighting:
    """``thing_m`` seen from ``eye_m`` exactly; ``moved_m``: the error of the camera's pose."""
    x_m, y_m = (a - b for a, b in zip(thing_m, eye_m, strict=True))
    told = (eye_m[0] + moved_m[0], eye_m[1] + moved_m[1])
    bearing = math.atan2(y_m, x_m)
    if not ranged:
        return Sighting(time_s, told, bearing, BEARING_SIGMA)
    return Sighting(time_s, told, bearing, BEARING_SIGMA, math.hypot(x_m, y_m), RANGE_SIGMA_M)


def along(thing_m: Point, velocity_mps: Point, eyes_m: Sequence[Point], ranged: bool) -> list:
    """One picture from each place, every 0.1 s; the thing is at ``thing_m`` in the last."""
    last = len(eyes_m) - 1
    seen = []
    for number, eye_m in enumerate(eyes_m):
        ago_s = 0.1 * (last - number)
        there = (thing_m[0] - ago_s * velocity_mps[0], thing_m[1] - ago_s * velocity_mps[1])
        seen.append(sighting(there, eye_m, -ago_s, ranged))
    return seen


def sine_between(thing_m: Point, a_m: Point, b_m: Point) -> float:
    to_a, to_b = (np.subtract(thing_m, eye_m) for eye_m in (a_m, b_m))
    cross = to_a[0] * to_b[1] - to_a[1] * to_b[0]
    return abs(float(cross)) / float(np.linalg.norm(to_a) * np.linalg.norm(to_b))


@given(PLACES, PLACES, PLACES)
def test_two_directions_that_cross_place_a_thing(thing: Point, one: Point, other: Point) -> None:
    assume(min(math.dist(thing, one), math.dist(thing, other)) > 1)
    assume(sine_between(thing, one, other) > 0.05)
    found = placed([sighting(thing, eye, ranged=False) for eye in (one, other)])
    assert math.dist(found.at_m, thing) < 1e-6
    assert found.velocity_mps == (0.0, 0.0)
    assert found.outvoted == ()


@given(PLACES, PLACES)
def test_one_sighting_with_a_range_places_a_thing(thing: Point, eye: Point) -> None:
    assume(math.dist(thing, eye) > 0.5)
    assert math.dist(placed([sighting(thing, eye)]).at_m, thing) < 1e-6


@given(PLACES, VELOCITIES, st.floats(-math.pi, math.pi))
def test_what_passes_is_where_it_is_now_with_its_velocity(
    thing: Point, velocity: Point, heading: float
) -> None:
    """Seen by a vehicle that drives past at 9 m/s. The velocity's own sigma pulls a little."""
    assume(math.hypot(*velocity) > 5)
    step = (0.9 * math.cos(heading), 0.9 * math.sin(heading))
    eyes = [(n * step[0] - 60, n * step[1] - 60) for n in range(10)]
    found = placed(along(thing, velocity, eyes, ranged=True))
    assert math.dist(found.at_m, thing) < 0.3
    assert math.dist(found.velocity_mps, velocity) < 0.15 * math.hypot(*velocity)


@given(PLACES, st.floats(-math.pi, math.pi), st.tuples(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6)))
def test_turning_and_moving_everything_moves_the_place(
    thing: Point, turn: float, shift: Point
) -> None:
    cos, sin = math.cos(turn), math.sin(turn)

    def moved(point: Point) -> Point:
        return (
            cos * point[0] - sin * point[1] + shift[0],
            sin * point[0] + cos * point[1] + shift[1],
        )

    eyes = [(50.0, 0.0), (50.0, 5.0), (55.0, 60.0)]
    here = placed([sighting(thing, eye) for eye in eyes])
    there = placed([sighting(moved(thing), moved(eye)) for eye in eyes])
    assert math.dist(there.at_m, moved(here.at_m)) < 1e-4
    rotation = np.array([[cos, -sin], [sin, cos]])
    expected = rotation @ here.covariance_m2 @ rotation.T
    np.testing.assert_allclose(there.covariance_m2, expected, rtol=1e-3, atol=1e-5)


def test_the_covariance_of_one_sighting_is_its_own() -> None:
    found = placed([Sighting(0.0, (0.0, 0.0), 0.0, 0.01, 20.0, 1.5)])
    np.testing.assert_allclose(found.covariance_m2, [[1.5**2, 0], [0, 0.2**2]], atol=1e-9)


def test_errors_are_as_large_as_the_covariance_says() -> None:
    """Mean squared error in sigmas: 2 for two coordinates. Its own deviation over 800 places of two
    degrees of freedom is 2 / sqrt(800) = 0.07; four of these are allowed. All see it at once, so
    that nothing is taken for motion."""
    rng = np.random.default_rng(7)
    thing = (20.0, 4.0)
    eyes = [(0.9 * n, 0.0) for n in range(8)]
    squares = []
    for _ in range(800):
        seen = []
        for exact in along(thing, (0.0, 0.0), eyes, ranged=True):
            assert exact.range_m is not None
            bearing = exact.bearing_rad + rng.normal(scale=BEARING_SIGMA)
            range_m = exact.range_m + rng.normal(scale=RANGE_SIGMA_M)
            seen.append(Sighting(0.0, exact.eye_m, bearing, BEARING_SIGMA, range_m, RANGE_SIGMA_M))
        found = placed(seen)
        off = np.subtract(found.at_m, thing)
        squares.append(off @ np.linalg.inv(found.covariance_m2) @ off)
    assert np.mean(squares) == pytest.approx(2.0, abs=0.3)


def test_parallax_places_better_than_ranges_alone() -> None:
    """A thing beside the way, whose range is known to 2 m at a time: its directions turn."""
    eyes = [(2.0 * n, 0.0) for n in range(6)]
    loose = [
        Sighting(s.time_s, s.eye_m, s.bearing_rad, 0.005, s.range_m, 2.0)
        for s in along((20.0, 8.0), (0.0, 0.0), eyes, ranged=True)
    ]
    alone_m = 2.0 / math.sqrt(6)
    assert math.sqrt(np.linalg.eigvalsh(placed(loose).covariance_m2)[-1]) < alone_m / 2


@pytest.mark.parametrize("wrong", range(5))
@pytest.mark.parametrize("moved_m", [(0.0, 3.0), (0.0, -3.0), (-3.0, 3.0)])
def test_one_wrong_pose_is_outvoted(wrong: int, moved_m: Point) -> None:
    thing = (15.0, 3.0)
    eyes = [(0.9 * n, 0.0) for n in range(5)]
    seen = along(thing, (0.0, 0.0), eyes, ranged=True)
    seen[wrong] = sighting(thing, eyes[wrong], seen[wrong].time_s, moved_m=moved_m)
    found = placed(seen)
    assert found.outvoted == (wrong,)
    assert math.dist(found.at_m, thing) < 1e-6
    assert found.velocity_mps == (0.0, 0.0)


def test_of_two_that_disagree_none_is_outvoted() -> None:
    seen = [sighting((15.0, 0.0), (0.0, 0.0)), sighting((15.0, 3.0), (0.0, 0.0))]
    found = placed(seen)
    assert found.outvoted == ()
    assert 0 < found.at_m[1] < 3


def test_a_rig_with_a_wrong_pose_has_one_vote_however_many_cameras_it_has() -> None:
    """Three of its cameras and two other vehicles see one thing at a moment."""
    thing = (15.0, 3.0)
    honest = [sighting(thing, eye) for eye in ((0.0, 0.0), (1.0, 5.0))]
    wrong = sighting(thing, (0.9, -2.0), moved_m=(0.0, 3.0))
    shared = [replace(wrong, vote=1 / 3)] * 3
    found = placed([*shared, *honest])
    assert found.outvoted == (0, 1, 2)
    assert math.dist(found.at_m, thing) < 1e-6
    assert math.dist(placed([wrong, wrong, wrong, *honest]).at_m, thing) > 1


def test_a_vote_that_is_shared_places_as_one_does() -> None:
    """Whichever way it is divided."""
    one = [sighting((15.0, 3.0), (0.0, 0.0)), sighting((15.2, 3.0), (1.0, 5.0))]
    shared = [replace(one[0], vote=0.25), replace(one[0], vote=0.75), one[1]]
    whole, parts = placed(one), placed(shared)
    assert parts.at_m == pytest.approx(whole.at_m)
    np.testing.assert_allclose(parts.covariance_m2, whole.covariance_m2)


def test_directions_that_place_nothing_are_refused() -> None:
    ahead = [Sighting(0.0, (0.0, y_m), 0.3, 0.01) for y_m in (0.0, 1.0, 2.0)]
    with pytest.raises(InvalidInput, match="of 3 sightings none has a range"):
        placed(ahead)
    with pytest.raises(InvalidInput, match="of 1 sightings none has a range"):
        placed(ahead[:1])
    apart = [Sighting(0.0, (0.0, 0.0), -0.3, 0.01), Sighting(0.0, (0.0, 1.0), 0.3, 0.01)]
    with pytest.raises(InvalidInput, match="cross behind a camera"):
        placed(apart)
    with pytest.raises(InvalidInput, match="there are none"):
        placed([])


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_refused(bad: float) -> None:
    for values in ((bad, (0.0, 0.0), 0.0), (0.0, (0.0, bad), 0.0), (0.0, (0.0, 0.0), bad)):
        with pytest.raises(InvalidInput, match="not all finite"):
            Sighting(*values, 0.01)


@pytest.mark.parametrize("bad", [math.nan, math.inf, 0.0, -1.0])
def test_sigmas_and_ranges_are_above_0(bad: float) -> None:
    with pytest.raises(InvalidInput, match="bearing_sigma_rad"):
        Sighting(0.0, (0.0, 0.0), 0.0, bad)
    with pytest.raises(InvalidInput, match="range_m"):
        Sighting(0.0, (0.0, 0.0), 0.0, 0.01, bad, 1.0)
    with pytest.raises(InvalidInput, match="vote"):
        Sighting(0.0, (0.0, 0.0), 0.0, 0.01, vote=bad)
    with pytest.raises(InvalidInput, match="range_sigma_m"):
        Sighting(0.0, (0.0, 0.0), 0.0, 0.01, 10.0, bad)
