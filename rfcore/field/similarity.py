"""Moves a field to another frame by a rotation, a scale and a translation.

``p_dst = scale * rotation @ p_src + translation_m``. Means, widths, rotations and colours of the
Gaussians change; colours, because spherical harmonics are functions of the direction in the field's
frame. It is done in float64, once, when a field is imported.

nerfstudio's ``dataparser_transforms.json`` says how it normalised the scene that a ``.ply`` was
trained in: ``{"transform": 3x4, "scale": s}`` with p_field = s * (transform @ (p_world, 1)). The
dataset's poses are in the world, not in that frame.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.random import default_rng
from numpy.typing import NDArray

from rfcore.camera import Pose, TileOrigin
from rfcore.errors import FieldFormatError, InvalidInput
from rfcore.harmonics import SH_DC, higher_harmonics
from rfcore.raster.gaussians import F32, Gaussians

F64 = NDArray[np.float64]
DIRECTIONS = 64
"""Sample directions for the rotation of SH, which has at most 7 unknowns a row."""


@dataclass(frozen=True)
class Similarity:
    """``dst_from_src``; ``pose`` holds rotation and translation (in metres of dst)."""

    pose: Pose
    scale: float = 1.0

    def __post_init__(self) -> None:
        if not 1e-9 <= self.scale <= 1e9:
            raise InvalidInput("transform.scale", f"{self.scale} is outside 1e-9..1e9")

    @property
    def rotation(self) -> F64:
        """The rotation as a matrix [3, 3]."""
        return np.array(self.pose.rotation_matrix())

    def inverse(self) -> Similarity:
        """Return ``src_from_dst``."""
        back = self.pose.inverse()
        x, y, z = (value / self.scale for value in back.translation_m)
        return Similarity(Pose((x, y, z), back.rotation), 1 / self.scale)

    def compose(self, other: Similarity) -> Similarity:
        """Return ``self`` after ``other``."""
        x, y, z = (value * self.scale for value in other.pose.translation_m)
        inner = Pose((x, y, z), other.pose.rotation)
        return Similarity(self.pose.compose(inner), self.scale * other.scale)

    def localised(self, origin: TileOrigin) -> Similarity:
        """Return the transform into a tile's frame, from one into the global frame (float64)."""
        return replace(self, pose=origin.localise(self.pose))

    def apply(self, points: F64) -> F64:
        """Map points [N, 3] from src to dst."""
        turned = points @ self.rotation.T
        return np.asarray(self.scale * turned + np.array(self.pose.translation_m))


def moved(gaussians: Gaussians, dst_from_src: Similarity) -> Gaussians:
    """Return the Gaussians expressed in the frame dst."""
    means = dst_from_src.apply(gaussians.means.astype(np.float64))
    widening = np.log(dst_from_src.scale)
    return replace(
        gaussians,
        means=np.ascontiguousarray(means, np.float32),
        quaternions=turned_rotations(gaussians.quaternions, dst_from_src.pose.rotation),
        log_scales=(gaussians.log_scales.astype(np.float64) + widening).astype(np.float32),
        sh=turned_sh(gaussians.sh, dst_from_src.rotation),
    )


def spherical_harmonics(directions: F64) -> F64:
    """Return the 16 real basis functions [M, 16] of unit directions [M, 3], as splats use them.

    Same order and signs as ``rfcore.raster.reference`` (Kerbl et al. 2023; Sloan 2013).
    """
    x, y, z = directions.T
    basis = [SH_DC * np.ones_like(x), *higher_harmonics(x, y, z)]
    return np.stack(basis, axis=1)


def turned_rotations(quaternions: F32, by: tuple[float, float, float, float]) -> F32:
    """Return ``by`` times each quaternion [N, 4] (w, x, y, z); norms stay."""
    w, x, y, z = by
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return np.ascontiguousarray(quaternions.astype(np.float64) @ left.T, np.float32)


def turned_sh(sh: F32, rotation: F64) -> F32:
    """Return the coefficients [N, K, 3] of colours rotated with the field.

    Each band is closed under rotation; its matrix is solved from its values in many directions.
    """
    turned = sh.copy()
    directions = default_rng(0).normal(size=(DIRECTIONS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    here, there = spherical_harmonics(directions), spherical_harmonics(directions @ rotation)
    for degree in range(1, round(sh.shape[1] ** 0.5)):
        band = slice(degree**2, (degree + 1) ** 2)
        matrix = np.linalg.lstsq(here[:, band], there[:, band], rcond=None)[0]
        turned[:, band] = np.einsum("ij,njc->nic", matrix, sh[:, band].astype(np.float64))
    return turned


def read_field_from_world(path: Path) -> Similarity:
    """Return ``field_from_world``; raise ``FieldFormatError`` naming the file and the fault."""
    try:
        content = json.loads(path.read_bytes())
        scale = float(content["scale"])
        pose = Pose.from_matrix(content["transform"])
        x, y, z = (scale * value for value in pose.translation_m)
        return Similarity(Pose((x, y, z), pose.rotation), scale)
    except OSError as error:
        raise FieldFormatError(f"{path}: cannot be read ({error.strerror})") from error
    except (KeyError, TypeError, ValueError, InvalidInput) as error:
        raise FieldFormatError(
            f'{path}: not {{"transform": 3x4, "scale": s}} of nerfstudio ({error})'
        ) from error
