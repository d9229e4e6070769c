"""Hold the whole street: the things that stand or move in it, and the light over it.

* A module of ``streetgen.geometry`` that adds something offers a function
  ``(layout, rng) -> StreetPart`` (``tree.trees``, ``furniture.signs``, ``road.road``). The layout
  says where things may stand. Each part has its own generator, so that parts do not affect each
  other.
* ``sky.clear_sky(rng) -> Sky`` is the light of a scene that names no other.
* The settings of an effect on geometry, light or surfaces have ``change(world, rng) -> World``. A
  ``StreetPart`` brings its materials along; two materials of one name must be the same object.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from rfcore.errors import InvalidInput
from streetgen.geometry.layout import Layout
from streetgen.geometry.mesh import F32, F64, Colour, Material, Mesh


@dataclass(frozen=True, eq=False)
class Sky:
    """The light from above.

    ``radiance`` float32 [H, 2 H, 3], linear, without the sun: row i looks (i + 0.5) / H pi away
    from the zenith, column j (j + 0.5) / H pi from x towards y. ``sun_towards`` points at the sun,
    whose disc is ``sun_diameter_deg`` wide and shines with ``sun_radiance`` (0: no sun).
    ``exposure`` turns radiance into the linear light of a frame, where 1 is white.
    """

    radiance: F32
    sun_towards: tuple[float, float, float] = (0.0, 0.0, 1.0)
    sun_radiance: Colour = (0.0, 0.0, 0.0)
    sun_diameter_deg: float = 0.53
    exposure: float = 1.0

    def __post_init__(self) -> None:
        shape = self.radiance.shape
        if self.radiance.dtype != np.float32 or shape != (len(self.radiance), 2 * shape[0], 3):
            raise InvalidInput(
                "sky.radiance", f"is {self.radiance.dtype} {shape}, not float32 [H, 2 H, 3]"
            )
        if not (np.isfinite(self.radiance).all() and self.radiance.min() >= 0):
            raise InvalidInput("sky.radiance", "is negative or not finite")
        if not abs(np.linalg.norm(self.sun_towards) - 1) < 1e-6:
            raise InvalidInput("sky.sun_towards", f"{self.sun_towards} is not of length 1")
        if not (np.isfinite(self.exposure) and self.exposure > 0):
            raise InvalidInput("sky.exposure", f"is {self.exposure}, must be above 0")


@dataclass(frozen=True, eq=False)
class Mover:
    """Meshes that move as a whole: ``world_from_mover(time_s)`` returns their 4x4 matrix."""

    meshes: tuple[Mesh, ...]
    world_from_mover: Callable[[float], F64]


@dataclass(frozen=True, eq=False)
class StreetPart:
    """Meshes, some of which may move, and the materials that they name."""

    meshes: tuple[Mesh, ...]
    materials: tuple[Material, ...]
    movers: tuple[Mover, ...] = ()


@dataclass(frozen=True, eq=False)
class World:
    """A street to render. Every material that a mesh names is in ``materials``.

    ``sky`` is the light at time 0; if it changes, ``sky_at(time_s)`` returns that of any time.
    """

    layout: Layout
    sky: Sky
    meshes: tuple[Mesh, ...] = ()
    materials: Mapping[str, Material] = field(default_factory=dict)
    movers: tuple[Mover, ...] = ()
    sky_at: Callable[[float], Sky] | None = None

    def __post_init__(self) -> None:
        moving = (mesh for mover in self.movers for mesh in mover.meshes)
        for mesh in (*self.meshes, *moving):
            if mesh.material not in self.materials:
                raise InvalidInput("world.materials", f"have no '{mesh.material}'")

    def plus(self, part: StreetPart) -> World:
        """Return the world with a part in it; raise ``InvalidInput`` for a name taken twice."""
        materials = dict(self.materials)
        for material in part.materials:
            if materials.setdefault(material.name, material) is not material:
                raise InvalidInput("world.materials", f"'{material.name}' names two materials")
        return replace(
            self,
            meshes=self.meshes + part.meshes,
            movers=self.movers + part.movers,
            materials=materials,
        )

    def with_material(self, material: Material) -> World:
        """Return the world with the material of that name replaced."""
        if material.name not in self.materials:
            raise InvalidInput("world.materials", f"have no '{material.name}'")
        return replace(self, materials={**self.materials, material.name: material})
