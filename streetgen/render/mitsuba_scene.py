"""Turn a world into a Mitsuba scene: shapes, reflectance models, and the sky as environment map.

There is one shape for each material and label, never instances: 83 instances of a tree made a frame
seven times slower in the LLVM variant than the same triangles baked into one mesh.

The sun is painted into the environment map instead of being a second emitter: the path tracer picks
one emitter at random for each shadow ray, so that a separate sun would get half of them, whereas a
map is sampled by its radiance, most of which is the sun's anyway.

Glossy surfaces use ``plastic``: a mirror over paint needs no more samples than paint does, where
``principled`` at a low roughness is noisy.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from streetgen.geometry.mesh import F32, F64, I32, Material, Mesh, joined, placed
from streetgen.geometry.world import Sky, World

ROWS = 512
"""Rows of the environment map: 0.35 degrees a pixel, so that the sun covers a few of them."""
LEAST_SUN_PX = 1.5


def environment(mi: Any, sky: Sky) -> dict[str, Any]:
    """Return the description that ``mi.load_dict`` takes.

    Mitsuba's map has its zenith along y and column 0 along -z there; turned upright by 90 degrees
    about x that is world +y, and the columns run from there towards -x (clockwise).
    """
    radiance = with_sun(sky)
    columns = radiance.shape[1]
    ours = (columns // 4 + columns - 1 - np.arange(columns)) % columns
    bitmap = mi.Bitmap(np.ascontiguousarray(radiance[:, ours]))
    upright = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    return {"type": "envmap", "bitmap": bitmap, "to_world": upright}


def with_sun(sky: Sky) -> F32:
    """Return the sky's radiance, at least 512 rows of it, with the sun's light in its disc.

    The disc covers whole pixels; its radiance is scaled so that the light stays what the disc of
    ``sun_diameter_deg`` would give.
    """
    repeat = -(-ROWS // len(sky.radiance))
    radiance = sky.radiance.repeat(repeat, axis=0).repeat(repeat, axis=1)
    if max(sky.sun_radiance) == 0:
        return radiance
    rows = len(radiance)
    towards, solid_angle = _directions(rows)
    cosine = towards @ np.array(sky.sun_towards)
    radius = max(np.radians(sky.sun_diameter_deg) / 2, LEAST_SUN_PX * np.pi / rows)
    inside = cosine > np.cos(radius)
    true_angle = 2 * np.pi * (1 - np.cos(np.radians(sky.sun_diameter_deg) / 2))
    share = true_angle / solid_angle[inside].sum()
    radiance[inside] += (np.array(sky.sun_radiance) * share).astype(np.float32)
    return radiance


def _directions(rows: int) -> tuple[F64, F64]:
    """Return the direction of each pixel of a map [H, 2 H, 3] and its solid angle [H, 2 H]."""
    down = (np.arange(rows) + 0.5) / rows * np.pi
    round_ = (np.arange(2 * rows) + 0.5) / rows * np.pi
    theta, phi = np.meshgrid(down, round_, indexing="ij")
    towards = np.stack(
        [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1
    )
    return towards, np.sin(theta) * (np.pi / rows) ** 2


MATT = 0.85
"""Roughness from which on a dielectric's highlight is not worth its samples."""
GLASS_INDEX = 1.5


def surface(mi: Any, material: Material) -> dict[str, Any]:
    """Return the description that ``mi.load_dict`` takes."""
    both_sides = {"type": "twosided", "inner": _model(mi, material)}
    if material.transmission == 0:
        return both_sides
    return {"type": "mask", "opacity": 1.0 - material.transmission, "inner": both_sides}


def _model(mi: Any, material: Material) -> dict[str, Any]:
    colour = _colour(mi, material)
    if material.gloss:
        return {"type": "plastic", "diffuse_reflectance": colour, "int_ior": GLASS_INDEX}
    if material.metallic == 0 and np.min(material.roughness) >= MATT:
        return {"type": "diffuse", "reflectance": colour}
    return {
        "type": "principled",
        "base_color": colour,
        "roughness": _roughness(mi, material),
        "metallic": material.metallic,
        "specular": 0.5,
    }


def _colour(mi: Any, material: Material) -> dict[str, Any]:
    if not isinstance(material.colour, np.ndarray):
        return {"type": "rgb", "value": list(material.colour)}
    bitmap = mi.Bitmap(np.ascontiguousarray(material.colour))
    return {"type": "bitmap", "bitmap": bitmap, "raw": False, "filter_type": "bilinear"}


def _roughness(mi: Any, material: Material) -> Any:
    if not isinstance(material.roughness, np.ndarray):
        return float(material.roughness)
    bitmap = mi.Bitmap(np.ascontiguousarray(material.roughness[..., None]))
    return {"type": "bitmap", "bitmap": bitmap, "raw": True}


class MitsubaScene:
    """A loaded scene. ``at`` moves its movers; ``labels`` has the class of each shape."""

    def __init__(self, mi: Any, world: World) -> None:
        self._mi = mi
        self._world = world
        self._surfaces = {
            name: mi.load_dict(surface(mi, material)) for name, material in _used(world).items()
        }
        self.exposure = world.sky.exposure
        self._light = mi.load_dict(environment(mi, world.sky))
        self._still = self._shapes(joined(world.meshes))
        self._time_s: float | None = None
        self.scene: Any = None
        self.labels: I32 = np.empty(0, np.int32)
        self.at(0.0)

    def at(self, time_s: float) -> None:
        """Put the movers and the light where they are at that time.

        In a world where neither changes there is nothing to do.
        """
        changing = self._world.movers or self._world.sky_at
        if self.scene is not None and (not changing or time_s == self._time_s):
            return
        if self._world.sky_at is not None:
            sky = self._world.sky_at(time_s)
            self.exposure = sky.exposure
            self._light = self._mi.load_dict(environment(self._mi, sky))
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
    """Return the materials that some mesh names, so that no other is loaded."""
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
