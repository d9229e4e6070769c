"""The street's parts stay where the plan puts them, and follow from the seed alone."""

import hashlib

import numpy as np
import pytest

from streetgen.classes import Label
from streetgen.geometry.building import buildings
from streetgen.geometry.facade import BuildingStyle, facade, wall_around
from streetgen.geometry.furniture import lamps, railings, wires
from streetgen.geometry.grain import fractal
from streetgen.geometry.layout import BAY_LENGTH_M, FACADE_M, FASCIA_M, Geometry, Layout
from streetgen.geometry.mesh import Mesh, joined
from streetgen.geometry.road import road
from streetgen.geometry.solids import Surface
from streetgen.geometry.world import StreetPart

LAYOUT = Layout(Geometry(length_m=60.0))
PARTS = (road, buildings, lamps, railings, wires)


@pytest.fixture(scope="module")
def built() -> dict[str, StreetPart]:
    return {part.__name__: part(LAYOUT, np.random.default_rng(1)) for part in PARTS}


def digest(part: StreetPart) -> str:
    found = hashlib.sha256()
    for mesh in joined(part.meshes):
        assert mesh.normals is not None
        for values in (mesh.vertices, mesh.faces, mesh.uv, mesh.normals):
            found.update(values.tobytes())
    for material in part.materials:
        found.update(np.asarray(material.colour).tobytes())
    return found.hexdigest()


@pytest.mark.parametrize("part", [road, lamps, railings, wires], ids=lambda part: part.__name__)
def test_the_same_seed_gives_the_same_bytes(part, built):
    again = part(LAYOUT, np.random.default_rng(1))
    assert digest(again) == digest(built[part.__name__])


def test_every_mesh_has_its_material(built):
    for part in built.values():
        named = {material.name for material in part.materials}
        assert {mesh.material for mesh in part.meshes} <= named


def test_nothing_stands_in_the_way_of_a_car(built):
    """Between the parking bays, from 2 cm to 4 m over the road, there is nothing."""
    for part in built.values():
        for mesh in part.meshes:
            x, y, z = mesh.vertices.T
            inside = (np.abs(x) < 30) & (np.abs(y) < 4.2) & (z > 0.02) & (z < 4.0)
            assert not inside.any(), mesh.material


def test_the_ground_is_where_the_plan_says(built):
    for mesh in built["road"].meshes:
        if mesh.label in (Label.ROAD, Label.MARKING):
            assert np.abs(mesh.vertices[:, 2]).max() < 0.01
    markings = [mesh for mesh in built["road"].meshes if mesh.label == Label.MARKING]
    assert np.abs(np.concatenate([m.vertices for m in markings])[:, 1]).max() < 6.61


def test_the_lines_of_the_bays_are_where_vehicles_park_and_off_the_crossings():
    layout = Layout(Geometry(length_m=200.0))
    meshes = road(layout, np.random.default_rng(1)).meshes
    painted = np.concatenate([mesh.vertices for mesh in meshes if mesh.label == Label.MARKING])
    at_kerb_x_m = painted[np.abs(painted[:, 1]) > 6.5][:, 0]
    assert not any(layout.at_crossing(float(x), 1.0) for x in at_kerb_x_m)
    middles = np.array([bay.x_m for bay in layout.bays])
    from_middle_m = np.abs(at_kerb_x_m[:, None] - middles).min(axis=1)
    np.testing.assert_allclose(from_middle_m, BAY_LENGTH_M / 2, atol=0.06)


def test_wires_are_thin_and_hang_over_the_cars(built):
    low = min(mesh.vertices[:, 2].min() for mesh in built["wires"].meshes)
    assert 5.5 < low < 7.0
    assert {mesh.label for mesh in built["wires"].meshes} == {Label.WIRE}


def area_m2(areas: np.ndarray) -> float:
    return float(((areas[:, 2] - areas[:, 0]) * (areas[:, 3] - areas[:, 1])).sum())


def test_a_wall_and_its_openings_fill_the_storey():
    openings = np.array([[4.0, 0.5, 5.0, 2.0], [1.0, 0.0, 2.5, 2.5]])
    wall = wall_around(6.0, 0.0, 3.0, openings)
    assert area_m2(wall) + area_m2(openings) == pytest.approx(18.0)
    assert (wall[:, 2] > wall[:, 0]).all()
    assert (wall[:, 3] > wall[:, 1]).all()


def surface(name: str) -> Surface:
    return Surface(name, Label.BUILDING)


@pytest.mark.parametrize("style", range(6))
def test_a_facade_leaves_the_fascia_bare(style):
    """But for the rain pipe at its left edge nothing stands out where a sign may hang."""
    plot = LAYOUT.plots[style % len(LAYOUT.plots)]
    look = BuildingStyle(surface("wall"), surface("frame"), surface("door"))
    low, high = FASCIA_M
    for mesh in facade(plot, look, np.random.default_rng(style)):
        u, v, w = mesh.vertices.T
        assert u.min() > -0.01
        assert u.max() < plot.width_m + 0.01
        over = mesh.vertices[mesh.faces]
        spans = (over[..., 1].min(axis=1) < high) & (over[..., 1].max(axis=1) > low)
        out = over[spans & (over[..., 0].max(axis=1) > 0.3)][..., 2]
        assert out.size == 0 or out.max() <= 0.0
    assert v.size == w.size


def test_facades_stand_on_their_line_and_look_at_the_road(built):
    glass = [mesh for mesh in joined(built["buildings"].meshes) if mesh.label == Label.WINDOW]
    assert len(glass) == 1
    along = np.abs(glass[0].vertices[:, 0]) < 30
    y, towards = glass[0].vertices[along, 1], normals(glass[0])[along, 1]
    np.testing.assert_allclose(np.abs(y), FACADE_M + 0.18, atol=1e-4)
    np.testing.assert_allclose(towards, -np.sign(y), atol=1e-5)


def normals(mesh: Mesh) -> np.ndarray:
    assert mesh.normals is not None
    return mesh.normals


def test_textures_repeat_without_a_seam():
    """Across the seam values differ no more than across the middle."""
    noise = fractal((128, 256), 2.0, np.random.default_rng(1))
    seam, inner = np.abs(noise[0] - noise[-1]).mean(), np.abs(noise[64] - noise[63]).mean()
    assert noise.std() == pytest.approx(1.0, abs=1e-5)
    assert seam < 1.5 * inner
