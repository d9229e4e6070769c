"""The motion between a render's camera and a picture's: direct photometric alignment.

The render's pixels x with depth are points X in its camera's axes; the picture is sampled where a
rigid motion M puts them, and M is moved until both agree (inverse compositional alignment, Baker
and Matthews, IJCV 2004; on depth, Kerl et al., ICRA 2013)::

    r(x) = I(pi(M X)) - R(x),    J(x) = grad R(x) dpi/dX [1 | -[X]x],
    delta = argmin sum w (r - J delta)^2 + prior,    M <- M exp(delta)^-1

I and R are not luma but its local structure (``rfcore.localise.matching``): a field of noon is
aligned with a picture of dusk, which no gain and offset of luma would do. Weights are those of
Geman and McClure at twice the residuals' spread: what is not in the field has no weight. With
Cauchy's, a van that overtakes takes the pose along. The prior holds M near where it began, by the
accuracy that is expected there: a picture without texture moves nothing.

M need not be small: the render may be that of an earlier frame, and M begin at the motion since.
``Template`` is what is computed of a render once: at each level of a pyramid at most so many
pixels, the strongest gradient of each cell of a grid, and their J. Only the sender does this, and
it sends the pose it took, so nothing here has to be exact.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Intrinsics, Pose
from rfcore.extras import needs
from rfcore.localise.matching import Pyramid
from rfcore.motion import quaternion_from_vector, rotation_vector
from rfcore.views import BEND_LIMIT, FieldView

with needs("localise"):
    import cv2

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
Places = tuple[NDArray[np.intp], NDArray[np.intp]]
"""Rows and columns [N] of pixels."""

NEARBY_PX = 15
"""Pixels take part whose gradient is above the mean of a square of this side around them."""
LEAST_GRADIENT = np.float32(0.1)
"""Least excess of the gradient over that mean, in units of the structure a pixel; less is noise."""
FINEST_PIXELS, COARSE_PIXELS = 6000, 3000
"""Largest number of pixels of the finest level, and of any other. With half as many in the
others a picture predicted far off was aligned where it is not (hypothesis found it)."""
MAX_STEPS = 8
"""Largest number of steps of a level."""
CONVERGED_PX = 0.03
"""A step that moves pixels of middling depth by less ends a level."""
MIN_PIXELS = 60
"""Fewer than ten textured pixels for each unknown do not determine a motion."""
NEAREST_OF_MEDIAN = 0.02
"""Share of the median depth that points must lie away: nearer ones are in the camera."""
MIN_CONFIDENCE = 0.5
"""Least confidence of a pixel that takes part (``rfcore.views``); it is 0 where depth breaks."""
MEDIAN_OF_EVERY = 7
"""A median of every seventh depth is good enough."""
LEAST_SPREAD = 0.02
"""Least spread of residuals; values of the structure lie about -2..2."""
TINY = np.float32(1e-6)


@dataclass(frozen=True)
class Expected:
    """Expected distance of a motion from where alignment begins: one sigma."""

    metres: float
    radians: float


@dataclass(frozen=True)
class _Level:
    """The pixels of a render that take part, at one scale.

    ``values`` [N] of the structure, ``points`` [3, N] in the axes of the render's camera,
    ``jacobian`` [6, N].
    """

    intrinsics: Intrinsics
    values: F32
    points: F32
    jacobian: F32

    def moved(self, motion: Pose) -> F32:
        """Return where ``motion`` puts the points [3, N]."""
        turn = np.array(motion.rotation_matrix(), np.float32)
        moved: F32 = turn @ self.points + np.array(motion.translation_m, np.float32)[:, None]
        return moved


@dataclass(frozen=True)
class _Scale:
    """A render at one scale: structure, depth and opacity, [H, W] each."""

    structure: F32
    depth: F32
    opacity: F32
    intrinsics: Intrinsics

    def trusted(self, at: Places) -> NDArray[np.bool_]:
        """Return at which inner pixels [N] depth is trusted: confidence as ``rfcore.views`` has it,
        of these pixels alone."""
        rows, columns = at
        sides = (
            self.depth[rows + down, columns + across]
            for down, across in ((0, 0), (0, -1), (0, 1), (-1, 0), (1, 0))
        )
        inverse = np.stack([1 / np.maximum(depth, TINY) for depth in sides])
        bend = np.zeros(len(rows), np.float32)
        for before, after in ((1, 2), (3, 4)):
            second = np.abs(inverse[before] + inverse[after] - 2 * inverse[0])
            nearest = np.maximum(np.maximum(inverse[before], inverse[after]), inverse[0])
            bend = np.maximum(bend, second / nearest)
        kept = 1 - np.minimum(bend / BEND_LIMIT, np.float32(1))
        trusted: NDArray[np.bool_] = self.opacity[rows, columns] * kept >= MIN_CONFIDENCE
        return trusted

    def level(self, most: int, nearest: float) -> _Level:
        """Return at most ``most`` pixels that stand out, not nearer than ``nearest``."""
        k, plane = self.intrinsics, self.structure
        rows, columns = _outstanding(plane, self.depth > nearest, most)
        kept = self.trusted((rows, columns))
        rows, columns = rows[kept], columns[kept]
        z = self.depth[rows, columns]
        x = (columns + np.float32(0.5 - k.cx_px)) / np.float32(k.fx_px) * z
        y = (rows + np.float32(0.5 - k.cy_px)) / np.float32(k.fy_px) * z
        dx = (plane[rows, columns + 1] - plane[rows, columns - 1]) * np.float32(k.fx_px / 2)
        dy = (plane[rows + 1, columns] - plane[rows - 1, columns]) * np.float32(k.fy_px / 2)
        ax, ay = dx / z, dy / z
        az = -(ax * x + ay * y) / z
        values = plane[rows, columns]
        turns = (az * y - ay * z, ax * z - az * x, ay * x - ax * y)
        jacobian = np.stack([ax, ay, az, *turns]).astype(np.float32)
        return _Level(k, values, np.stack([x, y, z]).astype(np.float32), jacobian)


@dataclass(frozen=True)
class _Prior:
    """The expected motion, and how far from it the true one may be."""

    start: Pose
    expected: Expected

    def pull(self, motion: Pose) -> tuple[F64, F64]:
        """Return inverse variances [6] of a step, and how far the motion has gone [6]."""
        known = [self.expected.metres**-2] * 3 + [self.expected.radians**-2] * 3
        return np.array(known), _vector(self.start.inverse().compose(motion))


@dataclass(frozen=True, eq=False)
class Template:
    """A render made ready: structures, finest first, and the pixels' median depth.

    The pixels that take part in a level are chosen when it is first aligned with: of a pose that is
    corrected and drawn again only the finest are needed.
    """

    view: FieldView
    structures: Pyramid
    median_depth: float
    most_pixels: int
    chosen: dict[int, _Level] = field(default_factory=dict)

    @staticmethod
    def of(view: FieldView, most_pixels: int = FINEST_PIXELS) -> Template:
        """Return the template of a render with at most so many pixels at the finest level."""
        hit = view.depth[view.depth > 0]
        median_depth = float(np.median(hit[::MEDIAN_OF_EVERY])) if hit.size else 0.0
        return Template(view, Pyramid(view.render.y), median_depth, most_pixels)

    def level(self, number: int) -> _Level:
        """Return the pixels of one level."""
        if number not in self.chosen:
            self.chosen[number] = self._level(number)
        return self.chosen[number]

    def moved_px(self, motion: Pose, number: int = 0) -> float:
        """Return how far a motion of the camera moves the pixels of level ``number``: root mean
        square, in pixels of the finest level. Near pixels move further than those far away."""
        level = self.level(number)
        if not level.points.size:
            return 0.0
        moved = level.moved(motion)
        k, z = level.intrinsics, np.maximum(moved[2], TINY)
        across = (moved[0] / z - level.points[0] / level.points[2]) * np.float32(k.fx_px)
        down = (moved[1] / z - level.points[1] / level.points[2]) * np.float32(k.fy_px)
        return float(2**number * np.sqrt(np.mean(across**2 + down**2)))

    def _level(self, number: int) -> _Level:
        plane, k, step = self.structures[number], self.view.camera.intrinsics, 2**number
        height, width = plane.shape
        every, f = np.s_[: step * height : step, : step * width : step], 1 / step
        camera = Intrinsics(width, height, k.fx_px * f, k.fy_px * f, k.cx_px * f, k.cy_px * f)
        scale = _Scale(plane, self.view.depth[every], self.view.kept_opacity[every], camera)
        most = min(self.most_pixels, COARSE_PIXELS) if number else self.most_pixels
        return scale.level(most, max(NEAREST_OF_MEDIAN * self.median_depth, float(TINY)))


@dataclass(frozen=True)
class Aligned:
    """A motion and how well it is determined.

    ``motion`` takes the axes of the render's camera into those of the picture's. ``hessian`` [6, 6]
    is the inverse covariance of (metres, radians) in the render's axes without any prior;
    ``spread``: of the residuals; ``pixels`` took part.
    """

    motion: Pose
    hessian: F64
    spread: float
    pixels: int


def align(
    template: Template,
    picture: Pyramid,
    start: Pose,
    expected: Expected,
    levels: int | None = None,
    finest: int = 0,
) -> Aligned | None:
    """Return the motion that makes the picture's pyramid agree with the template, or None.

    Begins at ``start`` on the coarsest of so many ``levels`` (default: all) from level ``finest``
    on. None where too little is seen, or the light differs so much that nothing agrees.
    """
    prior, motion, aligned = _Prior(start, expected), start, None
    every = len(template.structures)
    coarsest = every if levels is None else min(finest + levels, every)
    for number in reversed(range(finest, coarsest)):
        aligned = _aligned(template, number, picture[number], motion, prior)
        if aligned is None:
            return None
        motion = aligned.motion
    return aligned


def _aligned(
    template: Template, number: int, picture: F32, motion: Pose, prior: _Prior
) -> Aligned | None:
    """Return the state after the steps of one level; None where too little is seen."""
    level = template.level(number)
    if len(level.values) < MIN_PIXELS:
        return Aligned(motion, np.zeros((6, 6)), 0.0, 0)
    aligned = None
    for _ in range(MAX_STEPS):
        sampled, inside = _sampled(picture, level, motion)
        pixels = int(np.count_nonzero(inside))
        if pixels < MIN_PIXELS:
            return None
        residual = sampled - level.values
        spread = max(1.4826 * _median(np.abs(residual[inside][::4])), LEAST_SPREAD)
        hessian, step = _step(level, residual, inside, spread, prior.pull(motion))
        motion = motion.compose(_pose(step).inverse())
        aligned = Aligned(motion, hessian / spread**2, spread, pixels)
        if _moved_px(step, level.intrinsics, template.median_depth) < CONVERGED_PX:
            break
    return aligned


def _median(values: F32) -> float:
    """Return the upper median: ``np.median`` takes longer to begin than to sort so few."""
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle])


def _step(
    level: _Level, residual: F32, inside: NDArray[np.bool_], spread: float, pull: tuple[F64, F64]
) -> tuple[F64, F64]:
    """Return the weighted normal matrix [6, 6] and the step [6]: metres, radians."""
    known, displaced = pull
    weights = inside / (1 + (residual * np.float32(0.5 / spread)) ** 2) ** 2
    weighted = level.jacobian * weights.astype(np.float32)
    hessian = (weighted @ level.jacobian.T).astype(np.float64)
    gradient = (weighted @ residual).astype(np.float64) + known * displaced * spread**2
    step = np.linalg.solve(hessian + np.diag(known * spread**2), gradient)
    return hessian, step.astype(np.float64)


def _moved_px(step: F64, k: Intrinsics, median_depth: float) -> float:
    """Return about how far a step moves pixels of middling depth."""
    moved = float(np.linalg.norm(step[:3])) / median_depth + float(np.linalg.norm(step[3:]))
    return moved * k.fx_px


def _outstanding(plane: F32, usable: NDArray[np.bool_], most: int) -> Places:
    """Return rows and columns of the pixels whose gradient stands out, evenly thinned to ``most``.

    Compared with the neighbourhood, not with the picture: all its parts take part.
    """
    across, down = (cv2.Sobel(plane, cv2.CV_32F, *along, ksize=1) for along in ((1, 0), (0, 1)))
    strength = np.maximum(np.abs(across), np.abs(down))
    outstanding = (strength > cv2.blur(strength, (NEARBY_PX, NEARBY_PX)) + LEAST_GRADIENT) & usable
    outstanding[0], outstanding[-1], outstanding[:, 0], outstanding[:, -1] = (False,) * 4
    chosen = np.flatnonzero(outstanding)
    if len(chosen) > most:
        chosen = chosen[np.linspace(0, len(chosen) - 1, most).astype(np.intp)]
    return np.divmod(chosen, plane.shape[1])


def _sampled(picture: F32, level: _Level, motion: Pose) -> tuple[F32, NDArray[np.bool_]]:
    """Return the picture where ``motion`` puts the level's points, bilinear, and which lie inside.

    What lies outside reads the top-left pixel.
    """
    k, (height, width) = level.intrinsics, picture.shape
    moved = level.moved(motion)
    in_front = moved[2] > TINY
    z = np.where(in_front, moved[2], np.float32(1))
    u = np.float32(k.fx_px) * moved[0] / z + np.float32(k.cx_px - 0.5)
    v = np.float32(k.fy_px) * moved[1] / z + np.float32(k.cy_px - 0.5)
    inside = in_front & (u >= 0) & (v >= 0) & (u < width - 1) & (v < height - 1)
    u, v = np.where(inside, u, np.float32(0)), np.where(inside, v, np.float32(0))
    column, row = u.astype(np.int32), v.astype(np.int32)
    right, below = u - column, v - row
    at, flat = row * width + column, picture.ravel()
    a, b, c, d = (flat[at + step] for step in (0, 1, width, width + 1))
    upper = a + (b - a) * right
    sampled: F32 = upper + (c + (d - c) * right - upper) * below
    return sampled, inside


def _pose(step: F64) -> Pose:
    """Return the motion of ``step`` [6]: a translation in metres, then a rotation vector."""
    tx, ty, tz, rx, ry, rz = (float(value) for value in step)
    return Pose((tx, ty, tz), quaternion_from_vector((rx, ry, rz)))


def _vector(motion: Pose) -> F64:
    """Return the step [6] of a motion: the inverse of ``_pose``."""
    return np.array([*motion.translation_m, *rotation_vector(motion.rotation)])
