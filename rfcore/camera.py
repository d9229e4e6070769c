"""Pinhole cameras and rigid poses.

Conventions of the whole project: right-handed axes, metres; camera axes as in OpenCV
(x right, y down, z forward); pixel centres at +0.5, so the centre of the top-left pixel is
(0.5, 0.5). A transform is named ``dst_from_src``: ``world_from_cam`` maps camera coordinates to
the tile's local frame, which is ENU (x east, y north, z up) unless its dataset has other axes
(``rfcore.vertical``).

Poses are float64. A tile's origin is subtracted before anything becomes float32, so that a
metre stays a metre at UTM and ECEF magnitudes. All arithmetic here is plain Python on float64
(no BLAS, no fused multiply-add): the same pose gives the same bits on every machine, which the
bit-exact renderer relies on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import median

from rfcore.errors import InvalidInput

MAX_SIDE_PX = 8192
"""Longest picture side accepted anywhere."""

UNIT_TOLERANCE = 1e-6
"""A quaternion is normalised if its norm is this close to 1, and refused otherwise."""

Vec3 = tuple[float, float, float]
Mat3 = tuple[Vec3, Vec3, Vec3]


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera without distortion.

    Raises ``InvalidInput`` for a side outside 1..8192 px, or a focal length or principal point
    that is not finite (focal lengths must be positive).
    """

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float

    def __post_init__(self) -> None:
        for name in ("width_px", "height_px"):
            side = getattr(self, name)
            if not 1 <= side <= MAX_SIDE_PX:
                raise InvalidInput(
                    f"intrinsics.{name}", f"{side} px is outside 1..{MAX_SIDE_PX} px"
                )
        for name in ("fx_px", "fy_px"):
            focal = getattr(self, name)
            if not (math.isfinite(focal) and focal > 0):
                raise InvalidInput(
                    f"intrinsics.{name}", f"{focal} must be a finite number of pixels above 0"
                )
        for name in ("cx_px", "cy_px"):
            if not math.isfinite(getattr(self, name)):
                raise InvalidInput(f"intrinsics.{name}", f"{getattr(self, name)} must be finite")

    def cropped(self, left_px: int, top_px: int, width_px: int, height_px: int) -> Intrinsics:
        """Return the intrinsics of a part of the picture."""
        cx_px, cy_px = self.cx_px - left_px, self.cy_px - top_px
        return Intrinsics(width_px, height_px, self.fx_px, self.fy_px, cx_px, cy_px)

    def resized(self, width_px: int, height_px: int) -> Intrinsics:
        """Return the intrinsics of the same picture resampled to another size."""
        sx, sy = width_px / self.width_px, height_px / self.height_px
        return Intrinsics(
            width_px, height_px, self.fx_px * sx, self.fy_px * sy, self.cx_px * sx, self.cy_px * sy
        )


@dataclass(frozen=True)
class Pose:
    """A rigid transform ``dst_from_src``: rotate by ``rotation``, then add ``translation_m``.

    ``rotation`` is a unit quaternion (w, x, y, z). One whose norm is within 1e-6 of 1 is
    normalised; anything else, and any value that is not finite, raises ``InvalidInput``.
    """

    translation_m: Vec3
    rotation: tuple[float, float, float, float]

    def __post_init__(self) -> None:
        if len(self.translation_m) != 3 or not all(map(math.isfinite, self.translation_m)):
            raise InvalidInput(
                "pose.translation_m", f"{self.translation_m} must be three finite metres"
            )
        if len(self.rotation) != 4 or not all(map(math.isfinite, self.rotation)):
            raise InvalidInput(
                "pose.rotation", f"{self.rotation} must be four finite numbers w, x, y, z"
            )
        w, x, y, z = self.rotation
        norm = math.sqrt(w * w + x * x + y * y + z * z)
        if abs(norm - 1.0) > UNIT_TOLERANCE:
            raise InvalidInput(
                "pose.rotation",
                f"quaternion of norm {norm:.9g} is not a unit quaternion "
                f"(tolerance {UNIT_TOLERANCE:g}); normalise it",
            )

    @staticmethod
    def identity() -> Pose:
        """Return the transform that changes nothing."""
        return Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))

    @staticmethod
    def from_matrix(matrix: Sequence[Sequence[float]]) -> Pose:
        """Return the pose of a 3x4 or 4x4 rigid matrix.

        Raises ``InvalidInput`` when the 3x3 part is not a rotation to within 1e-4.
        """
        rows = [[float(v) for v in row] for row in matrix]
        if len(rows) not in (3, 4) or any(len(row) != 4 for row in rows):
            raise InvalidInput("pose.matrix", "must be 3x4 or 4x4")
        m = [row[:3] for row in rows[:3]]
        _check_rotation(m)
        t = (rows[0][3], rows[1][3], rows[2][3])
        return Pose(t, _quaternion_from_rotation(m))

    def rounded(self) -> Pose:
        """Return the nearest pose that can be sent: that of the default ``PoseLattice``.

        It moves the pose by at most 0.25 mm along each axis and turns it by at most 5.3e-5 rad.
        """
        return LATTICE.pose(LATTICE.steps(self))

    def rotation_matrix(self) -> Mat3:
        """Return the 3x3 rotation, rows first, from the normalised quaternion."""
        w, x, y, z = self.rotation
        scale = 2.0 / (w * w + x * x + y * y + z * z)
        return (
            (1 - scale * (y * y + z * z), scale * (x * y - w * z), scale * (x * z + w * y)),
            (scale * (x * y + w * z), 1 - scale * (x * x + z * z), scale * (y * z - w * x)),
            (scale * (x * z - w * y), scale * (y * z + w * x), 1 - scale * (x * x + y * y)),
        )

    def apply(self, point: Sequence[float]) -> Vec3:
        """Map one point [3] in metres from src to dst."""
        r, t = self.rotation_matrix(), self.translation_m
        x, y, z = point
        return (
            r[0][0] * x + r[0][1] * y + r[0][2] * z + t[0],
            r[1][0] * x + r[1][1] * y + r[1][2] * z + t[1],
            r[2][0] * x + r[2][1] * y + r[2][2] * z + t[2],
        )

    def inverse(self) -> Pose:
        """Return ``src_from_dst``."""
        w, x, y, z = self.rotation
        turned = Pose((0.0, 0.0, 0.0), (w, -x, -y, -z))
        tx, ty, tz = turned.apply(self.translation_m)
        return Pose((-tx, -ty, -tz), turned.rotation)

    def compose(self, other: Pose) -> Pose:
        """Return ``self`` after ``other``: ``a_from_b.compose(b_from_c)`` is ``a_from_c``."""
        aw, ax, ay, az = self.rotation
        bw, bx, by, bz = other.rotation
        product = (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        )
        return Pose(self.apply(other.translation_m), _normalised(product))


PoseSteps = tuple[int, int, int, int, int, int, int]
"""A pose on a lattice: x, y, z in steps, and a quaternion w, x, y, z whose largest part is the
lattice's ``rotation_steps``."""


@dataclass(frozen=True)
class PoseLattice:
    """The poses that can be sent, as whole numbers; both ends make the same float64 pose of them.

    Metres are multiples of 1 / ``steps_per_m``. The parts of a quaternion are multiples of 1 /
    ``rotation_steps`` of its largest part, so that a step turns by 1 to 2 ``rotation_steps``ths of
    a radian. The first of the largest parts is positive. From numbers to the pose there are only
    divisions and a square root, which IEEE 754 defines to the last bit.
    """

    steps_per_m: int = 2000
    rotation_steps: int = 1 << 15

    def __post_init__(self) -> None:
        for name, least, most in (("steps_per_m", 1, 10**6), ("rotation_steps", 1 << 8, 1 << 20)):
            value = getattr(self, name)
            if not least <= value <= most:
                raise InvalidInput(f"lattice.{name}", f"{value} is outside {least}..{most}")

    def steps(self, pose: Pose) -> PoseSteps:
        """Return the numbers of the lattice's pose nearest to ``pose``."""
        x, y, z = (round(metres * self.steps_per_m) for metres in pose.translation_m)
        largest = max(pose.rotation, key=abs)
        parts = [round(part / largest * self.rotation_steps) for part in pose.rotation]
        if next(part for part in parts if abs(part) == self.rotation_steps) < 0:
            parts = [-part for part in parts]
        w, a, b, c = parts
        return x, y, z, w, a, b, c

    def pose(self, steps: PoseSteps) -> Pose:
        """Return the pose of these numbers."""
        x, y, z, *parts = steps
        norm = math.sqrt(sum(part * part for part in parts))
        w, a, b, c = (part / norm for part in parts)
        per_m = self.steps_per_m
        return Pose((x / per_m, y / per_m, z / per_m), (w, a, b, c))


LATTICE = PoseLattice()
"""Lattice that senders round poses to."""


NEAR_M = 10_000.0
"""float32 positions resolve 1 mm at this distance: nearer to zero, zero is the origin."""


@dataclass(frozen=True)
class TileOrigin:
    """The origin of a tile's local frame in a global metric frame (UTM or ECEF magnitudes)."""

    east_m: float = 0.0
    north_m: float = 0.0
    up_m: float = 0.0

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (self.east_m, self.north_m, self.up_m))):
            raise InvalidInput("tile_origin", f"{self} must be finite")

    @classmethod
    def beside(cls, middle_m: Sequence[float]) -> TileOrigin:
        """Return zero where ``middle_m`` is near it, else ``middle_m`` in whole metres."""
        if math.hypot(*middle_m) <= NEAR_M:
            return cls()
        return cls(*(float(round(value)) for value in middle_m))

    def localise(self, world_from_cam: Pose) -> Pose:
        """Return a global pose relative to this origin (float64 subtraction)."""
        x, y, z = world_from_cam.translation_m
        return replace(
            world_from_cam, translation_m=(x - self.east_m, y - self.north_m, z - self.up_m)
        )

    def globalise(self, world_from_cam: Pose) -> Pose:
        """Return a pose relative to this origin as a global one; the inverse of ``localise``."""
        x, y, z = world_from_cam.translation_m
        return replace(
            world_from_cam, translation_m=(x + self.east_m, y + self.north_m, z + self.up_m)
        )


@dataclass(frozen=True)
class Camera:
    """One posed pinhole camera: ``world_from_cam`` is relative to the tile's origin."""

    intrinsics: Intrinsics
    world_from_cam: Pose

    def cam_from_world(self) -> Pose:
        """Return the extrinsics of the renderer."""
        return self.world_from_cam.inverse()

    def rounded(self) -> Camera:
        """Return the camera at the pose that is sent (``Pose.rounded``).

        A sender renders at the rounded pose, so that both ends render at the same one.
        """
        return Camera(self.intrinsics, self.world_from_cam.rounded())

    def project(self, point: Sequence[float]) -> tuple[float, float, float]:
        """Project one world point [3] to (u_px, v_px, depth_m).

        ``depth_m`` is z along the optical axis; u and v are meaningful only when it is positive.
        """
        x, y, z = self.cam_from_world().apply(point)
        k = self.intrinsics
        if z == 0.0:
            return (math.nan, math.nan, 0.0)
        return (k.fx_px * x / z + k.cx_px, k.fy_px * y / z + k.cy_px, z)


def camera_on_rig(world_from_rig: Pose, camera_from_rig: Pose) -> Pose:
    """Return world_from_cam of a camera of a rig, with the same bits on every machine."""
    return world_from_rig.compose(camera_from_rig.inverse())


def _normalised(q: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    norm = math.sqrt(sum(v * v for v in q))
    return (q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm)


def median_focal_px(intrinsics: Sequence[Intrinsics]) -> float:
    """Return the median horizontal focal length of one camera or more, to 0.01 px."""
    return round(median(k.fx_px for k in intrinsics), 2)


def _check_rotation(m: list[list[float]]) -> None:
    """Raise ``InvalidInput`` unless m m^T is the identity and det m is +1, to within 1e-4."""
    for i in range(3):
        for j in range(3):
            dot = sum(m[i][k] * m[j][k] for k in range(3))
            if not abs(dot - (i == j)) < 1e-4:
                raise InvalidInput(
                    "pose.matrix",
                    f"rows {i} and {j} have product {dot:.6g}, not {int(i == j)}: not a rotation",
                )
    det = (
        m[0][0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1])
        - m[0][1] * (m[1][0] * m[2][2] - m[1][2] * m[2][0])
        + m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0])
    )
    if det < 0:
        raise InvalidInput("pose.matrix", "determinant is -1: left-handed axes, flip one of them")


def _quaternion_from_rotation(m: list[list[float]]) -> tuple[float, float, float, float]:
    """Shepperd's method: divide by the largest component, so it stays stable near 180 degrees."""
    candidates = (
        m[0][0] + m[1][1] + m[2][2],
        m[0][0] - m[1][1] - m[2][2],
        m[1][1] - m[0][0] - m[2][2],
        m[2][2] - m[0][0] - m[1][1],
    )
    largest = candidates.index(max(candidates))
    if largest == 0:
        q = (1 + candidates[0], m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1])
    elif largest == 1:
        q = (m[2][1] - m[1][2], 1 + candidates[1], m[0][1] + m[1][0], m[0][2] + m[2][0])
    elif largest == 2:
        q = (m[0][2] - m[2][0], m[0][1] + m[1][0], 1 + candidates[2], m[1][2] + m[2][1])
    else:
        q = (m[1][0] - m[0][1], m[0][2] + m[2][0], m[1][2] + m[2][1], 1 + candidates[3])
    return _normalised(q)
