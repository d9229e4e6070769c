"""A plan says what runs, why, and each effect's share of a frame as it was measured."""

import json
from pathlib import Path

import numpy as np
import pytest

from rfcore.errors import InvalidInput
from streetgen.effects.noise import SensorNoise
from streetgen.effects.overcast import Overcast
from streetgen.effects.wet_road import WetRoad
from streetgen.geometry.layout import Geometry, Layout
from streetgen.geometry.road import road
from streetgen.geometry.world import Sky, World
from streetgen.plan import EffectKind, PlainStreets, PlannedEffect, RenderCost, measured_render
from streetgen.plan_table import (
    MeasuredPlan,
    effect_lines,
    plan_table,
    scene_lines,
    write_page,
    write_rows,
)
from streetgen.scene_file import Scene

ROOT = Path(__file__).parents[2]
SMALL = Geometry(length_m=20.0)


@pytest.fixture(autouse=True)
def bare_road(monkeypatch: pytest.MonkeyPatch) -> None:
    """A street that is made at once."""
    layout = Layout(SMALL)
    sky = Sky(np.full((16, 32, 3), 0.5, np.float32))
    world = World(layout, sky).plus(road(layout, np.random.default_rng(1)))
    monkeypatch.setattr("streetgen.plan.plain_world", lambda _scene: world)


def test_an_effect_costs_what_the_next_render_takes_more() -> None:
    seen: list[World] = []

    def frame_ms(world: World) -> float:
        seen.append(world)
        return (100.0, 90.0, 130.0)[len(seen) - 1]

    effects = {"overcast": Overcast(), "wet_road": WetRoad(), "noise": SensorNoise()}
    cost = measured_render(
        Scene("x", "x", geometry=SMALL, effects=effects), frame_ms, PlainStreets()
    )
    assert cost == RenderCost(100.0, {"overcast": -10.0, "wet_road": 40.0})
    assert seen[1].sky is not seen[0].sky
    assert seen[1].materials is seen[0].materials
    assert seen[2].materials["asphalt"] is not seen[0].materials["asphalt"]


def test_without_effects_the_street_is_rendered_once() -> None:
    calls = []
    streets = PlainStreets()
    for name in ("x", "y"):
        scene = Scene(name, "x", geometry=SMALL)
        cost = measured_render(scene, lambda w: calls.append(w) or 7.0, streets)
        assert cost == RenderCost(7.0, {})
    assert len(calls) == 1, "scenes of the same street share it"


def test_shares_are_of_the_whole_frame() -> None:
    cost = RenderCost(60.0, {"wet_road": 20.0})
    shares = [cost.share_percent(part, 20.0) for part in (60.0, 20.0, 20.0)]
    assert sum(shares) == pytest.approx(100.0)
    planned = (
        PlannedEffect("wet_road", EffectKind.SURFACE, "it is wet", None, 300.0, each_frame=False),
        PlannedEffect("noise", EffectKind.SENSOR, "it is dark", None, 20.0),
    )
    plain, wet, noise = effect_lines(planned, cost)
    assert "60 ms a frame without effects, 60 % of it" in plain
    assert "wet_road: it is wet; 300 ms once, before the first frame; +20 ms a frame, 20.0" in wet
    assert "noise: it is dark; 20.0 ms a frame, 20.0 % of it" in noise
    assert "100 % of all effects on frames" in effect_lines(planned, None)[1]


def test_a_scene_without_effects_says_so() -> None:
    scene = Scene("street-x", "street-y")
    assert scene_lines(scene)[0] == "street-x: field of street-y"
    assert "144 views of 640x360 px (18 cameras, 8 stations)" in scene_lines(scene)[2]
    assert effect_lines((), None) == ["  effects     none: pictures are as rendered"]


@pytest.fixture
def plan() -> MeasuredPlan:
    """A wet street, seen by a noisy sensor."""
    planned = (
        PlannedEffect("wet_road", EffectKind.SURFACE, "it is wet", None, 300.0, each_frame=False),
        PlannedEffect("noise", EffectKind.SENSOR, "it is dark", None, 20.0),
    )
    return MeasuredPlan(Scene("wet", "x"), planned, RenderCost(60.0, {"wet_road": 20.0}))


def test_rows_of_a_plan_share_a_frame(plan: MeasuredPlan) -> None:
    rows = plan.rows()
    assert [row["effect"] for row in rows] == ["", "wet_road", "noise"]
    assert sum(row["share_percent"] for row in rows) == pytest.approx(100.0)
    assert rows[1]["once_ms"] == 300.0
    assert "| `wet` | wet_road | 300 | 20 | 20.0 % |" in plan_table(rows)


def test_a_table_replaces_the_one_before_in_its_page(plan: MeasuredPlan, tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "above\n<!-- scene plan: generated -->\nold\n<!-- end of scene plan -->\nbelow\n"
    )
    for _ in range(2):
        write_page(page, plan.rows())
    text = page.read_text()
    assert text.startswith("above\n")
    assert text.endswith("below\n")
    assert "old" not in text
    assert text.count("| `wet` |") == 3
    page.write_text("no marks")
    with pytest.raises(InvalidInput, match=r"page\.md has no '<!-- scene plan"):
        write_page(page, plan.rows())


def test_the_committed_page_shows_the_committed_plans() -> None:
    rows = json.loads((ROOT / "results" / "scenes" / "plan.json").read_text())["rows"]
    assert plan_table(rows) in (ROOT / "docs" / "how-to" / "streets.md").read_text()
    ready_made = {path.stem for path in (ROOT / "samples" / "scenes").glob("*.toml")}
    assert {row["scene"] for row in rows} <= ready_made, "a scene that is gone has no row"


def test_a_result_says_where_it_came_from(plan: MeasuredPlan, tmp_path: Path) -> None:
    write_rows(tmp_path / "new" / "plan.json", plan.rows())
    result = json.loads((tmp_path / "new" / "plan.json").read_text())
    assert result["rows"] == plan.rows()
    assert {"command", "revision", "host"} <= result.keys()
