"""Streets differ by what their geometry says, and by nothing else."""

import hashlib

import numpy as np
import pytest

from rfcore.errors import InvalidInput
from streetgen.classes import Label
from streetgen.geometry.furniture import lamps, railings, signs, wires
from streetgen.geometry.layout import Course, Geometry, Layout
from streetgen.geometry.road import road

WIDER_M = 2.4
NARROW, WIDE = Layout(Geometry()), Layout(Geometry(wider_m=WIDER_M))


def test_the_plan_of_the_first_street_stays_what_it_was():
    """Golden: fields and recordings of it exist. Micrometres, without any trigonometry."""
    layout = Layout(Geometry())
    places = [*layout.lamps, *layout.trees, *layout.signposts, *layout.bays]
    plan: list[tuple[float, ...]] = [(round(p.x_m, 6), round(p.y_m, 6), p.side) for p in places]
    for p in layout.plots:
        metres = (round(value, 6) for value in (p.start_m, p.end_m, p.y_m))
        plan.append((*metres, p.floors, round(p.floor_m, 6), p.style))
    assert hashlib.sha256(repr(plan).encode()).hexdigest()[:16] == "24dff91fb9ae8853"


@pytest.mark.parametrize("what", ["lamps", "trees", "signposts", "bays", "plots"])
def test_a_wider_street_has_everything_as_much_farther_out(what):
    pairs = list(zip(getattr(NARROW, what), getattr(WIDE, what), strict=True))
    assert pairs
    for narrow, wide in pairs:
        assert wide.y_m == pytest.approx(narrow.y_m + narrow.side * WIDER_M)
        for along in {"x_m", "start_m"} & set(vars(narrow)):
            assert getattr(wide, along) == getattr(narrow, along)


def test_kerbs_and_bay_lines_follow_and_the_pavement_reaches_the_facades():
    meshes = road(WIDE, np.random.default_rng(1)).meshes
    found = {
        label: np.concatenate([m.vertices for m in meshes if m.label == label])
        for label in (Label.ROAD, Label.MARKING, Label.PAVEMENT)
    }
    assert np.abs(found[Label.ROAD][:, 1]).max() == pytest.approx(6.6 + WIDER_M)
    assert np.abs(found[Label.PAVEMENT][:, 1]).min() == pytest.approx(6.6 + WIDER_M)
    assert np.abs(found[Label.PAVEMENT][:, 1]).max() > WIDE.facade_m
    line = np.abs(found[Label.MARKING][:, 1])
    assert ((line > 4.1 + WIDER_M) & (line < 4.3 + WIDER_M)).any()
    assert line.max() <= 6.6 + WIDER_M + 1e-5


@pytest.mark.parametrize("part", [lamps, railings, signs])
def test_furniture_keeps_off_a_wider_road(part):
    """Below 4 m; arms of lamps and lights reach over it."""
    made = part(WIDE, np.random.default_rng(1))
    points = np.concatenate([mesh.vertices for mesh in made.meshes])
    standing = points[(points[:, 2] > 0.2) & (points[:, 2] < 1.2)]
    assert np.abs(standing[:, 1]).min() > WIDE.road_half_m
    assert np.abs(standing[:, 1]).max() < WIDE.facade_m


def test_spans_hang_from_facade_to_facade():
    points = np.concatenate([m.vertices for m in wires(WIDE, np.random.default_rng(1)).meshes])
    assert np.abs(points[:, 1]).max() == pytest.approx(WIDE.facade_m, abs=0.05)


@pytest.mark.parametrize("spacing_m", [9.0, 30.0])
def test_lamps_stand_as_far_apart_as_declared(spacing_m):
    layout = Layout(Geometry(lamp_spacing_m=spacing_m))
    for side in (1, -1):
        row = [lamp.x_m for lamp in layout.lamps if lamp.side == side]
        np.testing.assert_allclose(np.diff(row), spacing_m)


def test_houses_have_as_many_floors_as_declared():
    layout = Layout(Geometry(length_m=400.0, floors=(4, 7)))
    assert {plot.floors for plot in layout.plots} == {4, 5, 6, 7}
    assert {plot.floors for plot in Layout(Geometry(floors=(3, 3))).plots} == {3}
    with pytest.raises(InvalidInput, match=r"floors: \[5, 2\] are not the fewest and the most"):
        Geometry(floors=(5, 2))


def test_what_leaves_the_street_begins_again_at_its_other_end():
    course = Course(start_m=90.0, direction=1, speed_mps=10.0, reach_m=100.0)
    assert course.x_m(0.5) == pytest.approx(95.0)
    assert course.x_m(1.5) == pytest.approx(-95.0)
    assert Course(-90.0, -1, 10.0, 100.0).x_m(1.5) == pytest.approx(95.0)
