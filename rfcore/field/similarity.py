"""Moves a field to another frame by a rotation, a scale and a translation.

``p_dst = scale * rotation @ p_src + translation_m``. Means, widths, rotations and colours of the
Gaussians change; colours, because spherical harmonics are functions of the direction in the field's
frame. It is done in float64 by elementwise additions, multiplications and square roots (no BLAS),
so that a field moved without a scale is the same on every machine.

nerfstudio's ``dataparser_transforms.json`` says how it normalised the scene that a ``.ply`` was
trained in: ``{"transform": 3x4, "scale": s}`` with p_field = s * (transform @ (p_world, 1)). The
dataset's poses are in the world, not in that frame.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Pose, TileOrigin
from rfcore.errors import FieldFormatError, InvalidInput
from rfcore.harmonics import SH_DC, higher_harmonics
from rfcore.raster.gaussians import F32, Gaussians

F64 = NDArray[np.float64]


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
        turned = _mapped(points, self.rotation)
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
    return np.ascontiguousarray(_mapped(quaternions.astype(np.float64), left), np.float32)


def turned_sh(sh: F32, rotation: F64) -> F32:
    """Return the coefficients [N, K, 3] of colours rotated with the field.

    Each band is closed under rotation. Its matrix is the integral over the sphere of a product of
    two harmonics of the band, which a sum over few directions is equal to.
    """
    turned = sh.copy()
    directions, weights = _quadrature()
    here = spherical_harmonics(directions)
    there = spherical_harmonics(_mapped(directions, rotation))
    for degree in range(1, round(sh.shape[1] ** 0.5)):
        band = slice(degree**2, (degree + 1) ** 2)
        matrix = _mapped((there[:, band] * weights[:, None]).T, here[:, band].T)
        coloured = sh[:, band].astype(np.float64)
        for channel in range(3):
            turned[:, band, channel] = _mapped(coloured[..., channel], matrix)
    return turned


def _mapped(vectors: F64, matrix: F64) -> F64:
    """Return matrix [M, K] times each of ``vectors`` [N, K], summed in order."""
    total = vectors[:, :1] * matrix[:, 0]
    for k in range(1, matrix.shape[1]):
        total = total + vectors[:, k : k + 1] * matrix[:, k]
    return np.asarray(total)


def _quadrature() -> tuple[F64, F64]:
    """Return 32 directions [32, 3] and their weights, exact for polynomials up to degree 7: Gauss's
    four nodes along z, eight angles around it."""
    root = np.sqrt(1.2) * 2 / 7
    z = np.sqrt([3 / 7 - root, 3 / 7 + root])
    weights = np.array([18 + np.sqrt(30.0), 18 - np.sqrt(30.0)]) / 36 * np.pi / 4
    half = np.sqrt(0.5)
    around = [(1, 0), (half, half), (0, 1), (-half, half)]
    circle = np.array([*around, *(tuple(-v for v in each) for each in around)])
    rows = [
        (x * np.sqrt(1 - height * height), y * np.sqrt(1 - height * height), height, weight)
        for node, weight in zip(z, weights, strict=True)
        for height in (node, -node)
        for x, y in circle
    ]
    table = np.array(rows)
    return table[:, :3], table[:, 3]


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
