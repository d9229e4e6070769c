"""People and bicycles: of the right size, jointed, on the ground, and moving as they do."""

import math

import numpy as np
import pytest

from rfcore.errors import InvalidInput
from streetgen.classes import Label
from streetgen.geometry.cyclist import (
    PEDAL_THICK_M,
    Cyclist,
    cyclist_materials,
    cyclist_parts,
    riding,
)
from streetgen.geometry.mesh import F64, Mesh, placed
from streetgen.geometry.person import (
    ANKLE,
    FOREARM,
    SHANK,
    SIDES,
    THIGH,
    UPPER_ARM,
    BodyPart,
    Person,
    body_parts,
    person_materials,
    stride_m,
    walking,
)
from streetgen.geometry.solids import Surface, loft

CLAY = Surface("clay", Label.OBJECT)
PHASES = np.linspace(0, 2 * np.pi, 25)
BUDGET = 8_000
LINKS = {("thigh", "shank"): THIGH, ("shank", "foot"): SHANK, ("upper arm", "forearm"): UPPER_ARM}


def stood(parts: dict[str, tuple[Mesh, ...]], pose: dict[BodyPart, F64]) -> list[Mesh]:
    return [placed(mesh, frame) for part, frame in pose.items() for mesh in parts[part[0]]]


def points(meshes: list[Mesh]) -> np.ndarray:
    return np.concatenate([mesh.vertices for mesh in meshes])


@pytest.fixture(params=[1.5, 1.72, 1.98])
def somebody(request: pytest.FixtureRequest) -> Person:
    return Person(height_m=float(request.param))


def test_a_loft_is_the_ellipsoid_it_is_given_and_looks_outwards():
    """With radii a, b and c the outward normal at (x, y, z) lies along (x/a2, y/b2, z/c2)."""
    radii = np.array([0.3, 0.2, 0.5])
    turn = np.linspace(-1.45, 1.45, 41)
    wide = np.cos(turn)
    rings = [0.5 * np.sin(turn), 0 * turn, 0.3 * wide, 0.2 * wide]
    mesh = loft(CLAY, np.stack(rings, axis=1), 24)
    np.testing.assert_allclose(((mesh.vertices / radii) ** 2).sum(axis=1), 1.0, rtol=1e-5)
    assert mesh.normals is not None
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, rtol=1e-5)
    outwards = mesh.vertices / radii**2
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    inner = np.abs(mesh.vertices[:, 2]) < 0.4
    assert (mesh.normals * outwards).sum(axis=1)[inner].min() > 0.995
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    assert ((np.cross(b - a, c - a) * (a + b + c)).sum(axis=1) > -1e-12).all()


def test_a_loft_whose_sections_do_not_rise_is_refused():
    with pytest.raises(InvalidInput, match=r"loft.sections: heights \[0.0, 0.0\] do not rise"):
        loft(CLAY, [(0.0, 0.0, 1.0, 1.0), (0.0, 0.0, 0.5, 0.5)])


def test_who_stands_is_as_tall_as_declared_and_alike_on_both_sides(somebody):
    body = points(stood(body_parts(somebody), walking(somebody, 1.0, 0.0)))
    assert body[:, 2].min() == pytest.approx(0.0, abs=1e-6)
    assert body[:, 2].max() == pytest.approx(somebody.height_m, rel=0.01)
    assert body[:, 1].max() == pytest.approx(-body[:, 1].min(), abs=1e-6)
    assert 0.25 * somebody.height_m < np.ptp(body[:, 1]) < 0.32 * somebody.height_m


@pytest.mark.parametrize("swing", [0.3, 1.0, 1.3])
def test_one_foot_is_always_on_the_ground_and_none_below_it(somebody, swing):
    """The sole's edge is rounded by half a thousandth of the height."""
    parts = body_parts(somebody)
    for phase in PHASES:
        soles = stood({"foot": parts["foot"]}, feet(somebody, phase, swing))
        assert points(soles)[:, 2].min() == pytest.approx(0.0, abs=6e-4 * somebody.height_m)


def feet(somebody: Person, phase: float, swing: float) -> dict[BodyPart, F64]:
    return {k: v for k, v in walking(somebody, phase, swing).items() if k[0] == "foot"}


def test_a_foot_on_the_ground_hardly_slides_while_the_body_passes_over_it():
    """While the foot stands the ankle stays where it is on the ground, within 1 cm."""
    somebody = Person()
    stride = stride_m(somebody, 1.0)
    assert 1.3 < stride < 1.6, "a grown-up's two steps at 1.4 m/s"
    phases = np.linspace(0.0, 0.99 * np.pi, 13)
    on_ground = [
        walking(somebody, phase, 1.0)["foot", 1][0, 3] + stride * phase / (2 * np.pi)
        for phase in phases
    ]
    assert np.ptp(on_ground) < 0.01


@pytest.mark.parametrize("phase", PHASES[::4])
def test_limbs_hang_together(somebody, phase):
    """The end of each limb is where the next begins, on foot and on a bicycle."""
    for pose in (walking(somebody, phase, 1.0), riding(Cyclist(somebody), phase)):
        for (limb, following), share in LINKS.items():
            for side in SIDES:
                end = pose[limb, side] @ (0, 0, -share * somebody.height_m, 1)
                np.testing.assert_allclose(end, pose[following, side][:, 3], atol=1e-9)
        for frame in pose.values():
            np.testing.assert_allclose(frame[:3, :3] @ frame[:3, :3].T, np.eye(3), atol=1e-12)


def test_knees_bend_back_and_elbows_forward(somebody):
    for pose in (walking(somebody, phase, 1.0) for phase in PHASES):
        for side in SIDES:
            assert swung(pose["shank", side]) <= swung(pose["thigh", side])
            assert swung(pose["forearm", side]) >= swung(pose["upper arm", side])


def test_arms_swing_against_their_legs():
    pose = walking(Person(), 0.0, 1.0)
    assert swung(pose["thigh", 1]) > 0 > swung(pose["thigh", -1])
    assert swung(pose["upper arm", 1]) < 0 < swung(pose["upper arm", -1])


def swung(frame: F64) -> float:
    return math.atan2(-frame[0, 2], frame[2, 2])


def test_a_stride_repeats_itself_and_half_of_it_swaps_the_sides():
    somebody = Person()
    now, half, whole = (walking(somebody, p, 1.0) for p in (0.7, 0.7 + np.pi, 0.7 + 2 * np.pi))
    for (name, side), frame in now.items():
        np.testing.assert_allclose(whole[name, side], frame, atol=1e-9)
        np.testing.assert_allclose(half[name, -side][[0, 2]], frame[[0, 2]], atol=1e-9)


def test_wheels_touch_the_ground_and_roll_without_slipping():
    looks = Cyclist()
    rubber = placed(cyclist_parts(looks)["wheel"][0], riding(looks, 0.0)["wheel", 1])
    assert rubber.vertices[:, 2].min() == pytest.approx(0.0, abs=1e-4)
    step_m = 1e-5
    for side in SIDES:
        before, after = (riding(looks, m)["wheel", side] for m in (2.0, 2.0 + step_m))
        lowest = np.linalg.inv(before) @ (before[0, 3], 0.0, 0.0, 1.0)
        slip = ((after - before) @ lowest)[0] + step_m
        assert abs(slip) < 1e-3 * step_m, "the point on the ground stands still"


def test_feet_stay_on_the_pedals_and_legs_reach_them(somebody):
    looks = Cyclist(somebody)
    assert looks.hip_m[1] > 0.75
    for ridden_m in np.linspace(0, 5, 21):
        pose = riding(looks, ridden_m)
        for side in SIDES:
            foot, pedal = pose["foot", side], pose["pedal", side]
            sole_z = foot[2, 3] - ANKLE * somebody.height_m
            assert sole_z == pytest.approx(pedal[2, 3] + PEDAL_THICK_M / 2)
            assert foot[1, 3] == pytest.approx(pedal[1, 3])
            assert swung(pose["thigh", side]) > swung(pose["shank", side]), "knees forward"
            arm = pose["crank", 0] @ (0, 0, -side * 0.17, 1)
            np.testing.assert_allclose(arm[[0, 2]], pedal[[0, 2], 3], atol=1e-9)


def test_hands_reach_the_grips(somebody):
    looks = Cyclist(somebody)
    parts, pose = cyclist_parts(looks), riding(looks, 1.3)
    frame = points(list(parts["frame"]))
    for side in SIDES:
        hand = pose["forearm", side] @ (0, 0, -(FOREARM + 0.045) * somebody.height_m, 1)
        assert np.linalg.norm(frame - hand[:3], axis=1).min() < 0.08


def test_people_have_their_own_classes_and_keep_to_their_budget(somebody):
    looks = Cyclist(somebody)
    on_foot = stood(body_parts(somebody), walking(somebody, 0.0, 1.0))
    mounted = stood(cyclist_parts(looks), riding(looks, 0.0))
    assert {mesh.label for mesh in on_foot} == {Label.PERSON}
    assert {mesh.label for mesh in mounted} == {Label.PERSON, Label.BICYCLE}
    for meshes, materials in ((on_foot, person_materials()), (mounted, cyclist_materials())):
        assert {mesh.material for mesh in meshes} <= {material.name for material in materials}
        assert sum(len(mesh.faces) for mesh in meshes) < BUDGET


def test_chance_draws_people_that_differ_and_repeats_itself():
    def draw() -> list[Cyclist]:
        rng = np.random.default_rng(1)
        return [Cyclist.drawn(rng) for _ in range(200)]

    drawn = draw()
    assert drawn == draw()
    heights_m = np.array([looks.rider.height_m for looks in drawn])
    assert heights_m.mean() == pytest.approx(1.72, abs=3 * 0.09 / math.sqrt(200))
    assert len({looks.rider.coat for looks in drawn}) == 7
    assert len({looks.paint for looks in drawn}) == 5
