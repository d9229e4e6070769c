"""Laws of the exponential map and of what lies between two poses."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.camera import Pose, Vec3
from rfcore.errors import InvalidInput
from rfcore.motion import interpolated, quaternion_from_vector, rotation_vector

component = st.floats(-1.8, 1.8)
vectors = st.tuples(component, component, component).filter(lambda v: math.hypot(*v) < 3.1415)


@given(vectors)
def test_the_logarithm_undoes_the_exponential(vector: Vec3) -> None:
    back = rotation_vector(quaternion_from_vector(vector))
    assert back == pytest.approx(vector, abs=4e-15)


@given(vectors)
def test_a_quaternion_and_its_negative_have_one_logarithm(vector: Vec3) -> None:
    w, x, y, z = quaternion_from_vector(vector)
    assert rotation_vector((-w, -x, -y, -z)) == rotation_vector((w, x, y, z))


@given(vectors, vectors, st.floats(0.0, 1.0))
def test_parts_of_a_turn_add_up(a: Vec3, b: Vec3, share: float) -> None:
    first = Pose((1.0, 2.0, 3.0), quaternion_from_vector(a))
    second = Pose((-4.0, 0.0, 9.0), quaternion_from_vector(b))
    middle = interpolated(first, second, share)
    whole, part = (angle_rad(first, pose) for pose in (second, middle))
    assert part == pytest.approx(share * whole, abs=1e-7)
    assert middle.translation_m[0] == pytest.approx(1.0 - 5.0 * share)


@given(vectors, vectors)
def test_the_ends_come_back_as_they_are(a: Vec3, b: Vec3) -> None:
    first, second = (Pose((0.0, 0.0, 0.0), quaternion_from_vector(v)) for v in (a, b))
    assert interpolated(first, second, 0.0) is first
    assert interpolated(first, second, 1.0) is second


@pytest.mark.parametrize("share", [-0.1, 1.1, math.nan])
def test_a_share_outside_the_way_is_refused(share: float) -> None:
    with pytest.raises(InvalidInput, match="share: "):
        interpolated(Pose.identity(), Pose.identity(), share)


def test_a_vector_that_is_not_finite_is_refused() -> None:
    with pytest.raises(InvalidInput, match="rotation_vector"):
        quaternion_from_vector((math.nan, 0.0, 0.0))


def angle_rad(first: Pose, second: Pose) -> float:
    return math.hypot(*rotation_vector(first.inverse().compose(second).rotation))
