"""A field moved with its camera shows the same picture; nerfstudio's normalisation is undone."""

import json

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import FieldFormatError, InvalidInput
from rfcore.field.similarity import Similarity, moved, read_field_from_world, spherical_harmonics
from rfcore.raster import reference
from rfcore.raster.native import Rasterizer
from tests.field.some import make_gaussians

INTRINSICS = Intrinsics(40, 30, 35.0, 35.0, 20.0, 15.0)
numbers = st.floats(-1, 1, width=32)


def unit(q: tuple[float, ...]) -> tuple[float, float, float, float]:
    w, x, y, z = np.array(q) / np.linalg.norm(q)
    return (float(w), float(x), float(y), float(z))


@st.composite
def similarities(draw: st.DrawFn) -> Similarity:
    q = draw(st.tuples(numbers, numbers, numbers, numbers).filter(lambda q: np.dot(q, q) > 0.01))
    shift = draw(st.tuples(numbers, numbers, numbers))
    return Similarity(Pose(shift, unit(q)), draw(st.floats(0.05, 20)))


def test_the_basis_is_the_rasterizers():
    directions = np.random.default_rng(0).normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    want = reference.spherical_harmonics(torch.from_numpy(directions), 3).numpy()
    np.testing.assert_allclose(spherical_harmonics(directions), want, atol=1e-14)


@given(similarities())
def test_a_field_moved_with_its_camera_shows_the_same_picture(move):
    """Tolerance: float32 means and widths, through a camera at another scale."""
    g = make_gaussians(25, 3)
    here = Camera(INTRINSICS, Pose((0.5, 0.2, -4), unit((1, 0.1, -0.05, 0.02))))
    x, y, z = move.apply(np.array([here.world_from_cam.translation_m]))[0]
    turned = move.pose.compose(here.world_from_cam)
    there = Camera(INTRINSICS, Pose((float(x), float(y), float(z)), turned.rotation))
    want = Rasterizer(g).render(here)
    got = Rasterizer(moved(g, move)).render(there)
    assert np.quantile(np.abs(got.colour - want.colour), 0.99) < 2e-3
    assert np.quantile(np.abs(got.depth - move.scale * want.depth), 0.99) < 1e-2 * move.scale


@given(similarities(), similarities())
def test_moves_compose_and_invert_as_their_points_do(a, b):
    points = np.random.default_rng(1).normal(size=(5, 3))
    np.testing.assert_allclose(a.compose(b).apply(points), a.apply(b.apply(points)), atol=1e-9)
    np.testing.assert_allclose(a.inverse().apply(a.apply(points)), points, atol=1e-9)


def test_nerfstudios_frame_is_its_transform_then_its_scale(tmp_path):
    file = tmp_path / "dataparser_transforms.json"
    transform = [[0, 1, 0, 10], [-1, 0, 0, 20], [0, 0, 1, 30]]
    file.write_text(json.dumps({"transform": transform, "scale": 0.1}))
    field_from_world = read_field_from_world(file)
    point = np.array([[1.0, 2.0, 3.0]])
    want = 0.1 * (np.array(transform)[:, :3] @ point[0] + np.array(transform)[:, 3])
    np.testing.assert_allclose(field_from_world.apply(point)[0], want)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("{}", "'transform'|'scale'"),
        ("[]", "nerfstudio"),
        ("not json", "nerfstudio"),
        ('{"transform": [[2,0,0,0],[0,2,0,0],[0,0,2,0]], "scale": 1}', "not a rotation"),
        ('{"transform": [[1,0,0,0],[0,1,0,0],[0,0,1,0]], "scale": 0}', "transform.scale: 0"),
        ('{"transform": [[1,0,0,0],[0,1,0,0],[0,0,1,0]], "scale": NaN}', "nan"),
        ('{"transform": [[1,0,0,0]], "scale": 1}', "must be 3x4"),
    ],
)
def test_a_transform_that_is_none_is_refused_by_name(tmp_path, text, named):
    file = tmp_path / "dataparser_transforms.json"
    file.write_text(text)
    with pytest.raises(FieldFormatError, match=f"dataparser_transforms.json: .*({named})"):
        read_field_from_world(file)


def test_a_missing_transform_file_is_refused(tmp_path):
    with pytest.raises(FieldFormatError, match="cannot be read"):
        read_field_from_world(tmp_path / "none.json")


@pytest.mark.parametrize("scale", [0.0, -1.0, float("inf"), float("nan")])
def test_a_scale_that_is_none_is_refused(scale):
    with pytest.raises(InvalidInput, match=r"transform\.scale"):
        Similarity(Pose.identity(), scale)
