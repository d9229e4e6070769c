"""A city's file, and laws of the flow model: conservation, one cell alone, more demand."""

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from lab.city.city import (
    TABLES_MOVING_PERCENT,
    Admission,
    Cells,
    City,
    Density,
    Servers,
    VehicleKind,
    grid_city,
    read_city,
)
from lab.city.flow import (
    AGE_SAMPLES,
    Costs,
    SharedLoad,
    age_samples_s,
    city_flow,
    costs_of,
    queue_wait,
)
from lab.city.plan import plan_city
from lab.city.traffic import TrafficBlock
from lab.cli import parse
from lab.robust.run import kbit_between
from mec_server.config import AdmissionLimits
from rfcore.errors import InvalidData, InvalidInput
from rfedge.results import read_result
from rfedge.samples import sample_path
from rfedge.sizing.estimate import Assumptions, Demand, estimate
from rfedge.sizing.tables import shipped_tables

SAMPLE = sample_path("sizing/city.toml")
RESULTS = Path(__file__).parents[2] / "lab/results"
DEMAND = Demand(1, 640, 360, 10.0, 34.0)
COSTS = Costs(1, 10.0, 3000.0, (0.8, 1.0, 1.2), 0.04, 0.03, 0.02, 100.0)


def city(
    cells: int = 1,
    servers: int = 1,
    cores: float = 4.0,
    uplink_mbps: float = 80.0,
    streams: int = 256,
    demand: Demand = DEMAND,
) -> City:
    """Return cells in a row, one server after the other behind them."""
    centre_m = np.stack([200.0 * np.arange(cells), np.zeros(cells)], axis=1)
    return City(
        vehicle=VehicleKind(demand),
        cells=Cells(
            tuple(f"c{n}" for n in range(cells)),
            centre_m,
            np.full(cells, 105.0),
            np.full(cells, 1e6 * uplink_mbps),
            np.full(cells, 4e8),
            np.arange(cells) * servers // cells,
            np.ones(cells),
        ),
        servers=Servers(tuple(f"s{n}" for n in range(servers)), np.full(servers, cores)),
        admission=Admission(AdmissionLimits(), streams),
    )


def block(vehicles: Any, entries_per_s: float = 0.0) -> TrafficBlock:
    there = np.atleast_2d(np.asarray(vehicles, dtype=np.float64))
    nobody = np.zeros_like(there)
    return TrafficBlock(0.0, 1.0, there, nobody + entries_per_s, nobody, np.zeros(len(there)))


# --- the file


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('server = "harbour"', 'server = "airport"', "'airport', none of station, harbour"),
        ('name = "market street"', 'name = "station square"', "2 times"),
        ("radius_m = 115.0", "radius_m = nan", "radius_m: is nan"),
        ("radius_m = 115.0", "radius_m = -1.0", "radius_m: is -1.0"),
        ("uplink_mbps = 2.5", 'uplink_mbps = "2.5"', "not a number"),
        ("cores = 2", "cores = 2.5", "not a whole number"),
        ("known_percent = 90.0", "known_percent = 101.0", "outside 0..100"),
        ("hours = [7.0, 7.25, 7.5]", "hours = [7.0, 7.0, 7.5]", "must ascend"),
        ("hours = [7.0, 7.25, 7.5]", "hours = [7.0, 7.5]", "2 hours and 3 vehicles_per_cell"),
        ("speed_mps = 8.0", "sped_mps = 8.0", "sped_mps: is none of"),
        ("weight = 0.8", "weight = -0.8", "weight"),
        ('size = "640x360"', 'size = "640"', "size"),
        ("[demand]", "[grid]\ncells = 3\n[demand]", "either"),
        ("cameras = 1", "cameras = 33", "outside 1..32"),
    ],
)
def test_a_wrong_value_is_named_with_its_file(tmp_path, old, new, said):
    text = SAMPLE.read_text()
    assert old in text
    path = tmp_path / "wrong.toml"
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InvalidInput, match=r"wrong\.toml") as raised:
        read_city(path)
    assert said in str(raised.value)


def test_no_toml_is_no_city(tmp_path):
    (tmp_path / "x.toml").write_text("cell = [")
    with pytest.raises(InvalidData, match="not a city"):
        read_city(tmp_path / "x.toml")


def test_a_grid_has_hexagons_of_mean_weight_one():
    town = grid_city(VehicleKind(DEMAND), Density((0.0, 1.0), (1.0, 1.0)), 100, 4, 3.0)
    assert len(town.cells) == len(town.servers) == 100
    assert town.cells.weight.mean() == pytest.approx(1)
    assert town.cells.weight.max() == pytest.approx(3.0, rel=1e-3)
    away_m = np.linalg.norm(town.cells.centre_m[None] - town.cells.centre_m[:, None], axis=2)
    away_m[np.diag_indices(100)] = np.inf
    assert away_m.min() == pytest.approx(Assumptions().inter_site_m)
    assert (away_m < 1.01 * away_m.min()).sum(axis=1).max() == 6


def test_what_the_field_has_never_seen_costs_what_the_recorded_comparison_says():
    recorded = read_result(RESULTS / "compare.json")
    empty, vehicles = (
        kbit_between(zip(curve["psnr_db"], curve["bytes_per_frame"], strict=True), 34.0, scene)
        for scene in ("sample-empty", "sample-vehicles")
        for curve in recorded["curves"]
        if curve["scene"] == scene and curve["setting"].startswith("rfedge-default")
    )
    assert VehicleKind(DEMAND, 0.0).bytes_factor == pytest.approx(empty / vehicles, abs=1e-3)
    (moving,) = (
        row["area_percent"]
        for row in recorded["bits"]
        if (row["scene"], row["shows"]) == ("sample-vehicles", "moving")
    )
    assert pytest.approx(moving, abs=0.05) == TABLES_MOVING_PERCENT


# --- the flow


def test_one_cell_is_what_rfedge_size_says():
    told = estimate(DEMAND, shipped_tables()).estimates[0]
    town = city(uplink_mbps=Assumptions().planned_cell_mbps, cores=1000.0, streams=1000)
    costs = costs_of(town, shipped_tables())
    one = city_flow(town, costs, block([1.0]))
    assert one.uplink_bps[0, 0] == pytest.approx(1e6 * told.mbps)
    assert one.cores[0, 0] == pytest.approx(told.server_cores)
    assert costs.sender_s * DEMAND.hz == pytest.approx(told.vehicle_cores)
    full = city_flow(town, costs, block([float(told.vehicles_per_cell)]))
    over = city_flow(town, costs, block([float(told.vehicles_per_cell + 1)]))
    assert full.uplink_share[0, 0] <= 1 < over.uplink_share[0, 0]
    assert full.rate_hz[0, 0] == pytest.approx(10.0)
    assert over.rate_hz[0, 0] < 10.0


def test_a_server_lets_in_whom_its_cores_permit():
    """0.8 of 4 cores: 3.2, of which a vehicle at 10 Hz takes 0.3; 0.2 left are above 2 Hz."""
    flow = city_flow(city(uplink_mbps=1e4), COSTS, block([[10.0], [11.0], [15.0]]))
    assert flow.served[:, 0].tolist() == pytest.approx([10.0, 11.0, 11.0])
    assert flow.cores[:, 0].tolist() == pytest.approx([3.0, 3.2, 3.2])
    assert flow.load_share[:, 0].tolist() == pytest.approx([3.0 / 3.2, 3.3 / 3.2, 4.5 / 3.2])


def test_what_is_left_below_the_lowest_rate_is_nobodys():
    town = replace(city(uplink_mbps=1e4), admission=Admission(AdmissionLimits(lowest_hz=7.0)))
    assert city_flow(town, COSTS, block([15.0])).served[0, 0] == pytest.approx(10.0)


def test_one_vehicle_is_let_in_by_the_smallest_server():
    flow = city_flow(city(cores=0.01, uplink_mbps=1e4), COSTS, block([3.0]))
    assert flow.served[0, 0] == pytest.approx(1.0)
    assert flow.rate_hz[0, 0] == pytest.approx(2.0)


def test_streams_are_a_limit_of_their_own():
    flow = city_flow(city(cores=100.0, uplink_mbps=1e4, streams=7), COSTS, block([9.0]))
    assert flow.served[0, 0] == pytest.approx(7.0)
    assert flow.stream_share[0, 0] == pytest.approx(9 / 7)


def test_a_slow_uplink_leaves_room_at_the_server():
    """At 2 of 10 Hz a vehicle is taken to need 2.5: four times as many are let in."""
    narrow = city(uplink_mbps=80 * 2 * 8 * 3000 / 1e6)
    flow = city_flow(narrow, COSTS, block([80.0]))
    assert flow.served[0, 0] == pytest.approx(42.0)
    assert flow.cores[0, 0] == pytest.approx(3.2)


def test_a_full_uplink_is_shared():
    narrow = city(uplink_mbps=20 * 8 * 8 * 3000 / 1e6, cores=100.0)
    flow = city_flow(narrow, COSTS, block([20.0]))
    assert flow.served[0, 0] == pytest.approx(20.0)
    assert flow.uplink_bps[0, 0] == pytest.approx(narrow.cells.uplink_bps[0])
    assert flow.rate_hz[0, 0] == pytest.approx(8.0)


def test_coder_and_credits_limit_a_vehicle_on_its_own():
    slow = replace(COSTS, sender_s=0.2)
    flow = city_flow(city(uplink_mbps=1e4), slow, block([1.0]))
    assert flow.rate_hz[0, 0] == pytest.approx(5.0)
    far = replace(COSTS, propagation_s=0.5)
    assert far.own_hz == pytest.approx(2 / (0.04 + 0.03 + 1.0))


demands = st.lists(st.floats(0, 400), min_size=4, max_size=4)


@settings(max_examples=150, deadline=None)
@given(demands, st.floats(0, 2), st.sampled_from((0.5, 4.0, 64.0)), st.floats(1, 200))
def test_nothing_comes_from_nowhere(vehicles, entries, cores, uplink_mbps):
    town = city(4, 2, cores, uplink_mbps)
    flow = city_flow(town, COSTS, block(vehicles, entries))
    there = np.array(vehicles)
    assert np.all(flow.served[0] >= 0)
    assert np.all(flow.served[0] <= there + 1e-9)
    assert np.all(flow.uplink_bps[0] <= town.cells.uplink_bps * (1 + 1e-9))
    received = town.at_server(flow.uplink_bps)[0]
    assert received.sum() == pytest.approx(flow.uplink_bps.sum())
    lowest = 2.0 * COSTS.cores_per_hz
    assert np.all(flow.cores[0] <= np.maximum(0.8 * cores, lowest) + 1e-9)
    plan = plan_city(town, COSTS, [block(vehicles, entries)]).rows[0]
    assert plan.vehicles == pytest.approx(plan.served + plan.refused)


@settings(max_examples=150, deadline=None)
@given(demands, st.floats(1, 5), st.sampled_from((0.5, 4.0, 64.0)), st.floats(1, 200))
def test_more_demand_asks_for_more_and_serves_no_fewer(vehicles, factor, cores, uplink_mbps):
    town = city(4, 2, cores, uplink_mbps)
    less = city_flow(town, COSTS, block(vehicles))
    more = city_flow(town, COSTS, block(factor * np.array(vehicles)))
    for name in ("uplink_share", "load_share", "stream_share"):
        assert np.all(getattr(more, name) >= getattr(less, name) * (1 - 1e-9))
    served = [town.at_server(flow.served) for flow in (less, more)]
    assert np.all(served[1] >= served[0] - 1e-6)


# --- ages


def lindley_waits(others: int, load: float, rounds: int) -> NDArray[np.float64]:
    """Waits of one periodic source among others, by Lindley's recursion, in services."""
    random = np.random.default_rng(1)
    period = others / load
    waits = []
    for _ in range(rounds):
        starts = np.sort(np.append(random.uniform(0, period, others), 0.0))
        gaps = np.diff(np.append(starts, period))
        wait, seen = 0.0, []
        for _ in range(2):
            seen = []
            for gap in gaps:
                seen.append(wait)
                wait = max(0.0, wait + 1 - gap)
        waits.append(seen[0])
    return np.array(waits)


@pytest.mark.parametrize(("others", "load"), [(10, 0.5), (30, 0.8), (60, 0.9)])
def test_waits_are_those_of_periodic_sources(others, load):
    waits = lindley_waits(others, load, 1500)
    for chance in (0.9, 0.99):
        told = queue_wait(np.array([chance]), np.array([others * 1.0]), np.array([load]), 0.0)[0]
        assert told == pytest.approx(np.quantile(waits, chance), rel=0.3, abs=0.7)


def shared(vehicles: float, **changes: float) -> SharedLoad:
    rate_hz = changes.get("rate_hz", 10.0)
    values = {
        "vehicles": vehicles, "rate_hz": rate_hz, "uplink_bps": 80e6, "link_limited": 0.0,
        "held": 0.0, "server_vehicles": vehicles, "server_busy": vehicles * rate_hz * 0.03,
        "server_cores": 100.0,
    }  # fmt: skip
    return SharedLoad(**{name: np.array([value]) for name, value in (values | changes).items()})


def test_the_age_of_a_lone_picture_is_a_sum():
    even = replace(COSTS, frame_ratios=(1.0,))
    ages_s = age_samples_s(even, shared(1.0), 1)
    assert ages_s.shape == (1, AGE_SAMPLES)
    assert ages_s == pytest.approx(0.04 + 8 * 3000 / 80e6 + 0.02 + 0.03)


def test_ages_grow_with_company():
    ages_s = [age_samples_s(COSTS, shared(n), 1) for n in (1.0, 50.0, 150.0, 300.0)]
    for fewer, more in pairwise(ages_s):
        assert np.all(more >= fewer)


def test_a_saturated_cell_holds_what_credits_allow():
    """600 vehicles of 0.3 ms a frame: two rounds take 360 ms, coding and the way 110 of them."""
    even = replace(COSTS, frame_ratios=(1.0,))
    rate_hz = 80e6 / (600 * 24000)
    full = shared(600.0, link_limited=1.0, held=1.0, rate_hz=rate_hz, server_cores=1000.0)
    ages_s = age_samples_s(even, full, 1)
    round_s = 2 * 600 * 24000 / 80e6
    wait_s = round_s - even.path_s - 24000 / 80e6
    least_s = 0.04 + 0.02 + 0.03 + 24000 / 80e6 + wait_s
    assert ages_s.min() >= least_s - 1e-9
    assert ages_s.max() <= least_s + 0.1
    assert math.isclose(even.path_s, 0.11)


# --- the command


def test_a_city_is_planned_into_a_result(tmp_path, capsys):
    pressed = tmp_path / "city.toml"
    pressed.write_text(SAMPLE.read_text().replace("cores = 6", "cores = 1"))
    out = tmp_path / "city.json"
    parse(["city", str(pressed), "--out", str(out), "--step-s", "5"]).run()
    assert "First broken: cores that a server may promise" in capsys.readouterr().out
    result = read_result(out, "city")
    assert len(result["minutes"]) == 30
    assert [row["name"] for row in result["servers"]] == ["station", "harbour"]
    with pytest.raises(InvalidInput, match="step-s"):
        parse(["city", str(pressed), "--out", str(out), "--step-s", "0"]).run()


def test_a_trace_takes_the_place_of_the_demand(tmp_path):
    steps = "".join(
        f'<timestep time="{step}"><vehicle id="a" x="{3 * step}" y="0"/></timestep>\n'
        for step in range(120)
    )
    trace = tmp_path / "fcd.xml"
    trace.write_text(f"<fcd-export>{steps}</fcd-export>")
    out = tmp_path / "city.json"
    parse(["city", str(SAMPLE), "--fcd", str(trace), "--out", str(out)]).run()
    result = read_result(out, "city")
    assert [row["vehicles"] for row in result["minutes"]] == [1.0, 1.0]
    assert sum(60 * row["handovers_per_s"] for row in result["minutes"]) == pytest.approx(1)
    assert str(trace) in result["inputs"]
