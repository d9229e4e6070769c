"""Lens distortion: maps pinhole directions to positions on the sensor and back.

Coordinates are normalised: (x, y) = (X / Z, Y / Z) in camera axes, so that a pinhole's pixel is
``(fx x + cx, fy y + cy)``. ``distort`` maps the direction of a point to where the lens puts it,
``undistort`` is its inverse. Two models, with the coefficients' meaning of OpenCV 4 (calib3d) and
COLMAP, which agree: ``BrownLens`` (Brown-Conrady, OPENCV and FULL_OPENCV) and ``FisheyeLens``
(Kannala-Brandt, OPENCV_FISHEYE).

A polynomial is a lens only up to the radius where it turns back; beyond it two directions would
share one pixel. ``max_radius`` says where that is. A camera without distortion is a plain
``rfcore.camera.Camera`` and knows nothing of this module.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import Protocol

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from rfcore.camera import Intrinsics, Pose
from rfcore.errors import InvalidInput

F64 = NDArray[np.float64]

NEWTON_STEPS = 50
RESIDUAL = 1e-12
"""Normalised units: a millionth of a millionth of the focal length."""


class Lens(Protocol):
    """A distortion of normalised coordinates [N, 2], float64; a hashable value."""

    def __hash__(self) -> int: ...

    @property
    def max_radius(self) -> float:
        """Largest undistorted radius at which the lens is still one-to-one (may be infinite)."""

    def distort(self, xy: F64) -> F64:
        """Map directions [N, 2] to sensor coordinates [N, 2]."""

    def undistort(self, xy: F64) -> F64:
        """Map sensor coordinates [N, 2] to directions; ``InvalidInput`` where there is none."""


@dataclass(frozen=True)
class BrownLens:
    """Radial k1 to k6, tangential p1, p2, thin prism s1 to s4; OpenCV's order is k1 k2 p1 p2 k3 k4
    k5 k6 s1 s2 s3 s4.

    ::

        r2 = x^2 + y^2;   g = (1 + k1 r2 + k2 r2^2 + k3 r2^3) / (1 + k4 r2 + k5 r2^2 + k6 r2^3)
        x' = g x + 2 p1 x y + p2 (r2 + 2 x^2) + s1 r2 + s2 r2^2
        y' = g y + p1 (r2 + 2 y^2) + 2 p2 x y + s3 r2 + s4 r2^2
    """

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0
    s1: float = 0.0
    s2: float = 0.0
    s3: float = 0.0
    s4: float = 0.0

    def __post_init__(self) -> None:
        _check_finite(self)

    @property
    def max_radius(self) -> float:
        """The radius where r g(r) stops growing or has a pole: the least positive root of its
        derivative's numerator (n + 2 s n') d - 2 s n d', or of d, in s = r^2."""
        n, d = Polynomial((1.0, self.k1, self.k2, self.k3)), self._denominator
        growth = Polynomial((1.0, 3 * self.k1, 5 * self.k2, 7 * self.k3))
        slope = growth * d - Polynomial((0.0, 2.0)) * n * d.deriv()
        return math.sqrt(min(_least_positive_root(each) for each in (slope, d)))

    @property
    def _denominator(self) -> Polynomial:
        return Polynomial((1.0, self.k4, self.k5, self.k6))

    def distort(self, xy: F64) -> F64:
        """Map directions [N, 2] to sensor coordinates [N, 2]."""
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        g, _ = self._gain(r2)
        xd = g * x + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x)
        yd = g * y + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y
        xd, yd = xd + r2 * (self.s1 + r2 * self.s2), yd + r2 * (self.s3 + r2 * self.s4)
        return np.stack([xd, yd], axis=1)

    def _gain(self, r2: F64) -> tuple[F64, F64]:
        """Return g and its derivative by r2."""
        below = 1 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6))
        g = (1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))) / below
        slope = self.k1 + r2 * (2 * self.k2 + r2 * 3 * self.k3)
        slope_below = self.k4 + r2 * (2 * self.k5 + r2 * 3 * self.k6)
        return g, (slope - g * slope_below) / below

    def undistort(self, xy: F64) -> F64:
        """Invert by Newton's method; raises ``InvalidInput`` when a point has no direction."""
        found = xy.copy()
        for _ in range(NEWTON_STEPS):
            residual = self.distort(found) - xy
            if not np.abs(residual).max(initial=0.0) > RESIDUAL:
                break
            found -= self._newton_step(found, residual)
        missed = np.abs(self.distort(found) - xy).max(axis=1) > RESIDUAL * 1e3
        folded = np.hypot(found[:, 0], found[:, 1]) > self.max_radius
        _refuse_unreached(xy, missed | folded | ~np.isfinite(found).all(axis=1))
        return found

    def _newton_step(self, xy: F64, residual: F64) -> F64:
        """Solve J step = residual."""
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        g, slope = self._gain(r2)
        xx = g + 2 * x * x * slope + 2 * self.p1 * y + 6 * self.p2 * x
        both = 2 * x * y * slope + 2 * self.p1 * x + 2 * self.p2 * y
        yy = g + 2 * y * y * slope + 6 * self.p1 * y + 2 * self.p2 * x
        prism_x, prism_y = 2 * (self.s1 + 2 * r2 * self.s2), 2 * (self.s3 + 2 * r2 * self.s4)
        xx, xy_ = xx + prism_x * x, both + prism_x * y
        yx, yy = both + prism_y * x, yy + prism_y * y
        det = xx * yy - xy_ * yx
        det = np.where(np.abs(det) < 1e-9, 1e-9, det)
        rx, ry = residual[:, 0], residual[:, 1]
        return np.stack([(yy * rx - xy_ * ry) / det, (xx * ry - yx * rx) / det], axis=1)


@dataclass(frozen=True)
class FisheyeLens:
    """Kannala-Brandt: the radius is a polynomial of the angle t to the axis.

    ::

        t = atan(r);   r' = t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8)
    """

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    def __post_init__(self) -> None:
        _check_finite(self)

    @property
    def max_angle_rad(self) -> float:
        """The largest angle to the axis that is used: where r' stops growing, at most pi / 2."""
        t2 = _least_positive_root(
            Polynomial((1.0, 3 * self.k1, 5 * self.k2, 7 * self.k3, 9 * self.k4))
        )
        return min(math.sqrt(t2), math.pi / 2)

    @property
    def max_radius(self) -> float:
        """The tangent of ``max_angle_rad``: a pinhole sees less than a half space."""
        angle_rad = self.max_angle_rad
        return math.tan(angle_rad) if angle_rad < math.pi / 2 else math.inf

    def distort(self, xy: F64) -> F64:
        """Map directions [N, 2] to sensor coordinates [N, 2]."""
        r = np.hypot(xy[:, 0], xy[:, 1])
        return np.asarray(xy * _ratio(self._radius(np.arctan(r)), r)[:, None])

    def undistort(self, xy: F64) -> F64:
        """Invert by Newton's method on the angle; raises ``InvalidInput`` beyond the lens."""
        r = np.hypot(xy[:, 0], xy[:, 1])
        limit_rad = self.max_angle_rad
        angle_rad = np.minimum(r, limit_rad)
        for _ in range(NEWTON_STEPS):
            residual = self._radius(angle_rad) - r
            if not np.abs(residual).max(initial=0.0) > RESIDUAL:
                break
            slope = np.maximum(self._slope(angle_rad), 1e-9)
            angle_rad = np.clip(angle_rad - residual / slope, 0.0, limit_rad)
        missed = np.abs(self._radius(angle_rad) - r) > RESIDUAL * 1e3
        _refuse_unreached(xy, missed | (angle_rad >= math.pi / 2))
        return np.asarray(xy * _ratio(np.tan(angle_rad), r)[:, None])

    def _radius(self, t: F64) -> F64:
        t2 = t * t
        series = self.k1 + t2 * (self.k2 + t2 * (self.k3 + t2 * self.k4))
        return np.asarray(t * (1 + t2 * series))

    def _slope(self, t: F64) -> F64:
        t2 = t * t
        series = 3 * self.k1 + t2 * (5 * self.k2 + t2 * (7 * self.k3 + t2 * 9 * self.k4))
        return np.asarray(1 + t2 * series)


@dataclass(frozen=True)
class LensCamera:
    """A posed camera with a lens: ``intrinsics`` act on the lens's sensor coordinates."""

    intrinsics: Intrinsics
    lens: Lens
    world_from_cam: Pose

    def project(self, point: Sequence[float]) -> tuple[float, float, float]:
        """Project one world point [3] to (u_px, v_px, depth_m); NaN where the lens has no image."""
        x, y, z = self.world_from_cam.inverse().apply(point)
        if z <= 0 or math.hypot(x, y) > self.lens.max_radius * z:
            return (math.nan, math.nan, z)
        xd, yd = self.lens.distort(np.array([[x / z, y / z]]))[0]
        k = self.intrinsics
        return (k.fx_px * float(xd) + k.cx_px, k.fy_px * float(yd) + k.cy_px, z)

    def ray(self, u_px: float, v_px: float) -> tuple[float, float, float]:
        """Return the direction (x, y, 1) in camera axes that pixel position (u, v) looks along."""
        k = self.intrinsics
        sensor = np.array([[(u_px - k.cx_px) / k.fx_px, (v_px - k.cy_px) / k.fy_px]])
        x, y = self.lens.undistort(sensor)[0]
        return (float(x), float(y), 1.0)


def _check_finite(lens: BrownLens | FisheyeLens) -> None:
    if not all(map(math.isfinite, astuple(lens))):
        raise InvalidInput("lens", f"{lens} has a coefficient that is not finite")


def _least_positive_root(polynomial: Polynomial) -> float:
    """Return the least root > 0 of a polynomial, infinity if it has none."""
    roots = polynomial.trim().roots()
    real = roots[np.abs(np.imag(roots)) < 1e-9].real
    return float(min(real[real > 0], default=math.inf))


def _ratio(numerator: F64, r: F64) -> F64:
    """Return numerator / r, which is 1 on the axis."""
    return np.divide(numerator, r, out=np.ones_like(r), where=r > 1e-12)


def _refuse_unreached(xy: F64, unreached: NDArray[np.bool_]) -> None:
    if unreached.any():
        x, y = xy[np.flatnonzero(unreached)[0]]
        raise InvalidInput(
            "lens",
            f"no direction reaches sensor coordinates ({x:.4g}, {y:.4g}), and "
            f"{int(unreached.sum()) - 1} more: the distortion is not one-to-one so far out",
        )
