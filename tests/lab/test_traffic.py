"""Vehicles in cells: laws of the density, and traces of SUMO with everything wrong with them."""

import gzip
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lab.city.city import City, Density, VehicleKind, grid_city, read_city
from lab.city.traffic import REACH, CellMap, stated_traffic, trace_traffic
from rfcore.errors import InvalidData, InvalidInput
from rfedge.samples import sample_path
from rfedge.sizing.estimate import Demand

KIND = VehicleKind(Demand(1, 640, 360, 10.0, 34.0))
TRACE = """<?xml version="1.0" encoding="UTF-8"?>
<fcd-export xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance">
    <timestep time="0.00">
        <vehicle id="a" x="10.0" y="0.0" angle="90.0" type="car" speed="8.0" lane="e_0"/>
        <vehicle id="b" x="350.0" y="5.0" angle="90.0" type="car" speed="8.0" lane="e_0"/>
        <person id="p" x="0.0" y="0.0" speed="1.0"/>
    </timestep>
    <timestep time="0.50">
        <vehicle id="a" x="199.0" y="0.0"/>
        <vehicle id="b" x="401.0" y="5.0"/>
        <vehicle id="far" x="9000.0" y="0.0"/>
    </timestep>
    <timestep time="1.00">
        <vehicle id="a" x="390.0" y="0.0"/>
        <vehicle id="new" x="0.0" y="30.0"/>
        <vehicle id="far" x="9000.0" y="0.0"/>
    </timestep>
</fcd-export>
"""


def town() -> City:
    """Three cells 200 m apart, of which the first two are one server's."""
    return read_city(sample_path("sizing/city.toml"))


def written(folder: Path, text: str, name: str = "fcd.xml") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_a_trace_is_counted_by_cell(tmp_path):
    (block,) = trace_traffic(town(), written(tmp_path, TRACE))
    assert (block.start_s, block.step_s) == (0.0, 0.5)
    assert block.vehicles.tolist() == [[1, 0, 1], [0, 1, 1], [1, 0, 1]]
    assert block.handovers_per_s.tolist() == [[0, 0, 0], [0, 0, 0], [0, 0, 2]]
    assert block.begun_per_s.tolist() == [[0, 0, 0], [0, 0, 0], [2, 0, 0]]
    assert block.outside.tolist() == [0, 1, 1]


def test_a_packed_trace_is_the_same(tmp_path):
    packed = tmp_path / "fcd.xml.gz"
    packed.write_bytes(gzip.compress(TRACE.encode()))
    (plain,) = trace_traffic(town(), written(tmp_path, TRACE))
    (block,) = trace_traffic(town(), packed)
    assert np.array_equal(block.vehicles, plain.vehicles)


def test_nobody_is_lost_on_the_way(tmp_path):
    """A vehicle in a cell came there, began there, or was there: over every step and cell."""
    random = np.random.default_rng(3)
    points_m = random.uniform((-150, -120), (550, 120), (40, 2))
    lines = ["<fcd-export>"]
    for step in range(150):
        points_m += random.normal(0, 15, points_m.shape)
        lines.append(f'<timestep time="{step}">')
        lines += [
            f'<vehicle id="v{n}" x="{x:.2f}" y="{y:.2f}"/>'
            for n, (x, y) in enumerate(points_m)
            if (n + step) % 7
        ]
        lines.append("</timestep>")
    blocks = list(trace_traffic(town(), written(tmp_path, "\n".join([*lines, "</fcd-export>"]))))
    assert [len(block.vehicles) for block in blocks] == [60, 60, 30]
    assert [block.start_s for block in blocks] == [0.0, 60.0, 120.0]
    vehicles = np.concatenate([block.vehicles for block in blocks])
    outside = np.concatenate([block.outside for block in blocks])
    there = [sum(bool((n + step) % 7) for n in range(40)) for step in range(150)]
    assert (vehicles.sum(axis=1) + outside).tolist() == there
    came = np.concatenate([block.handovers_per_s + block.begun_per_s for block in blocks])
    assert np.all(came <= vehicles + 1e-9)
    assert came.sum() > 50


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('x="199.0"', 'x="nan"', "line 9: x of 'a' is nan, must be finite"),
        ('x="199.0"', 'x="inf"', "must be finite"),
        ('x="199.0"', 'x="east"', "'east', not a number"),
        (' x="199.0"', "", "has no x"),
        ('id="a" x="199.0"', 'x="199.0"', "a <vehicle> has no id"),
        ('id="b" x="401.0"', 'id="a" x="401.0"', "there twice at 0.5 s"),
        ('time="0.50"', 'time="-1"', "time -1 s follows 0 s"),
        ('time="0.50"', 'time="nan"', "must be finite"),
        ('time="1.00"', 'time="1.80"', "steps of 0.5 s and of 1.3 s"),
        ("fcd-export", "routes", "<routes> is no FCD output"),
        ("</fcd-export>", "", "cut off"),
        ("</timestep>", "", "cut off"),
    ],
)
def test_what_is_wrong_with_a_trace_is_said(tmp_path, old, new, said):
    assert old in TRACE
    path = written(tmp_path, TRACE.replace(old, new))
    with pytest.raises(InvalidData, match=r"fcd\.xml") as raised:
        list(trace_traffic(town(), path))
    assert said in str(raised.value)


def test_a_trace_that_ends_anywhere_is_refused(tmp_path):
    whole = TRACE.rstrip()
    for length in range(0, len(whole) - 1, 37):
        with pytest.raises(InvalidData):
            list(trace_traffic(town(), written(tmp_path, whole[:length])))


def test_a_packed_trace_that_ends_too_soon_is_refused(tmp_path):
    packed = tmp_path / "fcd.xml.gz"
    packed.write_bytes(gzip.compress(TRACE.encode())[:-20])
    with pytest.raises(InvalidData, match="cut off"):
        list(trace_traffic(town(), packed))


def test_a_trace_of_another_place_is_refused(tmp_path):
    elsewhere = re.sub(r'x="[^"]*"', 'x="700000.0"', TRACE)
    with pytest.raises(InvalidData, match="no vehicle is in any cell"):
        list(trace_traffic(town(), written(tmp_path, elsewhere)))


def test_cells_are_found_as_by_looking_at_all():
    city = grid_city(KIND, Density((0.0, 1.0), (1.0, 1.0)), 60, 4)
    random = np.random.default_rng(5)
    cells = replace(city.cells, radius_m=random.uniform(40, 140, 60))
    points_m = random.uniform(-400, 2200, (3000, 2))
    radii = np.linalg.norm(points_m[:, None] - cells.centre_m[None], axis=2) / cells.radius_m
    wanted = np.where(radii.min(axis=1) <= REACH, radii.argmin(axis=1), -1)
    assert CellMap(cells).cells_of(points_m).tolist() == wanted.tolist()
    assert (wanted >= 0).sum() > 500


def test_a_density_is_straight_between_its_hours():
    city = replace(town(), density=Density((7.0, 7.5), (0.0, 30.0), 0.0))
    blocks = list(stated_traffic(city))
    assert len(blocks) == 30
    assert blocks[15].vehicles[0].tolist() == pytest.approx([22.5, 15.0, 12.0])
    begun = sum(float(block.begun_per_s.sum()) for block in blocks)
    assert begun == pytest.approx(30 * (1.5 + 1.0 + 0.8), rel=1e-9)


def test_crossings_follow_the_fluid_flow_model():
    """2 n v / (pi R) leave a cell; a sixth of as many come from each neighbour."""
    city = grid_city(KIND, Density((0.0, 0.1), (5.0, 5.0), 10.0), 49, 4)
    block = next(stated_traffic(city))
    crossings = 5 * 2 * 10.0 / (math.pi * city.cells.radius_m[0])
    inner = 24
    assert block.handovers_per_s[0, inner] == pytest.approx(crossings)
    assert block.begun_per_s[0, inner] == pytest.approx(0.0)
    total = block.handovers_per_s[0] + block.begun_per_s[0]
    assert total == pytest.approx(np.full(49, crossings))
    assert block.begun_per_s[0, 0] > 0


def test_a_city_without_demand_needs_a_trace():
    with pytest.raises(InvalidInput, match="--fcd"):
        next(stated_traffic(replace(town(), density=None)))
    with pytest.raises(InvalidInput, match="step-s"):
        next(stated_traffic(town(), 0.0))
