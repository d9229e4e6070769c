"""Laws of poses and cameras: groups, golden points, and refusals that name the value."""

import math
from itertools import product

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from rfcore.camera import LATTICE, Camera, Intrinsics, Pose, PoseLattice
from rfcore.errors import InvalidInput

coordinate = st.floats(-1e7, 1e7)
component = st.floats(-1, 1)


@st.composite
def poses(draw: st.DrawFn) -> Pose:
    q = draw(st.tuples(component, component, component, component))
    norm = math.sqrt(sum(v * v for v in q))
    if norm < 0.1:
        q, norm = (1.0, 0.0, 0.0, 0.0), 1.0
    rotation = (q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm)
    return Pose(draw(st.tuples(coordinate, coordinate, coordinate)), rotation)


def matrix_of(pose: Pose) -> list[list[float]]:
    rows = zip(pose.rotation_matrix(), pose.translation_m, strict=True)
    return [[*row, t] for row, t in rows]


@given(poses())
def test_a_pose_after_its_inverse_is_the_identity(pose):
    product = pose.compose(pose.inverse())
    size = 1.0 + max(map(abs, pose.translation_m))
    assert max(map(abs, product.translation_m)) < 1e-14 * size * 10
    assert abs(product.rotation[0]) == pytest.approx(1.0, abs=1e-12)


@given(poses(), st.tuples(component, component, component))
def test_composition_acts_as_one_map_after_the_other(pose, point):
    turn = Pose((1.0, -2.0, 3.0), (0.5, 0.5, -0.5, 0.5))
    assert turn.compose(pose).apply(point) == pytest.approx(
        turn.apply(pose.apply(point)), rel=1e-12, abs=1e-6
    )


@given(poses())
def test_a_quaternion_and_its_negative_are_the_same_rotation(pose):
    w, x, y, z = pose.rotation
    assert Pose(pose.translation_m, (-w, -x, -y, -z)).rotation_matrix() == pose.rotation_matrix()


@given(poses())
def test_a_pose_survives_the_way_through_its_matrix(pose):
    back = Pose.from_matrix(matrix_of(pose))
    assert back.translation_m == pose.translation_m
    for got, want in zip(back.rotation_matrix(), pose.rotation_matrix(), strict=True):
        assert got == pytest.approx(want, abs=1e-12)


@pytest.mark.parametrize("angle_rad", [math.pi, math.pi - 1e-9, 1e-9, 0.0])
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1)])
def test_matrices_near_a_half_turn_give_a_unit_quaternion(angle_rad, axis):
    s = math.sin(angle_rad / 2)
    pose = Pose((0, 0, 0), (math.cos(angle_rad / 2), s * axis[0], s * axis[1], s * axis[2]))
    back = Pose.from_matrix(matrix_of(pose))
    for got, want in zip(back.rotation_matrix(), pose.rotation_matrix(), strict=True):
        assert got == pytest.approx(want, abs=1e-9)


def test_a_point_on_the_axis_lands_on_the_principal_point():
    camera = Camera(Intrinsics(640, 360, 320, 320, 320, 180), Pose.identity())
    assert camera.project((0, 0, 5)) == (320, 180, 5)
    assert camera.project((1, 0, 2)) == (480, 180, 2), "x to the right"
    assert camera.project((0, 1, 2)) == (320, 340, 2), "y down"


def test_resizing_keeps_the_ray_of_a_pixel():
    full = Intrinsics(1920, 1080, 960.0, 970.0, 955.0, 541.0)
    small = full.resized(720, 404)
    assert (0.5 * small.width_px - small.cx_px) / small.fx_px == pytest.approx(
        (0.5 * full.width_px - full.cx_px) / full.fx_px
    )


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"width_px": 0}, "intrinsics.width_px: 0 px"),
        ({"height_px": 8193}, "intrinsics.height_px: 8193 px"),
        ({"fx_px": -1.0}, "intrinsics.fx_px: -1.0"),
        ({"fy_px": math.inf}, "intrinsics.fy_px: inf"),
        ({"cx_px": math.nan}, "intrinsics.cx_px: nan"),
    ],
)
def test_bad_intrinsics_are_refused_by_name(change, named):
    good = {"width_px": 64, "height_px": 36, "fx_px": 32.0, "fy_px": 32.0, "cx_px": 32.0}
    with pytest.raises(InvalidInput, match=named):
        Intrinsics(**{**good, "cy_px": 18.0, **change})


@pytest.mark.parametrize(
    ("translation_m", "rotation", "named"),
    [
        ((math.nan, 0, 0), (1, 0, 0, 0), "pose.translation_m"),
        ((0, 0, 0), (math.inf, 0, 0, 0), "pose.rotation"),
        ((0, 0, 0), (1.0, 0.1, 0, 0), "norm 1.00498"),
        ((0, 0, 0), (0, 0, 0, 0), "norm 0"),
    ],
)
def test_bad_poses_are_refused_by_name(translation_m, rotation, named):
    with pytest.raises(InvalidInput, match=named):
        Pose(translation_m, rotation)


@given(poses())
def test_a_rounded_pose_is_near_and_stays_as_it_is(pose):
    """Half a step along each axis; of the quaternion's parts at most half a step times the largest,
    and the angle between unit quaternions is twice the one between them as vectors."""
    rounded = pose.rounded()
    assert rounded.rounded() == rounded
    for near, true in zip(rounded.translation_m, pose.translation_m, strict=True):
        assert abs(near - true) <= 0.25e-3 + 1e-15 * abs(true)
    turned_rad = 2 * math.asin(math.hypot(*rounded.inverse().compose(pose).rotation[1:]))
    assert turned_rad <= math.sqrt(3) / LATTICE.rotation_steps


@given(st.sampled_from(list(product((-1, 0, 1), repeat=4))[1:]), st.floats(-1e-9, 1e-9))
def test_a_pose_with_equal_parts_is_rounded_once(signs, tilt):
    parts = [sign + tilt * place for place, sign in enumerate(signs)]
    norm = math.hypot(*parts)
    assume(norm > 0.5)
    rounded = Pose((0.0, 0.0, 0.0), tuple(part / norm for part in parts)).rounded()
    assert rounded.rounded() == rounded
    steps = LATTICE.steps(rounded)
    assert next(s for s in steps[3:] if abs(s) == LATTICE.rotation_steps) > 0
    assert LATTICE.pose(steps) == rounded


@pytest.mark.parametrize("wrong", [{"steps_per_m": 0}, {"rotation_steps": 1 << 21}])
def test_a_lattice_out_of_range_is_refused(wrong):
    with pytest.raises(InvalidInput, match=next(iter(wrong))):
        PoseLattice(**wrong)
