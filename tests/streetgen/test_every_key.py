"""Every key that a scene file accepts changes something; one that does not should not be there."""

import hashlib
import pickle
from dataclasses import fields, replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest

from streetgen.assembly import plain_world
from streetgen.classes import Label
from streetgen.effects import EFFECTS, load_effect, rng_of
from streetgen.frame import LinearFrame
from streetgen.geometry.layout import Geometry, Layout
from streetgen.geometry.mesh import Material
from streetgen.geometry.sky import Daylight, overcast_sky, sunny_sky
from streetgen.geometry.solids import Surface, boxes
from streetgen.geometry.world import Sky, StreetPart, World
from streetgen.plan import plain_frame
from streetgen.scene_file import (
    DriveSettings,
    EvaluationSettings,
    LocalisationNoise,
    RigSettings,
    Scene,
    TrainingSettings,
)
from streetgen.shots import Split, shots_of, thinned_indices
from streetgen.trajectory import measured_pose

SHORT = Scene(
    "x",
    "x",
    Geometry(length_m=60.0),
    RigSettings(),
    TrainingSettings(6),
    EvaluationSettings(1),
    DriveSettings(0.2),
)
OTHER = {bool: lambda v: not v, int: lambda v: v + 1, float: lambda v: 0.5 * v + 0.0625}
SPECIAL = {
    "directions": "there",
    "thinned_hz": (5.0,),
    "size_px": (320, 180),
    "along_m": (3.0,),
    "oncoming_m": (5.0,),
    "crossing_m": (7.0,),
    "floors": (1, 3),
    "rate_hz": 60.0,
    "rig": "mid_front,mid_back",
    "cameras": 17,
    "drops": 400,
    "turbidity": 4.0,
    "side": -1,
    "at_s": (0.2, 1.5),
    "steps": (0.4, -0.8),
    "day": 3,
}
SKY_TIMES_S = (0.0, 1.2, 1.4, 2.8, 4.2)
ON = {"turnover": {"day": 3}}
"""Other keys that must be set for a key to change anything."""


def changed(settings: Any, key: str) -> Any:
    value = getattr(settings, key)
    return replace(settings, **{key: SPECIAL.get(key) or OTHER[type(value)](value)})


def keys_of(kind: type[Any]) -> list[tuple[type[Any], str]]:
    return [(kind, field.name) for field in fields(kind)]


def digest(*values: Any) -> str:
    return hashlib.sha256(pickle.dumps(values)).hexdigest()


def world_digest(world: World) -> str:
    meshes = [(m.material, m.vertices, m.uv) for m in world.meshes]
    movers = [(m.world_from_mover(1.0), [mesh.vertices for mesh in m.meshes]) for m in world.movers]
    skies = [world.sky_at(t) for t in SKY_TIMES_S] if world.sky_at else [world.sky]
    looks = [(m.colour, m.roughness) for m in world.materials.values()]
    lights = [sky_numbers(sky) for sky in skies]
    return digest(meshes, movers, looks, lights)


def sky_numbers(sky: Sky) -> Any:
    sun = (*sky.sun_towards, *(sky.exposure * np.array(sky.sun_radiance)))
    return np.round(sky.radiance * sky.exposure, 4), np.round(sun, 4)


@pytest.fixture(autouse=True)
def low_skies(monkeypatch: pytest.MonkeyPatch) -> None:
    """Skies of few rows, which are made at once."""

    def sunny(day: Daylight, rng: np.random.Generator) -> Sky:
        return sunny_sky(day, rng, height=16)

    def cloudless(day: Daylight, rng: np.random.Generator) -> Sky:
        return sunny(replace(day, cover=0.0), rng)

    def grey(unevenness: float, white: float, rng: np.random.Generator) -> Sky:
        return overcast_sky(unevenness, white, rng, height=16)

    monkeypatch.setattr("streetgen.effects.dusk.sunny_sky", sunny)
    monkeypatch.setattr("streetgen.effects.evening.sunny_sky", cloudless)
    monkeypatch.setattr("streetgen.effects.overcast.overcast_sky", grey)
    blank = Sky(np.full((16, 32, 3), 0.5, np.float32))
    monkeypatch.setattr("streetgen.assembly.clear_sky", lambda _rng: blank)
    monkeypatch.setattr("streetgen.assembly.road", lambda *_: StreetPart((), ()))
    monkeypatch.setattr("streetgen.assembly.buildings", blocks_for_buildings)
    monkeypatch.setattr("streetgen.assembly.trees", posts_for_trees)


def blocks_for_buildings(layout: Layout, _rng: np.random.Generator) -> StreetPart:
    """Return blocks as high as houses: painting walls takes seconds."""
    blocks = [
        boxes(Surface("block", Label.BUILDING), (p.start_m, p.y_m, 0), (p.end_m, p.y_m, p.height_m))
        for p in layout.plots
    ]
    return StreetPart(tuple(blocks), (Material("block", (0.1, 0.1, 0.1)),))


def posts_for_trees(layout: Layout, _rng: np.random.Generator) -> StreetPart:
    """Return posts in place of trees: growing trees takes seconds."""
    posts = [
        boxes(Surface("stem", Label.POLE), (t.x_m, t.y_m, 0), (t.x_m, t.y_m, 1))
        for t in layout.trees
    ]
    return StreetPart(tuple(posts), (Material("stem", (0.1, 0.1, 0.1)),))


@pytest.mark.parametrize(
    ("effect", "key"),
    [(e, f.name) for e in EFFECTS for f in fields(load_effect(e))],
    ids=lambda value: value if isinstance(value, str) else value.name,
)
def test_a_key_of_an_effect_changes_what_it_makes(effect, key):
    settings = load_effect(effect)(**ON.get(key, {}))
    made = frame_digest if effect.on_frames else changed_digest
    assert made(settings, effect) != made(changed(settings, key), effect)


@lru_cache(maxsize=64)
def changed_digest(settings: Any, effect: Any) -> str:
    layout = Layout(Geometry(length_m=40.0))
    sky = Sky(np.full((16, 32, 3), 0.5, np.float32), sun_radiance=(2.0, 2.0, 2.0))
    bare = World(layout, sky).plus(StreetPart((), (Material("asphalt", (0.1, 0.1, 0.1)),)))
    return world_digest(settings.change(bare, rng_of(effect, 1, 0)))


def frame_digest(settings: Any, effect: Any) -> str:
    plain = plain_frame(96, 54, 90.0)
    waves = 0.4 + 0.3 * np.sin(np.arange(54) / 4)[:, None, None] * np.ones((1, 96, 3))
    frame = replace(plain, colour=waves.astype(np.float32), time_s=0.7)
    seen: LinearFrame = settings.apply(frame, rng_of(effect, 1, 3))
    return digest(seen.colour, seen.camera)


@pytest.mark.parametrize(
    ("kind", "key"),
    [
        pair
        for kind in (
            Geometry,
            RigSettings,
            TrainingSettings,
            EvaluationSettings,
            DriveSettings,
            LocalisationNoise,
        )
        for pair in keys_of(kind)
    ],
    ids=lambda value: value if isinstance(value, str) else value.__name__,
)
def test_a_key_of_a_part_changes_the_street_or_its_pictures(kind, key):
    if kind is LocalisationNoise:
        noise = LocalisationNoise(0.1, 1.0)
        pose = shots_of(SHORT, Split.DRIVE)[1].camera.world_from_cam
        assert measured_pose(pose, noise, 1) != measured_pose(pose, changed(noise, key), 1)
        return
    part = {
        Geometry: "geometry",
        RigSettings: "rig",
        TrainingSettings: "train",
        EvaluationSettings: "evaluation",
    }
    name = part.get(kind, "drive")
    other = replace(SHORT, **{name: changed(getattr(SHORT, name), key)})
    assert wanted(SHORT, kind) != wanted(other, kind)


def wanted(scene: Scene, kind: type[Any]) -> str:
    if kind is Geometry:
        return world_digest(plain_world(scene))
    shots = [(s.camera, s.time_s) for split in Split for s in shots_of(scene, split)]
    return digest(shots, [list(thinned_indices(scene, hz)) for hz in scene.drive.thinned_hz])
