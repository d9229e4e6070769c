"""Meshes keep their shape when they are moved and joined; a world knows its materials."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from rfcore.errors import InvalidInput
from streetgen.classes import Label
from streetgen.geometry.layout import Geometry, Layout
from streetgen.geometry.mesh import Material, Mesh, faceted, joined, placed
from streetgen.geometry.world import Sky, StreetPart, World


def triangle(material: str = "clay", label: Label = Label.OBJECT) -> Mesh:
    return Mesh(
        vertices=np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0]], np.float32),
        faces=np.array([[0, 1, 2]], np.int32),
        uv=np.zeros((3, 2), np.float32),
        material=material,
        label=label,
    )


def sky() -> Sky:
    return Sky(np.ones((4, 8, 3), np.float32))


def test_a_placed_mesh_is_turned_scaled_and_moved():
    quarter = np.array([[0, -3, 0, 10], [3, 0, 0, 0], [0, 0, 3, 1], [0, 0, 0, 1]], float)
    smooth = faceted(triangle())
    moved = placed(smooth, quarter)
    np.testing.assert_allclose(moved.vertices, [[10, 0, 1], [10, 6, 1], [4, 0, 1]], atol=1e-6)
    assert moved.normals is not None
    np.testing.assert_allclose(moved.normals, [[0, 0, 1]] * 3, atol=1e-6)


def test_joined_meshes_have_all_triangles_of_each_material_and_label():
    far = placed(triangle(), np.eye(4) + np.eye(4, k=3) * 5)
    meshes = joined([triangle(), triangle("glass"), far, triangle("clay", Label.POLE)])
    assert [(m.material, m.label, len(m.faces)) for m in meshes] == [
        ("clay", Label.OBJECT, 2),
        ("glass", Label.OBJECT, 1),
        ("clay", Label.POLE, 1),
    ]
    np.testing.assert_array_equal(meshes[0].vertices[meshes[0].faces[1]], far.vertices)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"faces": np.array([[0, 1, 3]], np.int32)}, "name none of 3 vertices"),
        ({"uv": np.zeros((2, 2), np.float32)}, r"\(2, 2\), not float32 \(3, 2\)"),
        ({"vertices": np.full((3, 3), np.nan, np.float32)}, "not all finite"),
        ({"vertices": np.zeros((3, 3))}, "float64"),
    ],
)
def test_a_mesh_that_is_none_is_refused(change, said):
    with pytest.raises(InvalidInput, match=said):
        replace(triangle(), **change)


def test_a_world_has_the_materials_its_meshes_name():
    clay = Material("clay", (0.4, 0.3, 0.2))
    empty = World(Layout(Geometry()), sky())
    world = empty.plus(StreetPart((triangle(),), (clay,)))
    assert world.plus(StreetPart((triangle(),), (clay,))).materials == {"clay": clay}
    with pytest.raises(InvalidInput, match="names two"):
        world.plus(StreetPart((), (Material("clay", (0, 0, 0)),)))
    with pytest.raises(InvalidInput, match="have no 'glass'"):
        world.plus(StreetPart((triangle("glass"),), ()))
    assert world.with_material(wet := replace(clay, gloss=True)).materials["clay"] is wet


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"colour": (0.5, 1.5, 0)}, "outside 0..1"),
        ({"colour": np.zeros((4, 4), np.uint8)}, r"not uint8 \[H, W, 3\]"),
        ({"roughness": np.zeros((4, 4))}, "neither a number nor"),
    ],
)
def test_a_material_that_is_none_is_refused(values, said):
    with pytest.raises(InvalidInput, match=said):
        Material(**{"name": "m", "colour": (0, 0, 0), **values})


@pytest.mark.parametrize("seed", range(5))
def test_nothing_stands_on_a_crossing_or_in_a_lamp(seed):
    layout = Layout(Geometry(seed=seed, length_m=200.0))
    assert len(layout.crossings_x_m) >= 2
    for place in (*layout.trees, *layout.bays):
        assert not layout.at_crossing(place.x_m, 2.0)
    for tree in layout.trees:
        assert all(abs(tree.x_m - p.x_m) > 1.9 for p in layout.lamps if p.side == tree.side)
    assert Layout(layout.geometry).plots == layout.plots


def test_plots_follow_one_another_without_overlap():
    layout = Layout(Geometry())
    for side in (1, -1):
        row = [plot for plot in layout.plots if plot.side == side]
        assert row[0].start_m == layout.start_m
        assert row[-1].end_m > layout.end_m - 6
        assert all(b.start_m >= a.end_m for a, b in pairwise(row))
