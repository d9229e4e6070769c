"""Hold triangle meshes in the street's world frame, and materials that no renderer is needed for.

The world is right-handed and in metres: x along the street, y to the left when looking along x, z
up, the road's surface at z = 0. Faces are anticlockwise seen from outside. ``uv`` is in units of
the texture, which repeats; v = 0 is its first row.

Colours are linear reflectances; textures are 8-bit with the sRGB curve. ``gloss`` is a clear,
perfectly smooth layer over the colour (panes, car paint, enamel): it mirrors the street without
noise, where a surface of low roughness would need many samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput
from streetgen.classes import Label

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles of one material and one label.

    ``vertices`` are float32 [V, 3], ``faces`` int32 [F, 3], ``uv`` float32 [V, 2]. ``normals`` are
    unit vectors, float32 [V, 3], for surfaces that look smooth, or None for flat faces. Raises
    ``InvalidInput`` for other shapes or types, indices out of range, and values that are not
    finite.
    """

    vertices: F32
    faces: I32
    uv: F32
    material: str
    label: Label
    normals: F32 | None = None

    def __post_init__(self) -> None:
        count = len(self.vertices)
        self._require("vertices", self.vertices, (count, 3), np.float32)
        self._require("uv", self.uv, (count, 2), np.float32)
        self._require("faces", self.faces, (len(self.faces), 3), np.int32)
        if self.normals is not None:
            self._require("normals", self.normals, (count, 3), np.float32)
        if self.faces.size and not 0 <= self.faces.min() <= self.faces.max() < count:
            raise InvalidInput("mesh.faces", f"of '{self.material}' name none of {count} vertices")

    def _require(
        self, name: str, values: NDArray[np.generic], shape: tuple[int, int], kind: type[np.generic]
    ) -> None:
        if values.shape != shape or values.dtype != kind:
            raise InvalidInput(
                f"mesh.{name}",
                f"of '{self.material}' are {values.dtype} {values.shape}, not {kind.__name__} "
                f"{shape}",
            )
        if not np.isfinite(values.astype(np.float64)).all():
            raise InvalidInput(f"mesh.{name}", f"of '{self.material}' are not all finite")


def placed(mesh: Mesh, world_from_mesh: F64) -> Mesh:
    """Move a mesh by a 4x4 matrix: a rotation times a positive scale, and a translation."""
    linear, shift = world_from_mesh[:3, :3], world_from_mesh[:3, 3]
    vertices = (mesh.vertices @ linear.T + shift).astype(np.float32)
    if mesh.normals is None:
        return replace(mesh, vertices=vertices)
    turned = mesh.normals @ linear.T
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    return replace(mesh, vertices=vertices, normals=turned.astype(np.float32))


def faceted(mesh: Mesh) -> Mesh:
    """Return a mesh with normals: its own, or those of its flat faces, each with own vertices."""
    if mesh.normals is not None:
        return mesh
    vertices = mesh.vertices[mesh.faces]
    normal = np.cross(vertices[:, 1] - vertices[:, 0], vertices[:, 2] - vertices[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.float32(1e-20))
    return replace(
        mesh,
        vertices=vertices.reshape(-1, 3),
        faces=np.arange(3 * len(vertices), dtype=np.int32).reshape(-1, 3),
        uv=mesh.uv[mesh.faces].reshape(-1, 2),
        normals=np.repeat(normal, 3, axis=0).astype(np.float32),
    )


def joined(meshes: Sequence[Mesh]) -> list[Mesh]:
    """Return one mesh, with normals, for each material and label, in the order they first appear.

    A renderer is several times faster with few large meshes than with many small ones.
    """
    groups: dict[tuple[str, Label], list[Mesh]] = {}
    for mesh in meshes:
        groups.setdefault((mesh.material, mesh.label), []).append(faceted(mesh))
    return [_concatenated(group) for group in groups.values()]


def _concatenated(group: Sequence[Mesh]) -> Mesh:
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in group[:-1]], dtype=np.int32)
    return replace(
        group[0],
        vertices=np.concatenate([mesh.vertices for mesh in group]),
        faces=np.concatenate([m.faces + start for m, start in zip(group, starts, strict=True)]),
        uv=np.concatenate([mesh.uv for mesh in group]),
        normals=np.concatenate([mesh.normals for mesh in group if mesh.normals is not None]),
    )


Colour = tuple[float, float, float]
Texture = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Material:
    """A surface seen from both sides.

    ``colour`` is a linear reflectance 0..1, or a texture uint8 [H, W, 3]. ``roughness`` is
    0.02..1, or a map float32 [H, W] of it on the same uv; from 0.85 on a dielectric is matt.
    ``metallic`` is 0..1. With ``gloss`` a clear layer lies over the colour, and ``roughness`` is
    not used. ``transmission`` 0..1 is the share of light that passes unbent.
    """

    name: str
    colour: Colour | Texture
    roughness: float | NDArray[np.float32] = 0.9
    metallic: float = 0.0
    gloss: bool = False
    transmission: float = 0.0

    def __post_init__(self) -> None:
        if isinstance(self.colour, np.ndarray):
            self._require_texture(self.colour)
        else:
            self._require_share("colour", np.array(self.colour))
        rough = np.asarray(self.roughness)
        self._require_share("roughness", rough)
        if rough.ndim not in (0, 2) or (rough.ndim == 2 and rough.dtype != np.float32):
            raise InvalidInput(
                f"material.{self.name}.roughness",
                f"is {rough.dtype} {rough.shape}, neither a number nor float32 [H, W]",
            )
        self._require_share("metallic", np.array(self.metallic))
        self._require_share("transmission", np.array(self.transmission))

    def _require_texture(self, texture: Texture) -> None:
        if texture.dtype != np.uint8 or texture.ndim != 3 or texture.shape[2] != 3:
            raise InvalidInput(
                f"material.{self.name}.colour",
                f"is {texture.dtype} {texture.shape}, not uint8 [H, W, 3]",
            )

    def _require_share(self, name: str, values: NDArray[np.generic]) -> None:
        numbers = values.astype(np.float64)
        if not ((numbers >= 0) & (numbers <= 1)).all():
            raise InvalidInput(f"material.{self.name}.{name}", f"is {values}, outside 0..1")
