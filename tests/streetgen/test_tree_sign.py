"""Trees and signs stand on the ground, follow from the seed, and signs can be read."""

import math

import numpy as np
import pytest

from streetgen.classes import Label
from streetgen.geometry.furniture import post_of, signs, traffic_light
from streetgen.geometry.layout import PAVEMENT_UP_M, Geometry, Layout
from streetgen.geometry.mesh import Mesh
from streetgen.geometry.signage import FACES, NAMES, ROUND, face_picture, sign_materials
from streetgen.geometry.tree import KINDS, grown, trees
from streetgen.geometry.world import StreetPart

LAYOUT = Layout(Geometry(length_m=100.0))
TREE_BUDGET = 70_000


def rng(seed: int = 2) -> np.random.Generator:
    return np.random.default_rng(seed)


@pytest.fixture(scope="module")
def forest() -> StreetPart:
    return trees(LAYOUT, rng())


@pytest.fixture(scope="module")
def posted() -> StreetPart:
    return signs(LAYOUT, rng())


@pytest.mark.parametrize("kind", KINDS)
def test_a_tree_reaches_into_the_ground_and_is_as_tall_as_street_trees_are(kind):
    meshes = grown(kind, rng())
    bark, leaves = meshes
    assert (bark.material, leaves.material) == ("bark", "leaf")
    assert -0.1 < bark.vertices[:, 2].min() < 0
    foot = bark.vertices[bark.vertices[:, 2] < 0.1]
    assert np.hypot(foot[:, 0], foot[:, 1]).max() < 0.35
    assert 4.5 < leaves.vertices[:, 2].max() < 11
    assert leaves.vertices[:, 2].min() > 1.2, "people walk below it"
    assert sum(len(mesh.faces) for mesh in meshes) < TREE_BUDGET


def test_leaves_are_near_wood():
    bark, leaves = grown(KINDS[0], rng())
    some = leaves.vertices[::400]
    away = np.linalg.norm(some[:, None] - bark.vertices[None, ::3], axis=2).min(axis=1)
    assert np.quantile(away, 0.9) < 0.6


def test_every_place_has_a_tree_in_a_pit(forest):
    soil = [mesh for mesh in forest.meshes if mesh.material == "soil"]
    assert len(soil) == len(LAYOUT.trees) > 5
    for mesh, place in zip(soil, LAYOUT.trees, strict=True):
        np.testing.assert_allclose(mesh.vertices[:, :2].mean(axis=0), (place.x_m, place.y_m), 1e-4)
    assert {mesh.material for mesh in forest.meshes} <= {m.name for m in forest.materials}
    assert {m.label for m in forest.meshes if m.material == "leaf"} == {Label.VEGETATION}


def test_trees_and_signs_follow_from_the_seed(forest, posted):
    for part, make in ((forest, trees), (posted, signs)):
        again, other = make(LAYOUT, rng()), make(LAYOUT, rng(3))
        assert same(part.meshes, again.meshes)
        if make is trees:
            assert not same(part.meshes, other.meshes)


@pytest.mark.parametrize("face", range(len(FACES)))
def test_a_sign_hangs_on_a_post_that_reaches_into_the_ground(face):
    meshes = post_of(face, 1)
    post = next(mesh for mesh in meshes if mesh.label == Label.POLE)
    assert post.vertices[:, 2].min() < -0.2
    for mesh in meshes:
        if mesh.material == "sign face":
            low, high = mesh.vertices[:, 2].min(), mesh.vertices[:, 2].max()
            assert high - low == pytest.approx(0.6, abs=0.01)
            assert low > 2.0, "heads pass below"
            assert post.vertices[:, 2].min() < low < post.vertices[:, 2].max()
            assert np.abs(mesh.vertices[:, 0]).max() < 0.06, "it is clamped to its post"


def test_all_posts_of_a_street_end_below_the_pavement(posted):
    for mesh in posted.meshes:
        assert np.isfinite(mesh.vertices).all()
    posts = [m for m in posted.meshes if m.material == "sign post" and np.ptp(m.vertices[:, 2]) > 2]
    assert len(posts) >= 8
    assert max(post.vertices[:, 2].min() for post in posts) < PAVEMENT_UP_M


def test_lights_over_the_lane_hang_higher_than_a_truck():
    for lit in range(3):
        meshes = traffic_light(lit)
        over_lane = [m for m in meshes if m.vertices[:, 1].max() < -1.0]
        assert over_lane
        assert min(mesh.vertices[:, 2].min() for mesh in over_lane) > 4.0
        names = {m.material for m in meshes if m.material.startswith("signal ")}
        on = {name for name in names if not name.endswith("off") and name != "signal case"}
        assert len(on) == 1


def test_a_signs_face_looks_at_who_drives_up_to_it(posted):
    """On the left edge (y > 0) traffic comes from +x, on the right one from -x."""
    for mesh in posted.meshes:
        if mesh.material == "sign face":
            a, b, c = mesh.vertices[mesh.faces[0]]
            facing = np.cross(b - a, c - a)
            assert facing[0] * mesh.vertices[0, 1] > 0


def test_letters_are_on_the_texture_and_differ():
    pictures = {text: face_picture(text) for text in FACES}
    assert len({p.tobytes() for p in pictures.values()}) == len(FACES)
    for text in ("30", "50"):
        inner = pictures[text][70:186, 70:186].astype(int)
        dark = (inner.max(axis=2) < 90).mean()
        assert 0.1 < dark < 0.6, text
    names = next(m.colour for m in sign_materials() if m.name == "street name")
    rows = np.split(np.asarray(names), len(NAMES))
    assert all(0.03 < (row[16:-16].min(axis=2) > 200).mean() < 0.5 for row in rows)
    assert len({row.tobytes() for row in rows}) == len(NAMES)


def test_a_round_sign_shows_its_own_face():
    for text in ROUND:
        face = FACES.index(text)
        front = next(mesh for mesh in post_of(face, 0) if mesh.material == "sign face")
        v = front.uv[:, 1] * len(FACES)
        assert face <= v.min() < v.max() <= face + 1
        top = front.vertices[:, 2].argmax()
        assert v[top] == pytest.approx(v.min(), abs=0.02), "the picture is upright"
        left = front.vertices[:, 1].argmin()
        assert front.uv[left, 0] == pytest.approx(front.uv[:, 0].min(), abs=0.02)
    assert math.isclose(0.6, np.ptp(front.vertices[:, 2]), abs_tol=0.01)


def same(one: tuple[Mesh, ...], other: tuple[Mesh, ...]) -> bool:
    return len(one) == len(other) and all(
        a.vertices.shape == b.vertices.shape and (a.vertices == b.vertices).all()
        for a, b in zip(one, other, strict=True)
    )
