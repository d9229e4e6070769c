"""Vehicles: whole, of the right size, on the road, closed, and no heavier than they need to be."""

import math
from itertools import pairwise

import numpy as np
import pytest

from rfcore.errors import InvalidInput
from streetgen.classes import Label
from streetgen.geometry.mesh import Mesh
from streetgen.geometry.signage import Lettered, atlas, atlas_uv, board
from streetgen.geometry.vehicle import KINDS, VehicleLooks, standing, vehicle
from streetgen.geometry.vehicle_body import surface_of
from streetgen.geometry.vehicle_shape import BODIES, BodyShape, curve
from streetgen.geometry.vehicle_trim import PAINTS, PLATES, vehicle_materials

SIZES_M = {
    "hatchback": (4.26, 1.79, 1.48),
    "saloon": (4.72, 1.83, 1.44),
    "estate": (4.68, 1.82, 1.48),
    "suv": (4.48, 1.86, 1.66),
    "van": (5.55, 2.02, 2.39),
    "truck": (7.0, 2.4, 3.27),
}
"""Length, width without mirrors, height: a Golf, a Passat, its estate, a Tiguan, a Sprinter."""
BUDGET = 20_000
MIRRORS_M = 0.45


@pytest.fixture(params=KINDS)
def kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def looking_like(kind: str) -> VehicleLooks:
    return VehicleLooks(kind, "paint red", plate=3, livery=1)


def vertices(meshes: list[Mesh]) -> np.ndarray:
    return np.concatenate([mesh.vertices for mesh in meshes])


def test_a_vehicle_has_its_size_and_stands_on_the_road(kind):
    points = vertices(vehicle(looking_like(kind)))
    length, width, height = SIZES_M[kind]
    size = np.ptp(points, axis=0)
    assert size[0] == pytest.approx(length, abs=0.06)
    assert width <= size[1] <= width + MIRRORS_M
    assert size[2] == pytest.approx(height, abs=0.02)
    assert abs(points[:, 2].min()) < 1e-4


def test_a_vehicle_is_within_its_budget_and_one_mesh_a_material(kind):
    meshes = vehicle(looking_like(kind))
    assert sum(len(mesh.faces) for mesh in meshes) < BUDGET
    assert len({mesh.material for mesh in meshes}) == len(meshes)
    assert {mesh.label for mesh in meshes} == {Label.VEHICLE}
    assert {mesh.material for mesh in meshes} <= {m.name for m in vehicle_materials()}


def test_all_four_tyres_touch_the_road(kind):
    tyres = next(mesh for mesh in vehicle(looking_like(kind)) if mesh.material == "tyre")
    touching = tyres.vertices[tyres.vertices[:, 2] < 0.002]
    corners = {(x > 0, y > 0) for x, y, _ in touching.tolist()}
    assert len(corners) == 4


def test_a_vehicle_is_the_same_on_both_sides(kind):
    """But for the truck's tank; the text of a plate is not mirrored either."""
    for mesh in vehicle(looking_like(kind)):
        if kind != "truck" and mesh.material in ("paint red", "car glass", "tyre"):
            mirrored = mesh.vertices * (1, -1, 1)
            mine, other = (np.unique(v.round(3), axis=0) for v in (mesh.vertices, mirrored))
            assert len(mine) == pytest.approx(len(other), abs=0.01 * len(mine))
            assert mesh.vertices[:, 1].max() == pytest.approx(-mesh.vertices[:, 1].min(), abs=1e-3)


def test_a_body_has_no_holes(kind):
    """Every edge of loft and ends is shared by two quads, but for the open sill."""
    surface = surface_of(BODIES["cab" if kind == "truck" else kind])
    sides, nose, tail = surface.sides.points, surface.nose.points, surface.tail.points
    for face, outline in ((nose, sides[0]), (tail, sides[-1][::-1])):
        rows = len(face)
        np.testing.assert_allclose(face[:, 0], outline[:rows], atol=1e-9)
        np.testing.assert_allclose(face[:, -1], outline[: rows - 2 : -1], atol=1e-9)


def test_normals_look_out_of_the_body(kind):
    """Over a star-shaped body they point away from its middle nearly everywhere."""
    for mesh in vehicle(looking_like(kind)):
        if mesh.material == "paint red":
            np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-5)
            a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
            turned = np.cross(b - a, c - a)
            agree = (turned * mesh.normals[mesh.faces[:, 0]]).sum(axis=1) >= -1e-9
            assert agree.mean() > 0.98, "faces turn anticlockwise seen from outside"


def test_windows_lie_between_belt_and_roof():
    glass = next(m for m in vehicle(looking_like("saloon")) if m.material == "car glass")
    assert glass.vertices[:, 2].min() > 0.85
    assert glass.vertices[:, 2].max() < 1.44


def test_wheels_have_room_in_their_arches(kind):
    shape = BODIES["cab" if kind == "truck" else kind]
    surface = surface_of(shape)
    for axle in shape.axles_m:
        at = surface.sides.at
        over = surface.sides.points[np.abs(at - axle).argmin(), 0, 2]
        assert 0.02 < over - 2 * shape.wheel_radius_m < 0.10


def test_a_vehicle_that_is_turned_stands_where_it_is_put():
    own = vertices(vehicle(looking_like("hatchback")))
    there = vertices(standing(vehicle(looking_like("hatchback")), 10.0, -2.0, math.pi / 2))
    np.testing.assert_allclose(there[:, 0], 10.0 - own[:, 1], atol=1e-4)
    np.testing.assert_allclose(there[:, 1], -2.0 + own[:, 0], atol=1e-4)
    np.testing.assert_allclose(there[:, 2], own[:, 2])


def test_chance_draws_every_kind_and_most_paints_and_repeats_itself():
    def draw() -> list[VehicleLooks]:
        rng = np.random.default_rng(1)
        return [VehicleLooks.drawn(rng) for _ in range(300)]

    drawn = draw()
    assert drawn == draw()
    assert {looks.kind for looks in drawn} == set(KINDS)
    assert len({looks.paint for looks in drawn}) > len(PAINTS) - 2


def test_curves_go_through_their_knots_without_overshoot():
    for shape in BODIES.values():
        for knots in (shape.top, shape.belt, shape.width):
            x, y = np.array(knots).T
            np.testing.assert_allclose(curve(knots, x), y, atol=1e-12)
            for (a, low), (b, high) in pairwise(knots):
                between = curve(knots, np.linspace(a, b, 20))
                assert min(low, high) - 1e-9 <= between.min()
                assert between.max() <= max(low, high) + 1e-9


def test_a_shape_whose_stations_do_not_grow_is_refused():
    values = {**BODIES["van"].__dict__, "belt": ((0.0, 1.0), (0.0, 1.1))}
    with pytest.raises(InvalidInput, match=r"body.belt: stations \[0.0, 0.0\] do not grow"):
        BodyShape(**values)


def test_a_plates_text_is_on_its_texture_and_readable():
    """A plate shows ink within its own row, and different plates different letters."""
    texture = next(m.colour for m in vehicle_materials() if m.name == "number plate")
    assert isinstance(texture, np.ndarray)
    rows = np.split(texture, len(PLATES))
    for row in rows:
        ink = (row[12:-12, 12:-12].max(axis=2) < 90).mean()
        assert 0.04 < ink < 0.4
    assert len({row.tobytes() for row in rows}) == len(PLATES)
    plates = next(m for m in vehicle(looking_like("suv")) if m.material == "number plate")
    v = plates.uv[:, 1] * len(PLATES)
    assert v.min() > 3
    assert v.max() < 4


def test_letters_run_from_left_to_right_seen_from_outside():
    """Seen from the front, the car's right side, -y, is on the left."""
    plates = next(m for m in vehicle(looking_like("suv")) if m.material == "number plate")
    front = plates.vertices[:, 0] > 0
    for chosen, left in ((front, -1.0), (~front, 1.0)):
        y, u = plates.vertices[chosen, 1], plates.uv[chosen, 0]
        assert np.corrcoef(y, u)[0, 1] * left < -0.99


def test_a_board_holds_its_lines():
    shown = board(Lettered("Ab\ncd", (0, 0, 0), (255, 255, 255), border=False), (120, 60))
    for half in np.split(shown, 2):
        assert (half < 128).any()
    assert (shown[:, :4] == 255).all()
    two = (Lettered("I", (0, 0, 0), (255, 255, 255)),) * 2
    assert atlas(two, (64, 32)).shape == (64, 64, 3)
    uv = atlas_uv(2, 1)
    assert (uv[:, 1] > 0.5).all()
    assert uv[0, 1] > uv[3, 1]
    assert uv[1, 0] > uv[0, 0]


STORED = {
    "hatchback": (
        (0.7, 0.861783240312, 0.970233375678, 1.29271746648, 1.46222398986, 1.47870622012),
        (0.66, 0.801803620727, 0.88091317963, 0.902674487971, 0.921152670946, 0.938963360939),
    ),
    "saloon": (
        (0.66, 0.853199499373, 0.944730137314, 1.25145370108, 1.42874956464, 1.4256238877),
        (0.63, 0.791182862163, 0.865561221287, 0.891654227239, 0.913511686973, 0.93630186915),
    ),
    "cab": (
        (1.1, 1.26343751224, 1.87358172254, 2.30256156037, 2.40245107933, 2.43652525472),
        (1.02, 1.1809127673, 1.29161219399, 1.31098645841, 1.32061576333, 1.32669368512),
    ),
}
"""Top and belt at the first six of nine even stations; rounded to 12 digits, written before
SciPy drew the curves."""


@pytest.mark.parametrize("name", STORED)
def test_the_curves_are_those_that_the_committed_scenes_were_built_with(name):
    shape = BODIES[name]
    at = np.linspace(-0.1, shape.length_m + 0.1, 9).round(3)[:6]
    for knots, stored in zip((shape.top, shape.belt), STORED[name], strict=True):
        np.testing.assert_allclose(curve(knots, at), stored, rtol=0, atol=5e-12)


def test_a_curve_ends_with_the_slope_of_its_last_segment():
    """SciPy's own end slopes take a third knot into account."""
    knots = ((0.0, 0.0), (1.0, 1.0), (2.0, 4.0))
    step = 1e-6
    assert curve(knots, step) / step == pytest.approx(1.0, rel=1e-4)
    assert (4.0 - curve(knots, 2.0 - step)) / step == pytest.approx(3.0, rel=1e-4)
