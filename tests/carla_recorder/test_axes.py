"""CARLA's left-handed transforms become ours: proved with the client library's own arithmetic."""

import math

import carla
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.camera import Camera
from rfcore.errors import InvalidInput
from rfedge.datasets.carla import intrinsics_of_fov, pose_from_carla

K = intrinsics_of_fov(1920, 1080, 90.0)

place = st.tuples(*[st.floats(-200, 200, width=32)] * 3)
degrees = st.floats(-180, 180, width=32)
ahead = st.tuples(
    st.floats(2, 50, width=32), st.floats(-20, 20, width=32), st.floats(-20, 20, width=32)
)


def transform(
    at: tuple[float, float, float], angles: tuple[float, float, float]
) -> carla.Transform:
    pitch, yaw, roll = angles
    return carla.Transform(carla.Location(*at), carla.Rotation(pitch=pitch, yaw=yaw, roll=roll))


def ours_of_carla(x, y, z):
    """Return a point of CARLA's left-handed world in ours."""
    return (x, -y, z)


@given(at=place, angles=st.tuples(degrees, degrees, degrees), seen=ahead)
def test_a_point_before_the_sensor_lands_on_carlas_pixel(at, angles, seen):
    """CARLA's own recipe: in the sensor, (y, -z, x) are right, down, forward.

    ``Transform.transform`` puts the point into the world; it works in float32, 2e-5 m at 200 m and
    no more than 0.02 px of 960 at 2 m; the rotation's float32 adds 960 * 1e-6 * 10.
    """
    sensor = transform(at, angles)
    world = sensor.transform(carla.Location(*seen))
    camera = Camera(K, pose_from_carla(sensor.get_matrix()))
    u_px, v_px, depth_m = camera.project(ours_of_carla(world.x, world.y, world.z))
    x, y, z = seen
    assert depth_m == pytest.approx(x, abs=2e-4)
    assert u_px == pytest.approx(K.cx_px + K.fx_px * y / x, abs=0.1)
    assert v_px == pytest.approx(K.cy_px - K.fy_px * z / x, abs=0.1)


@given(at=place, angles=st.tuples(degrees, degrees, degrees))
def test_the_axes_are_the_librarys_vectors(at, angles):
    sensor = transform(at, angles)
    pose = pose_from_carla(sensor.get_matrix())
    right, down, forward = zip(*pose.rotation_matrix(), strict=True)
    for ours, theirs, sign in (
        (forward, sensor.get_forward_vector(), 1),
        (right, sensor.get_right_vector(), 1),
        (down, sensor.get_up_vector(), -1),
    ):
        expected = [sign * v for v in ours_of_carla(theirs.x, theirs.y, theirs.z)]
        assert ours == pytest.approx(expected, abs=1e-5)
    assert pose.translation_m == pytest.approx(ours_of_carla(*at), abs=1e-4)


def test_yaw_turns_to_the_right():
    """Positive yaw is clockwise from above in CARLA: from x towards y, which is our -y."""
    pose = pose_from_carla(transform((0, 0, 0), (0, 90, 0)).get_matrix())
    assert pose.apply((0, 0, 1)) == pytest.approx((0, -1, 0), abs=1e-6)


def test_the_field_of_view_is_horizontal():
    assert (K.fx_px, K.fy_px, K.cx_px, K.cy_px) == (pytest.approx(960.0), K.fx_px, 960.0, 540.0)
    assert math.degrees(2 * math.atan(960 / intrinsics_of_fov(1920, 1080, 60).fx_px)) == (
        pytest.approx(60)
    )
    with pytest.raises(InvalidInput, match="180"):
        intrinsics_of_fov(640, 360, 180)
