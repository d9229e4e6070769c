"""WGS 84 and a field's own axes: against the ellipsoid's radii, round trips, refusals, files."""

from __future__ import annotations

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.camera import Pose, TileOrigin
from rfcore.errors import InvalidInput
from rfcore.geodesy import Anchor, anchor_of_values, anchor_values
from rfcore.motion import quaternion_from_vector

A_M, E2 = 6378137.0, 6.69437999014e-3
"""Semi-major axis and squared eccentricity of WGS 84 (NIMA TR8350.2)."""

latitudes = st.floats(-85, 85)
longitudes = st.floats(-179, 179)
metres = st.tuples(*[st.floats(-400, 400)] * 3)
turns = st.tuples(*[st.floats(-3, 3)] * 3).map(quaternion_from_vector)
anchors = st.builds(Anchor, latitudes, longitudes, st.floats(-100, 3000), turns, metres)


@given(latitudes)
def test_a_little_north_and_east_is_the_ellipsoids_radius_times_the_angle(latitude_deg):
    """Radii of the meridian and of the parallel: M = a(1-e2)/w^3, N cos(lat) = a cos(lat)/w."""
    anchor = Anchor(latitude_deg, 10.0)
    step_deg = 1e-4
    w = math.sqrt(1 - E2 * math.sin(math.radians(latitude_deg)) ** 2)
    east, north, up = anchor.world_from_geodetic(latitude_deg + step_deg, 10.0, 0.0)
    assert north == pytest.approx(A_M * (1 - E2) / w**3 * math.radians(step_deg), rel=1e-4)
    assert abs(east) < 1e-6
    assert abs(up) < 1e-4
    east, *_ = anchor.world_from_geodetic(latitude_deg, 10.0 + step_deg, 0.0)
    wide_m = A_M * math.cos(math.radians(latitude_deg)) / w * math.radians(step_deg)
    assert east == pytest.approx(wide_m, rel=1e-4)


@given(anchors, metres)
def test_points_come_back_through_wgs84(anchor, point_m):
    found = anchor.world_from_geodetic(*anchor.geodetic_from_world(point_m))
    assert found == pytest.approx(point_m, abs=1e-3)


@given(anchors)
def test_the_anchors_own_point_is_where_the_anchor_says(anchor):
    place = (anchor.latitude_deg, anchor.longitude_deg, anchor.height_m)
    assert anchor.world_from_geodetic(*place) == pytest.approx(anchor.point_m, abs=1e-5)


def test_axes_that_are_not_east_north_up_are_turned():
    # a camera's axes looking north: x east, y down, z north
    down = quaternion_from_vector((-math.pi / 2, 0.0, 0.0))
    anchor = Anchor(48.0, 11.0, 500.0, down)
    x, y, z = anchor.world_from_geodetic(48.001, 11.0, 500.0)
    assert z == pytest.approx(111.2, abs=0.2)
    assert abs(x) < 0.01
    assert abs(y) < 0.01
    upright = anchor.turned_from_enu(down)
    assert Pose((0, 0, 0), upright).apply((1.0, 2.0, 3.0)) == pytest.approx((1.0, 2.0, 3.0))


@given(anchors)
def test_json_holds_an_anchor(anchor):
    assert anchor_of_values(json.loads(json.dumps(anchor_values(anchor)))) == anchor


@pytest.mark.parametrize(
    "values",
    [
        {},
        [],
        {"latitude_deg": 48.0},
        {"latitude_deg": 91.0, "longitude_deg": 0.0},
        {"latitude_deg": math.nan, "longitude_deg": 0.0},
        {"latitude_deg": 1.0, "longitude_deg": "11"},
        {"latitude_deg": 1.0, "longitude_deg": True},
        {"latitude_deg": 1.0, "longitude_deg": 2.0, "height": 3.0},
        {"latitude_deg": 1.0, "longitude_deg": 2.0, "enu_from_world": [1.0, 0.0]},
        {"latitude_deg": 1.0, "longitude_deg": 2.0, "enu_from_world": [2.0, 0.0, 0.0, 0.0]},
    ],
)
def test_what_is_no_anchor_is_refused(values):
    with pytest.raises(InvalidInput):
        anchor_of_values(values)


def test_an_anchor_follows_the_tiles_origin():
    anchor = Anchor(48.0, 11.0, 500.0, point_m=(5.0, 6.0, 7.0))
    moved = anchor.relative_to(TileOrigin(100.0, 200.0, 300.0))
    assert moved.point_m == (-95.0, -194.0, -293.0)
    point = moved.world_from_geodetic(48.0, 11.0, 500.0)
    assert point == pytest.approx((-95.0, -194.0, -293.0))
