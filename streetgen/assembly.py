"""Make the world of a scene, and apply the scene's effects to rendered frames.

Each part of the street and each effect has its own random generator. So leaving one out changes no
other.
"""

from __future__ import annotations

import zlib

import numpy as np

from streetgen.effects import EFFECTS, rng_of
from streetgen.frame import LinearFrame
from streetgen.geometry.building import buildings
from streetgen.geometry.furniture import lamps, railings, signs, wires
from streetgen.geometry.layout import Layout
from streetgen.geometry.road import road
from streetgen.geometry.sky import clear_sky
from streetgen.geometry.tree import trees
from streetgen.geometry.world import World
from streetgen.scene_file import Scene


def world_of(scene: Scene) -> World:
    """Return everything that is rendered of a scene."""
    world = plain_world(scene)
    for effect in EFFECTS:
        if effect.name in scene.effects and not effect.on_frames:
            settings = scene.effects[effect.name]
            world = settings.change(world, rng_of(effect, scene.geometry.seed, 0))
    return world


def plain_world(scene: Scene) -> World:
    """Return the street without any effect, under a clear sky."""
    geometry = scene.geometry
    layout = Layout(geometry)
    parts = {"road": road, "buildings": buildings, "lamps": lamps, "railings": railings}
    if geometry.wires:
        parts["wires"] = wires
    if geometry.trees:
        parts["trees"] = trees
    if geometry.signs:
        parts["signs"] = signs
    world = World(layout, clear_sky(_rng(geometry.seed, "sky")))
    for name, part in parts.items():
        world = world.plus(part(layout, _rng(geometry.seed, name)))
    return world


def _rng(seed: int, name: str) -> np.random.Generator:
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def apply_effects(scene: Scene, frame: LinearFrame, index: int) -> LinearFrame:
    """Return frame ``index`` as the scene's air and sensor make it; without effects, unchanged."""
    for effect in EFFECTS:
        if effect.on_frames and effect.name in scene.effects:
            rng = rng_of(effect, scene.geometry.seed, index)
            frame = scene.effects[effect.name].apply(frame, rng)
    return frame
