"""The flow model against the product's sessions on the virtual clock, and what the command does."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lab.city.check import CheckPlan, check_plan, flow_of
from lab.city.city import Admission, City, Tile, read_city
from lab.city.flow import Costs, costs_of
from lab.city.plan import MinuteRow, plan_city
from lab.city.sessions import SampledServer, SessionFigures, run_sessions
from lab.city.traffic import stated_traffic
from lab.cli import parse
from rfcore.errors import InvalidInput
from rfedge.samples import sample_path
from rfedge.sizing.tables import shipped_tables


def town() -> tuple[City, Costs]:
    city = read_city(sample_path("sizing/city.toml"))
    return city, costs_of(city, shipped_tables())


def with_cores(city: City, station: float, harbour: float = 2.0) -> City:
    """Return the town with servers of so many cores."""
    return replace(city, servers=replace(city.servers, cores=np.array([station, harbour])))


def both(
    city: City, costs: Costs, sampled: SampledServer, warm_up_s: float = 12.0
) -> tuple[MinuteRow, SessionFigures]:
    return flow_of(city, costs, sampled), run_sessions(city, costs, sampled, warm_up_s, 10.0)


def test_sessions_of_an_idle_server_come_to_what_the_flow_says() -> None:
    city, costs = town()
    flow, sessions = both(city, costs, SampledServer(0, {0: 3, 1: 2}, {}))
    assert sessions.served == flow.served == 5
    assert sessions.pictures_per_s == pytest.approx(5 * costs.hz, rel=0.02)
    assert 1e6 * flow.uplink_mbps == pytest.approx(sessions.uplink_bps, rel=0.05)
    assert 1e6 * flow.downlink_mbps == pytest.approx(sessions.downlink_bps, rel=0.3)
    assert flow.cores == pytest.approx(sessions.cores, rel=0.02)
    p50_ms, p99_ms = (1e3 * np.quantile(sessions.ages_s, q) for q in (0.5, 0.99))
    assert flow.age_p50_ms == pytest.approx(p50_ms, rel=0.05)
    assert flow.age_p99_ms == pytest.approx(p99_ms, rel=0.25)


def test_a_rig_of_four_cameras_is_sampled_too() -> None:
    city, _ = town()
    kind = replace(city.vehicle, demand=replace(city.vehicle.demand, cameras=4))
    city = replace(city, vehicle=kind)
    flow, sessions = both(city, costs_of(city, shipped_tables()), SampledServer(0, {0: 3}, {}))
    assert sessions.served == flow.served == 3
    assert sessions.pictures_per_s == pytest.approx(12 * flow.rate_hz, rel=0.03)
    assert flow.cores == pytest.approx(sessions.cores, rel=0.03)
    p50_ms, p99_ms = (1e3 * np.quantile(sessions.ages_s, q) for q in (0.5, 0.99))
    assert flow.age_p50_ms == pytest.approx(p50_ms, rel=0.1)
    assert flow.age_p99_ms == pytest.approx(p99_ms, rel=0.25)


def test_every_byte_that_was_sent_came_or_is_under_way() -> None:
    city, costs = town()
    sampled = SampledServer(1, {2: 6}, {2: 0.5})
    figures = run_sessions(city, costs, sampled, 5.0, 5.0)
    assert figures.sent_bytes == figures.delivered_bytes + figures.held_bytes
    assert figures == run_sessions(city, costs, sampled, 5.0, 5.0), "the same seed"
    other = run_sessions(replace(city, seed=2), costs, sampled, 5.0, 5.0)
    assert other.ages_s != figures.ages_s


def test_a_pressed_server_lets_in_as_many_as_the_flow_says() -> None:
    city, costs = town()
    crowd = SampledServer(0, {0: 15, 1: 10}, {})
    unpressed = flow_of(with_cores(city, 64.0), costs, crowd)
    assert unpressed.refused == 0
    pressed = with_cores(city, math.ceil(0.6 * unpressed.cores / city.admission.limits.load))
    flow, sessions = both(pressed, costs, crowd, 20.0)
    assert flow.refused > 5
    assert sessions.served == pytest.approx(flow.served, abs=1.5)
    assert sessions.cores == pytest.approx(flow.cores, rel=0.08)


def test_a_saturated_uplink_is_shared_by_credits() -> None:
    city, costs = town()
    city = with_cores(city, 6.0, 64.0)
    flow, sessions = both(city, costs, SampledServer(1, {2: 20}, {}))
    assert flow.served == sessions.served == 20
    assert 1e6 * flow.uplink_mbps == pytest.approx(sessions.uplink_bps, rel=0.05)
    assert flow.rate_hz * flow.served == pytest.approx(sessions.pictures_per_s, rel=0.07)
    p50_ms = 1e3 * np.quantile(sessions.ages_s, 0.5)
    assert flow.age_p50_ms == pytest.approx(p50_ms, rel=0.2)


def test_who_comes_without_the_field_fetches_it() -> None:
    city, costs = town()
    city = replace(city, tile=Tile(2e6, 0.0))
    flow, sessions = both(city, costs, SampledServer(0, {0: 4}, {0: 0.4}))
    assert sessions.downlink_bps > 8 * 2e6 * 0.3
    assert 1e6 * flow.downlink_mbps == pytest.approx(sessions.downlink_bps, rel=0.25)


def test_samples_are_of_all_strata_and_the_same_again() -> None:
    city, costs = town()
    plan = plan_city(city, costs, stated_traffic(city, 10.0))
    check = CheckPlan(samples=2, warm_up_s=4.0, counted_s=2.0)
    rows = check_plan(plan, check)
    assert rows == check_plan(plan, check)
    assert len(rows) == 2 * 8
    assert len({(row.server, row.at_s) for row in rows}) == 2
    with pytest.raises(InvalidInput, match="samples: -1"):
        CheckPlan(samples=-1)


def test_too_many_streams_are_refused_by_the_ledger() -> None:
    city, costs = town()
    city = replace(city, admission=Admission(city.admission.limits, 3))
    flow, sessions = both(city, costs, SampledServer(0, {0: 5}, {}), 6.0)
    assert flow.served == sessions.served == 3


# --- the command


def test_a_city_is_planned_into_a_report(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pressed = tmp_path / "city.toml"
    pressed.write_text(
        sample_path("sizing/city.toml").read_text().replace("cores = 6", "cores = 1")
    )
    asked = ["city", str(pressed), "--out", str(tmp_path)]
    parse([*asked, "--step-s", "5", "--samples", "1", "--sample-s", "2"]).run()
    said = capsys.readouterr().out
    assert "First broken: cores that a server may promise" in said.replace("\n", " ")
    result = json.loads((tmp_path / "city.json").read_text())
    assert result["kind"] == "city"
    assert len(result["minutes"]) == 30
    assert [row["name"] for row in result["servers"]] == ["station", "harbour"]
    assert {row["figure"] for row in result["checks"]} >= {"cores", "age p99, ms"}
    page = (tmp_path / "report.html").read_text()
    assert page.count("<svg") == 6
    assert "harbour" in page


def test_a_trace_takes_the_place_of_the_demand(tmp_path: Path) -> None:
    steps = "".join(
        f'<timestep time="{step}"><vehicle id="a" x="{3 * step}" y="0"/></timestep>\n'
        for step in range(120)
    )
    trace = tmp_path / "fcd.xml"
    trace.write_text(f"<fcd-export>{steps}</fcd-export>")
    city = ["city", str(sample_path("sizing/city.toml")), "--samples", "0"]
    out = ["--out", str(tmp_path / "out"), "--json", str(tmp_path / "city.json")]
    parse([*city, "--fcd", str(trace), *out]).run()
    result = json.loads((tmp_path / "city.json").read_text())
    assert [row["vehicles"] for row in result["minutes"]] == [1.0, 1.0]
    assert sum(60 * row["handovers_per_s"] for row in result["minutes"]) == pytest.approx(1)
    assert str(trace) in result["inputs"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--samples", "-1"], "samples"),
        (["--sample-s", "0"], "sample-s"),
        (["--step-s", "0", "--samples", "0"], "step-s"),
    ],
)
def test_what_cannot_be_planned_is_said(tmp_path: Path, arguments: list[str], said: str) -> None:
    city = str(sample_path("sizing/city.toml"))
    with pytest.raises(InvalidInput, match=said):
        parse(["city", city, *arguments, "--out", str(tmp_path)]).run()
