"""Laws of the exponential map and of what lies between two poses."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.camera import Pose
from rfcore.errors import InvalidInput
from rfcore.motion import interpolated, quaternion_from_vector, rotation_vector

component = st.floats(-1.8, 1.8)
vectors = st.tuples(component, component, component).filter(lambda v: math.hypot(*v) < 3.1415)


angle = st.floats(-3.1, 3.1)
slopes = st.tuples(*[st.floats(-1, 1)] * 3)


def turned(angle_rad: float, axis: tuple[float, float, float] = (0, 0, 1)) -> Pose:
    """A turn about an axis through the origin, placed at (angle, 0, 0)."""
    norm = math.hypot(*axis)
    x, y, z = (math.sin(angle_rad / 2) * a / norm for a in axis)
    return Pose((angle_rad, 0.0, 0.0), (math.cos(angle_rad / 2), x, y, z))


@given(vectors)
def test_the_logarithm_undoes_the_exponential(vector):
    back = rotation_vector(quaternion_from_vector(vector))
    assert back == pytest.approx(vector, abs=4e-15)


@given(vectors)
def test_a_quaternion_and_its_negative_have_one_logarithm(vector):
    w, x, y, z = quaternion_from_vector(vector)
    assert rotation_vector((-w, -x, -y, -z)) == rotation_vector((w, x, y, z))


@given(vectors, vectors, st.floats(0.0, 1.0))
def test_parts_of_a_turn_add_up(a, b, share):
    first = Pose((1.0, 2.0, 3.0), quaternion_from_vector(a))
    second = Pose((-4.0, 0.0, 9.0), quaternion_from_vector(b))
    middle = interpolated(first, second, share)
    whole, part = (angle_rad(first, pose) for pose in (second, middle))
    assert part == pytest.approx(share * whole, abs=1e-7)
    assert middle.translation_m[0] == pytest.approx(1.0 - 5.0 * share)


@given(end=st.floats(0.0, 3.0), share=st.floats(0, 1))
def test_a_turn_is_shared_evenly(end, share):
    pose = interpolated(turned(0.0), turned(end), share)
    expected = turned(end * share)
    assert pose.rotation == pytest.approx(expected.rotation, abs=1e-12)
    assert pose.translation_m == pytest.approx(expected.translation_m)


@given(a=angle, b=angle, share=st.floats(0, 1), axis=slopes)
def test_the_sign_of_a_quaternion_means_nothing(a, b, share, axis):
    if math.hypot(*axis) < 1e-3 or abs(abs(a - b) - math.pi) < 1e-3:
        return
    first, second = turned(a, axis), turned(b, axis)
    w, x, y, z = second.rotation
    flipped = Pose(second.translation_m, (-w, -x, -y, -z))
    one, other = interpolated(first, second, share), interpolated(first, flipped, share)
    for i in range(3):
        unit = [float(i == j) for j in range(3)]
        assert one.apply(unit) == pytest.approx(other.apply(unit), abs=1e-9)


@given(vectors, vectors)
def test_the_ends_come_back_as_they_are(a, b):
    first, second = (Pose((0.0, 0.0, 0.0), quaternion_from_vector(v)) for v in (a, b))
    assert interpolated(first, second, 0.0) is first
    assert interpolated(first, second, 1.0) is second


@pytest.mark.parametrize("share", [-0.1, 1.1, math.nan])
def test_a_share_outside_the_way_is_refused(share):
    with pytest.raises(InvalidInput, match="share: "):
        interpolated(Pose.identity(), Pose.identity(), share)


def test_a_vector_that_is_not_finite_is_refused():
    with pytest.raises(InvalidInput, match="rotation_vector"):
        quaternion_from_vector((math.nan, 0.0, 0.0))


@given(st.tuples(*[st.floats(-1e7, 1e7)] * 3), vectors, vectors, st.floats(0.0, 1.0))
def test_a_camera_that_only_turns_stays_where_it_is(at_m, a, b, share):
    first, second = (Pose(at_m, quaternion_from_vector(v)) for v in (a, b))
    assert interpolated(first, second, share).translation_m == at_m


def angle_rad(first: Pose, second: Pose) -> float:
    return math.hypot(*rotation_vector(first.inverse().compose(second).rotation))
