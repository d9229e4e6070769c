"""Objects among the splats of a street: where they are put, before and behind what is there."""

import math
from dataclasses import replace

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfcore.field import SplatField
from rfedge.twin import placed_objects
from rfedge.twin.placed_objects import PlacedObject, with_objects

K = Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0)
CAMERA = Camera(K, Pose.identity())


@pytest.fixture(scope="module")
def spot(wall: SplatField) -> SplatField:
    """A bright splat 1 m along its object's x axis, opaque."""
    one = {name: np.ascontiguousarray(value[:1]) for name, value in vars(wall.gaussians).items()}
    one["means"] = np.float32([[1, 0, 0]])
    return SplatField(replace(wall.gaussians, **one | {"sh": np.full((1, 1, 3), 1.7, np.float32)}))


def test_a_street_without_objects_is_itself(wall):
    assert with_objects(wall, []) is wall


def test_an_object_is_where_its_pose_puts_it(wall, spot):
    """Turned by a quarter about z, its x axis points down in the picture."""
    pose = Pose((0.2, -0.6, 3.0), (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)))
    shown = with_objects(wall, [PlacedObject(spot, pose)]).render_colour(CAMERA)
    brighter = shown[..., 0] - wall.render_colour(CAMERA)[..., 0]
    v, u = np.unravel_index(brighter.argmax(), brighter.shape)
    at = CAMERA.project((0.2, 0.4, 3.0))
    assert abs(u + 0.5 - at[0]) <= 1
    assert abs(v + 0.5 - at[1]) <= 1
    assert brighter.max() > 0.3


def test_what_stands_behind_the_wall_is_hidden_by_it(wall, spot):
    behind = with_objects(wall, [PlacedObject(spot, Pose((-1.0, 0.0, 6.0), (1, 0, 0, 0)))])
    np.testing.assert_allclose(
        behind.render_colour(CAMERA), wall.render_colour(CAMERA), atol=1 / 255
    )


def test_bands_that_an_object_lacks_are_no_colour(wall, spot):
    """A street of degree 1 whose first band is 0 shows the bytes of one of degree 0."""
    sh = np.zeros((len(wall.gaussians), 4, 3), np.float32)
    sh[:, :1] = wall.gaussians.sh
    placed = [PlacedObject(spot, Pose((-1.0, 0.0, 2.0), (1, 0, 0, 0)))]
    plain = with_objects(wall, placed)
    richer = with_objects(SplatField(replace(wall.gaussians, sh=sh)), placed)
    assert richer.gaussians.sh_degree == 1
    np.testing.assert_array_equal(richer.render_colour(CAMERA), plain.render_colour(CAMERA))


def test_too_many_splats_are_refused_before_they_are_placed(wall, spot, monkeypatch):
    monkeypatch.setattr(placed_objects, "MOST_SPLATS", 2)
    with pytest.raises(InvalidInput, match="3 splats are above 2; ask for fewer objects"):
        with_objects(wall, [PlacedObject(spot, Pose.identity())] * 3)
