"""A plan says what runs, why, and each effect's share of a frame as it was measured."""

import json

import numpy as np
import pytest

from streetgen.effects import EFFECTS
from streetgen.effects.haze import Haze
from streetgen.effects.noise import SensorNoise
from streetgen.effects.overcast import Overcast
from streetgen.effects.wet_road import WetRoad
from streetgen.geometry.layout import Geometry, Layout
from streetgen.geometry.road import road
from streetgen.geometry.world import Sky, World
from streetgen.plan import EffectCost, Planner, ScenePlan, write_rows
from streetgen.scene_file import Scene

SMALL = Geometry(length_m=20.0)
WET = Scene(
    "wet",
    "x",
    SMALL,
    effects={"overcast": Overcast(), "wet_road": WetRoad(), "noise": SensorNoise()},
)


@pytest.fixture(autouse=True)
def bare_road(monkeypatch: pytest.MonkeyPatch) -> None:
    """A street that is made at once."""
    layout = Layout(SMALL)
    sky = Sky(np.full((16, 32, 3), 0.5, np.float32))
    world = World(layout, sky).plus(road(layout, np.random.default_rng(1)))
    monkeypatch.setattr("streetgen.plan.plain_world", lambda _scene: world)


class Clock:
    """Processor time that goes on by a quarter of a second at each look."""

    def __init__(self) -> None:
        self._now_s = 0.0

    def __call__(self) -> float:
        self._now_s += 0.25
        return self._now_s


@pytest.fixture
def plan() -> ScenePlan:
    """A wet street seen by a noisy sensor: of 100 ms a frame the plain street takes 60."""
    wet, noise = (next(e for e in EFFECTS if e.name == name) for name in ("wet_road", "noise"))
    costs = EffectCost(wet, 300.0, 20.0), EffectCost(noise, 0.0, 20.0)
    return ScenePlan(Scene("street-x", "street-y"), costs, 60.0)


def test_an_effect_on_the_street_costs_what_the_next_render_takes_more():
    seen: list[World] = []

    def frame_ms(world: World) -> float:
        seen.append(world)
        return (100.0, 90.0, 130.0)[len(seen) - 1]

    planned = Planner(Clock(), lambda _scene: frame_ms).plan(WET)
    assert planned.plain_ms == 100.0
    costs = [(cost.effect.name, cost.once_ms, cost.frame_ms) for cost in planned.effects]
    assert costs == [("overcast", 250, -10.0), ("wet_road", 250, 40.0), ("noise", 0.0, 250)]
    assert seen[1].sky is not seen[0].sky
    assert seen[1].materials is seen[0].materials
    assert seen[2].materials["asphalt"] is not seen[0].materials["asphalt"]


def test_scenes_of_the_same_street_share_its_plain_render():
    calls: list[World] = []
    planner = Planner(Clock(), lambda _scene: lambda world: calls.append(world) or 7.0)
    for name in ("x", "y"):
        planned = planner.plan(Scene(name, "x", SMALL))
        assert (planned.effects, planned.plain_ms) == ((), 7.0)
    assert len(calls) == 1


def test_without_a_renderer_only_the_effects_are_run():
    scene = Scene("x", "x", SMALL, effects={"haze": Haze(), "noise": SensorNoise()})
    planned = Planner(Clock()).plan(scene)
    assert [(c.effect.name, c.frame_ms) for c in planned.effects] == [("haze", 250), ("noise", 250)]
    assert planned.lines()[-1].endswith("250.0 ms a frame, 50 % of all effects on frames")
    assert Planner(Clock()).plan(WET).effects[0].frame_ms is None


def test_shares_are_of_the_whole_frame(plan):
    plain, wet, noise = plan.lines()[-3:]
    assert "60 ms a frame without effects, 60 % of it" in plain
    assert wet.endswith("300 ms once, before the first frame; +20 ms a frame, 20.0 % of it")
    assert noise.endswith("20.0 ms a frame, 20.0 % of it")
    rows = plan.rows()
    assert [row["effect"] for row in rows] == ["", "wet_road", "noise"]
    assert [row["once_ms"] for row in rows] == [0.0, 300.0, 0.0]
    assert sum(row["share_percent"] for row in rows) == pytest.approx(100.0)


def test_a_result_says_where_it_came_from(plan, tmp_path):
    write_rows(tmp_path / "new" / "plan.json", plan.rows())
    result = json.loads((tmp_path / "new" / "plan.json").read_text())
    assert result["rows"] == plan.rows()
    assert {"command", "revision", "host"} <= result.keys()
