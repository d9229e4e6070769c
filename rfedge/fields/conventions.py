"""The frames and axes that fields and drives are known to differ by.

A field in a normalised frame, with other axes or in other units renders black or fog without a
hint. Each ``Convention`` is one guess at what is wrong: how the field's frame follows from the
drive's world, and what has to be done to the drive's poses.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from rfcore.camera import Camera, Pose
from rfcore.field.similarity import Similarity

__all__ = ["AS_GIVEN", "Convention", "known_conventions"]

UNITS = {"": 1.0, "centimetres": 100.0, "millimetres": 1000.0, "hundreds of metres": 0.01}
"""Field units in a metre of the drive's world."""
AS_OPENGL = Pose((0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0))
"""Half a turn about x: camera axes x right, y up, z backward."""


@dataclass(frozen=True)
class Convention:
    """``field_from_world``, and whether poses are to be inverted or their camera axes turned."""

    name: str
    field_from_world: Similarity
    inverted_poses: bool = False
    opengl_axes: bool = False

    @property
    def blames_the_drive(self) -> bool:
        """Whether the drive's poses are wrong, not the field's frame."""
        return self.inverted_poses or self.opengl_axes

    def camera(self, camera: Camera) -> Camera:
        """Return where the drive's camera is in the field's frame."""
        pose = camera.world_from_cam.inverse() if self.inverted_poses else camera.world_from_cam
        if self.opengl_axes:
            pose = pose.compose(AS_OPENGL)
        move = self.field_from_world
        x, y, z = move.apply(np.array([pose.translation_m]))[0].tolist()
        return Camera(camera.intrinsics, Pose((x, y, z), move.pose.compose(pose).rotation))


AS_GIVEN = Convention("as it is", Similarity(Pose.identity()))


def known_conventions(nerfstudio: Similarity | None) -> Iterator[Convention]:
    """Yield every convention worth trying, those of one scale together.

    ``nerfstudio`` is the ``field_from_world`` of a ``dataparser_transforms.json``, if there is one.
    """
    for frame, similarity in _frames(nerfstudio).items():
        for inverted, opengl in product((False, True), (False, True)):
            for axes, turn in _axes().items():
                parts = [frame, axes, inverted * "poses inverted", opengl * "OpenGL camera axes"]
                name = ", ".join(part for part in parts if part) or AS_GIVEN.name
                yield Convention(name, similarity.compose(turn), inverted, opengl)


def _frames(nerfstudio: Similarity | None) -> dict[str, Similarity]:
    frames = {
        f"the field is in {unit}" if unit else "": Similarity(Pose.identity(), scale)
        for unit, scale in UNITS.items()
    }
    if nerfstudio is not None:
        turned = Similarity(Pose((0.0, 0.0, 0.0), nerfstudio.pose.rotation))
        frames |= {
            "the field is in nerfstudio's frame": nerfstudio,
            "nerfstudio's transform was applied instead of undone": nerfstudio.compose(nerfstudio),
            "nerfstudio's transform was undone twice": nerfstudio.inverse(),
            "the field is in nerfstudio's frame, not scaled": _without_scale(nerfstudio),
            "the field is turned as nerfstudio turns": turned,
        }
    return frames


def _without_scale(similarity: Similarity) -> Similarity:
    x, y, z = (value / similarity.scale for value in similarity.pose.translation_m)
    return Similarity(Pose((x, y, z), similarity.pose.rotation))


def _axes() -> dict[str, Similarity]:
    """Return the 24 ways to turn a cube, by what becomes of x, y, z; first no turn at all."""
    turns = {}
    for order in permutations(range(3)):
        for signs in product((1, -1), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            if math.isclose(np.linalg.det(matrix), 1.0):
                names = [f"{'-' * (s < 0)}{'xyz'[i]}" for i, s in zip(order, signs, strict=True)]
                name = f"the field's axes are {', '.join(names)} of the drive's world"
                rows = np.hstack([matrix, np.zeros((3, 1))])
                turns[name if names != ["x", "y", "z"] else ""] = Similarity(
                    Pose.from_matrix(rows.tolist())
                )
    return turns
