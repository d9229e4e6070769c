"""A world as a Mitsuba scene: one shape for each material and label, never instances.

83 instances of a tree made a frame seven times slower in the LLVM variant than the same triangles
baked into one mesh.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rfedge.street.geometry.material import Material
from rfedge.street.geometry.mesh import I32, Mesh, joined, placed
from rfedge.street.geometry.world import World
from rfedge.street.render.light import environment
from rfedge.street.render.surfaces import surface

__all__ = ["Stage"]


class Stage:
    """A loaded scene. ``at`` moves what moves; ``labels`` says what each shape counts as."""

    def __init__(self, mi: Any, world: World) -> None:
        self._mi = mi
        self._world = world
        self._surfaces = {
            name: mi.load_dict(surface(mi, material)) for name, material in _used(world).items()
        }
        self._light = mi.load_dict(environment(mi, world.sky))
        self._still = self._shapes(joined(world.meshes))
        self._time_s: float | None = None
        self.scene: Any = None
        self.labels: I32 = np.empty(0, np.int32)
        self.at(0.0)

    def at(self, time_s: float) -> None:
        """Put the movers where they are at that time; nothing to do in a world without any."""
        if self.scene is not None and (not self._world.movers or time_s == self._time_s):
            return
        moving = [
            placed(mesh, mover.world_from_mover(time_s))
            for mover in self._world.movers
            for mesh in mover.meshes
        ]
        shapes = [*self._still, *self._shapes(joined(moving))]
        named = {f"shape{i:04d}": shape for i, (shape, _) in enumerate(shapes)}
        content = {"type": "scene", "light": self._light, **named}
        self.scene = self._mi.load_dict(content, optimize=False)
        self.labels = np.array([label for _, label in shapes], np.int32)
        self._time_s = time_s

    def _shapes(self, meshes: Sequence[Mesh]) -> list[tuple[Any, int]]:
        return [
            (_shape(self._mi, mesh, self._surfaces[mesh.material]), mesh.label) for mesh in meshes
        ]


def _used(world: World) -> Mapping[str, Material]:
    """The materials that some mesh names, so that no other is loaded."""
    moving = (mesh for mover in world.movers for mesh in mover.meshes)
    names = {mesh.material for mesh in (*world.meshes, *moving)}
    return {name: m for name, m in world.materials.items() if name in names}


def _shape(mi: Any, mesh: Mesh, bsdf: Any) -> Any:
    properties = mi.Properties()
    properties["mesh_bsdf"] = bsdf
    shape = mi.Mesh(
        f"{mesh.material}-{mesh.label.name}",
        len(mesh.vertices),
        len(mesh.faces),
        props=properties,
        has_vertex_normals=True,
        has_vertex_texcoords=True,
    )
    assert mesh.normals is not None
    values = mi.traverse(shape)
    values["vertex_positions"] = mesh.vertices.ravel()
    values["vertex_normals"] = mesh.normals.ravel()
    values["vertex_texcoords"] = mesh.uv.ravel()
    values["faces"] = mesh.faces.ravel().astype(np.uint32)
    values.update()
    return shape
