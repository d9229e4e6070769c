"""The motion between a frame's camera and a render's: direct photometric alignment, coarse to fine.

The render's pixels x with depth are points X in the measured camera; the frame is sampled where a
rigid motion M puts them, and M is moved until both agree (inverse compositional alignment, Baker
and Matthews, IJCV 2004; on depth, Kerl et al., ICRA 2013)::

    r(x) = (I(pi(M X)) - b) / a - R(x),    J(x) = grad R(x) dpi/dX [1 | -[X]x],
    delta = argmin sum w (r - J delta)^2 + prior,    M <- M exp(delta)^-1

a and b, a change of light, are solved along. Weights are Cauchy's at twice the residuals' spread:
what is not in the field has no weight. The prior holds M near the measured pose, by the accuracy
poses are measured with: a picture without texture moves nothing.

J, of the render, is computed once a level; a level uses at most ``MAX_PIXELS``, those of the
strongest gradient. float64 and numpy: only the sender does this, and sends the pose it took.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Intrinsics, Pose
from rfcore.image import I420
from rfcore.motion import quaternion_from_vector, rotation_vector
from rfcore.views import FieldView

__all__ = ["PRIOR_M", "PRIOR_RAD", "align"]

COARSEST_PX = 60
"""Shortest side of the coarsest level; 0.2 m at 5 m are then less than 3 px."""
MAX_PIXELS = 12_000
"""Half of them leave 0.60 cm and 0.025 degrees where these leave 0.49 and 0.017 (10 and 20 cm, 0.1
and 0.5 degrees of noise on the first sample with vehicles), and save a quarter of the time."""
MAX_STEPS = 12
"""Per level."""
CONVERGED_PX = 0.01
"""A step that moves pixels by less ends a level."""
MIN_PIXELS = 60
"""Fewer than ten textured pixels for each unknown do not determine a motion."""

PRIOR_M, PRIOR_RAD = 0.2, math.radians(0.5)
"""How far a measured pose is expected to be off (one sigma)."""
NEAREST_M = 0.2
MIN_CONFIDENCE = 0.5
"""Of a pixel that takes part (``rfcore.views``): none where depth breaks."""

F64 = NDArray[np.float64]
Array = NDArray[Any]


@dataclass(frozen=True)
class _Level:
    """Both luma planes, depth and trust at one scale."""

    frame: F64
    render: F64
    depth: F64
    trusted: NDArray[np.bool_]
    intrinsics: Intrinsics

    def halved(self) -> _Level:
        height, width = (side // 2 for side in self.frame.shape)
        k = self.intrinsics
        return _Level(
            _half(self.frame),
            _half(self.render),
            _half(self.depth),
            _half_all(self.trusted),
            Intrinsics(width, height, k.fx_px / 2, k.fy_px / 2, k.cx_px / 2, k.cy_px / 2),
        )


def align(frame: I420, view: FieldView, has_time: Callable[[], bool] = lambda: True) -> Pose:
    """Return the motion from the measured camera's axes into those of ``frame``'s camera.

    Stops, at the best motion so far, when ``has_time`` says no; it is asked before every step.
    """
    level = _Level(
        frame.y.astype(np.float64),
        view.render.y.astype(np.float64),
        view.depth.astype(np.float64),
        (view.confidence >= MIN_CONFIDENCE) & (view.depth > NEAREST_M),
        view.camera.intrinsics,
    )
    levels = [level]
    while min(levels[-1].frame.shape) >= 2 * COARSEST_PX:
        levels.append(levels[-1].halved())
    motion = Pose.identity()
    for level in reversed(levels):
        if not has_time():
            break
        motion = _aligned(level, motion, has_time)
    return motion


def _aligned(level: _Level, motion: Pose, has_time: Callable[[], bool]) -> Pose:
    """Return ``motion`` after the steps of one level."""
    template = _template(level)
    if template is None:
        return motion
    gain, offset = 1.0, 0.0
    for _ in range(MAX_STEPS):
        if not has_time():
            break
        sampled, inside = _sampled(level.frame, level.intrinsics, template.points, motion)
        residual = (sampled - offset) / gain - template.values
        step = _step(template, residual, inside, motion)
        if step is None:
            break
        motion = motion.compose(_pose(step[:6]).inverse())
        gain, offset = gain * (1 + step[6]), offset + gain * step[7]
        if not 0.2 < gain < 5:
            return motion
        if _pixels(step, level, template) < CONVERGED_PX:
            break
    return motion


@dataclass(frozen=True)
class _Template:
    """The pixels of a render that take part: luma [N], points [N, 3] in metres, jacobian [N, 8]."""

    values: F64
    points: F64
    jacobian: F64


def _template(level: _Level) -> _Template | None:
    gradient_y, gradient_x = np.gradient(level.render)
    strength = np.where(level.trusted, gradient_x**2 + gradient_y**2, 0.0).ravel()
    strength[_border(level.render.shape)] = 0.0
    chosen = np.flatnonzero(strength > 1.0)
    if len(chosen) > MAX_PIXELS:
        chosen = chosen[np.argpartition(strength[chosen], -MAX_PIXELS)[-MAX_PIXELS:]]
    if len(chosen) < MIN_PIXELS:
        return None
    k = level.intrinsics
    rows, columns = np.divmod(chosen, level.render.shape[1])
    z = level.depth.ravel()[chosen]
    x = (columns + 0.5 - k.cx_px) / k.fx_px * z
    y = (rows + 0.5 - k.cy_px) / k.fy_px * z
    gx, gy = (g.ravel()[chosen] for g in (gradient_x * k.fx_px, gradient_y * k.fy_px))
    along_x, along_y = gx / z, gy / z
    along_z = -(along_x * x + along_y * y) / z
    values = level.render.ravel()[chosen]
    jacobian = np.stack(
        [
            along_x,
            along_y,
            along_z,
            along_z * y - along_y * z,
            along_x * z - along_z * x,
            along_y * x - along_x * y,
            values,
            np.ones_like(values),
        ],
        axis=1,
    )
    return _Template(values, np.stack([x, y, z], axis=1), jacobian)


def _border(shape: tuple[int, ...]) -> NDArray[np.intp]:
    """Return the flat indices of the outermost pixels, whose gradient is one-sided."""
    edge = np.ones(shape, bool)
    edge[1:-1, 1:-1] = False
    return np.flatnonzero(edge)


def _sampled(frame: F64, k: Intrinsics, points: F64, motion: Pose) -> tuple[F64, NDArray[np.bool_]]:
    """Return the frame where ``motion`` puts ``points``, bilinear, and which lie inside."""
    moved = points @ np.array(motion.rotation_matrix()).T + np.array(motion.translation_m)
    z = np.maximum(moved[:, 2], NEAREST_M / 2)
    u = k.fx_px * moved[:, 0] / z + k.cx_px - 0.5
    v = k.fy_px * moved[:, 1] / z + k.cy_px - 0.5
    height, width = frame.shape
    inside = (u >= 0) & (v >= 0) & (u < width - 1) & (v < height - 1) & (moved[:, 2] > NEAREST_M)
    u, v = np.where(inside, u, 0.0), np.where(inside, v, 0.0)
    column, row = u.astype(np.intp), v.astype(np.intp)
    a, b = u - column, v - row
    flat, at = frame.ravel(), row * width + column
    upper = flat[at] * (1 - a) + flat[at + 1] * a
    lower = flat[at + width] * (1 - a) + flat[at + width + 1] * a
    return upper * (1 - b) + lower * b, inside


def _step(
    template: _Template, residual: F64, inside: NDArray[np.bool_], motion: Pose
) -> F64 | None:
    """Return the weighted least-squares step [8]: metres, radians, gain, offset."""
    if np.count_nonzero(inside) < MIN_PIXELS:
        return None
    spread = max(1.4826 * float(np.median(np.abs(residual[inside]))), 1.0)
    weights = inside / (1 + (residual / (2 * spread)) ** 2)
    weighted = template.jacobian * weights[:, None]
    known = np.array([PRIOR_M**-2] * 3 + [PRIOR_RAD**-2] * 3 + [1.0, 1e-2]) * spread**2
    hessian = weighted.T @ template.jacobian + np.diag(known)
    gradient = weighted.T @ residual
    gradient[:6] += known[:6] * _vector(motion)
    step: F64 = np.linalg.solve(hessian, gradient).astype(np.float64)
    return step


def _pose(step: F64) -> Pose:
    """Return the motion of ``step`` [6]: a translation in metres, then a rotation vector."""
    tx, ty, tz, rx, ry, rz = (float(value) for value in step)
    return Pose((tx, ty, tz), quaternion_from_vector((rx, ry, rz)))


def _vector(motion: Pose) -> F64:
    """Return the step [6] of a motion: the inverse of ``_pose``."""
    return np.array([*motion.translation_m, *rotation_vector(motion.rotation)])


def _pixels(step: F64, level: _Level, template: _Template) -> float:
    """Return about how far a step moves pixels of middling depth."""
    middling_m = float(np.median(template.points[:, 2]))
    moved = float(np.linalg.norm(step[:3])) / middling_m + float(np.linalg.norm(step[3:6]))
    return moved * level.intrinsics.fx_px


def _quarters(plane: Array) -> tuple[Array, Array, Array, Array]:
    """Return the four samples of each whole 2x2 block: five times as fast as reducing an axis."""
    even = plane[: plane.shape[0] // 2 * 2, : plane.shape[1] // 2 * 2]
    return even[0::2, 0::2], even[0::2, 1::2], even[1::2, 0::2], even[1::2, 1::2]


def _half(plane: F64) -> F64:
    a, b, c, d = _quarters(plane)
    halved: F64 = (a + b + c + d) / 4
    return halved


def _half_all(trusted: NDArray[np.bool_]) -> NDArray[np.bool_]:
    a, b, c, d = _quarters(trusted)
    every: NDArray[np.bool_] = a & b & c & d
    return every
