"""Grow street trees: a trunk with a flared foot, forking limbs, and leaves along the last twigs.

A few trees are grown and each is placed several times, turned and scaled. A leaf is a quad bent
along its midrib, so that its halves are shaded differently. Bark, leaf and soil textures are
painted once.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from streetgen.classes import Label
from streetgen.geometry.grain import fractal, speckle, texture, tinted
from streetgen.geometry.layout import GroundSpot, Layout
from streetgen.geometry.mesh import F64, Material, Mesh, Texture, joined, placed
from streetgen.geometry.solids import Surface, boxes, quads, tube
from streetgen.geometry.world import StreetPart

SIZE = (256, 256)


@lru_cache(maxsize=1)
def tree_materials() -> tuple[Material, ...]:
    """Return what trees and their pits are made of; the same objects at each call."""
    rng = np.random.default_rng(11)
    return (
        Material("bark", _bark(rng)),
        Material("leaf", _leaf_shades(rng), roughness=0.9, transmission=0.0),
        Material("soil", _soil(rng)),
        Material("tree guard", (0.05, 0.045, 0.04), roughness=0.6, metallic=0.5),
    )


def _bark(rng: np.random.Generator) -> Texture:
    """Paint bark with furrows along v."""
    furrows = fractal((64, 256), 1.6, rng).repeat(4, axis=0)
    painted = tinted(SIZE, (104, 92, 76)) * (1 - 0.16 * np.clip(furrows, -1.5, 2.5))[..., None]
    return texture(painted + 7 * speckle(SIZE, 1.0, rng)[..., None])


def _leaf_shades(rng: np.random.Generator) -> Texture:
    """Paint shades of leaves, yellower along u and darker along v; a leaf shows one place."""
    u, v = np.meshgrid(np.linspace(0, 1, SIZE[1]), np.linspace(0, 1, SIZE[0]))
    colour = np.stack([74 + 46 * u, 108 + 22 * u, 40 + 6 * u], axis=2) * (1.2 - 0.5 * v)[..., None]
    return texture((colour * (1 + 0.05 * fractal(SIZE, 2.0, rng))[..., None]).astype(np.float32))


def _soil(rng: np.random.Generator) -> Texture:
    painted = tinted(SIZE, (84, 70, 56)) * (1 + 0.2 * fractal(SIZE, 1.5, rng))[..., None]
    return texture(painted + 12 * speckle(SIZE, 1.2, rng)[..., None])


BARK = Surface("bark", Label.VEGETATION, 1.2)
LEAF = Surface("leaf", Label.VEGETATION)
SOIL = Surface("soil", Label.PAVEMENT)
GUARD = Surface("tree guard", Label.OBJECT)
PIT_HALF_M = 0.7
GROWN = 4
"""Number of different trees in a street."""
SINK_M = 0.05
"""Depth under the ground at which a trunk begins, so that no gap shows."""


@dataclass(frozen=True)
class TreeSpecies:
    """The habit of a species.

    The first limb is at the height ``trunk_m``. There are ``limbs`` limbs, which reach ``reach_m``
    and rise by ``rise`` (0 is level, 1 upright). Each forks ``forks`` times into ``split`` twigs.
    There are ``leaves`` leaves in all, each ``leaf_m`` long.
    """

    trunk_m: float
    girth_m: float
    limbs: int
    reach_m: float
    rise: float
    forks: int
    split: int
    leaves: int
    leaf_m: float


KINDS = (
    TreeSpecies(3.0, 0.17, 10, 2.1, 0.60, 2, 3, 12_000, 0.075),
    TreeSpecies(2.8, 0.13, 13, 1.6, 0.90, 2, 3, 11_000, 0.062),
    TreeSpecies(3.3, 0.20, 9, 2.4, 0.55, 2, 3, 13_000, 0.085),
)


@dataclass(eq=False)
class Growth:
    """A tree that grows: its tubes of wood, and its twigs (start, end) for leaves."""

    wood: list[Mesh] = field(default_factory=list)
    twigs: list[tuple[F64, F64]] = field(default_factory=list)


def trees(layout: Layout, rng: np.random.Generator) -> StreetPart:
    """Return a tree in its pit at each of the layout's places."""
    stock = [grown(KINDS[i % len(KINDS)], rng) for i in range(GROWN)]
    meshes: list[Mesh] = []
    for place in layout.trees:
        scale = rng.uniform(0.85, 1.2)
        meshes += [placed(mesh, _upright(place, scale)) for mesh in stock[rng.integers(GROWN)]]
        meshes += _pit(place)
    return StreetPart(tuple(meshes), tree_materials())


def grown(kind: TreeSpecies, rng: np.random.Generator) -> list[Mesh]:
    """Return a tree whose foot is at the origin: bark and leaves."""
    growth = Growth()
    height = np.array([-SINK_M, 0.05, 0.25, 0.5, 0.75, 1.0, 1.35]) * kind.trunk_m
    height[0] = -SINK_M
    lean = np.cumsum(rng.normal(0, 0.03, (len(height), 2)), axis=0)
    lean[:2] = 0
    trunk = np.concatenate([lean, height[:, None]], axis=1)
    girth = kind.girth_m * np.array([1.5, 1.2, 1.0, 0.93, 0.87, 0.8, 0.5])
    growth.wood.append(tube(BARK, trunk, girth, 12))
    leader = (trunk[-1], np.array([0.0, 0.0, 1.0]))
    _branch(growth, kind, leader, kind.reach_m, kind.girth_m * 0.5, kind.forks, rng)
    for limb in range(kind.limbs):
        share = (limb + 0.5) / kind.limbs
        start = trunk[-2] + (trunk[-1] - trunk[-2]) * share
        turn = 2.4 * limb + rng.uniform(-0.4, 0.4)
        rise = np.clip(kind.rise + 0.35 * share + rng.normal(0, 0.1), 0.1, 1.2)
        towards = np.array([np.cos(turn), np.sin(turn), rise])
        length = kind.reach_m * rng.uniform(0.8, 1.15) * (1 - 0.25 * share)
        _branch(growth, kind, (start, towards), length, kind.girth_m * 0.42, kind.forks, rng)
    return [*joined(growth.wood), _leaves(kind, growth.twigs, rng)]


def _branch(
    growth: Growth,
    kind: TreeSpecies,
    ray: tuple[F64, F64],
    length_m: float,
    girth_m: float,
    forks: int,
    rng: np.random.Generator,
) -> None:
    """Grow a branch along a ray (start, direction), and the branches that fork from it."""
    start, towards = ray
    direction = towards / np.linalg.norm(towards)
    steps = np.linspace(0, 1, 5)[:, None]
    bend = rng.normal(0, 0.12, 3) * length_m
    path = start + direction * length_m * steps + bend * steps**2
    growth.wood.append(tube(BARK, path, girth_m * np.linspace(1, 0.45, 5), 7 if forks else 4))
    if forks == 0:
        growth.twigs.append((path[1], path[-1]))
        return
    for child in range(kind.split + 1):
        at = path[-1] if child == 0 else path[2 + child % 2]
        spread = rng.normal(0, 0.55 if child else 0.3, 3)
        spread[2] += 0.12
        next_ray = (at, direction + spread)
        _branch(growth, kind, next_ray, 0.62 * length_m, 0.5 * girth_m, forks - 1, rng)


def _leaves(kind: TreeSpecies, twigs: list[tuple[F64, F64]], rng: np.random.Generator) -> Mesh:
    """Return two quads for each leaf, around points along the twigs."""
    ends = np.array(twigs)
    count = kind.leaves
    twig = ends[rng.integers(0, len(ends), count)]
    along = rng.uniform(0.1, 1.1, (count, 1))
    spread = np.clip(rng.normal(0, 0.2, (count, 3)), -0.35, 0.35)
    centre = twig[:, 0] + (twig[:, 1] - twig[:, 0]) * along + spread
    outwards = centre - ends.mean(axis=(0, 1))
    tip = _unit(rng.normal(0, 1, (count, 3)) + 0.8 * _unit(outwards) - np.array([0, 0, 0.35]))
    facing = _unit(rng.normal(0, 0.6, (count, 3)) + np.array([0, 0, 0.9]))
    across = _unit(np.cross(facing, tip))
    up = np.cross(tip, across)
    length = kind.leaf_m * rng.uniform(0.7, 1.25, (count, 1))
    stem, end = centre - tip * length, centre + tip * length
    halves = []
    for side in (1.0, -1.0):
        edge = across * side * 0.62 * length + up * 0.18 * length
        near, far = centre - tip * 0.35 * length + edge, centre + tip * 0.35 * length + edge
        halves.append(np.stack([stem, near, far, end] if side < 0 else [stem, end, far, near], 1))
    shade = np.repeat(rng.uniform(0.02, 0.98, (count, 1, 2)), 4, axis=1)
    return quads(LEAF, np.concatenate(halves), np.concatenate([shade, shade]))


def _unit(vectors: F64) -> F64:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9))


def _upright(place: GroundSpot, scale: float) -> F64:
    cos, sin = np.cos(place.heading_rad) * scale, np.sin(place.heading_rad) * scale
    x, y, z = place.x_m, place.y_m, place.z_m
    return np.array([[cos, -sin, 0, x], [sin, cos, 0, y], [0, 0, scale, z], [0, 0, 0, 1]])


def _pit(place: GroundSpot) -> list[Mesh]:
    """Return soil in a frame of iron, level with the pavement."""
    centre, half = np.array([place.x_m, place.y_m]), PIT_HALF_M
    (x0, y0), (x1, y1), z = centre - half, centre + half, place.z_m + 0.012
    soil = quads(SOIL, [[(x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)]])
    t = 0.04
    low = [(x0 - t, y0 - t), (x0 - t, y1), (x0 - t, y0), (x1, y0)]
    high = [(x1 + t, y0), (x1 + t, y1 + t), (x0, y1), (x1 + t, y1)]
    below, above = place.z_m - 0.05, place.z_m + 0.03
    frame = boxes(GUARD, [(*at, below) for at in low], [(*at, above) for at in high])
    return [soil, frame]
