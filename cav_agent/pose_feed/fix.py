"""A pose of the vehicle as a sensor states it, and the pose of its camera in a field.

A vehicle's axes are x forward, y left, z up, with their origin where the feed's position is, such
as the antenna. A heading is that of x, clockwise from north; the vehicle is assumed to be upright.
The lever arm and the mounting lead from there to the camera, the anchor to the field's axes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from decimal import Decimal
from enum import StrEnum

from rfcore.camera import Pose, TileOrigin, Vec3
from rfcore.errors import InvalidData, InvalidInput
from rfcore.geodesy import Anchor
from rfcore.localise.estimate import PoseMeasurement
from rfcore.motion import quaternion_from_vector

Rotation = tuple[float, float, float, float]


class FeedProblem(StrEnum):
    """A problem of a feed: a closed set, fit for a metric's label."""

    MALFORMED = "malformed"
    """A line is none of the formats, or lacks what it must have."""
    CHECKSUM = "checksum"
    """An NMEA sentence has no checksum, or another one than its bytes."""
    NOT_FINITE = "not_finite"
    """A number is NaN, infinite, or outside what it can be on the Earth."""
    NO_FIX = "no_fix"
    """The receiver itself says that it knows no position."""
    BACKWARDS = "backwards"
    """A fix is not younger than the one before."""
    CLOCK = "clock"
    """The feed's clock is not the agent's; times are shifted by the difference."""
    JUMP = "jump"
    """The position moved faster than a vehicle does. It is used: the field shows if it is true."""
    OUTSIDE = "outside"
    """The position is outside the field's bounds."""
    NO_ANCHOR = "no_anchor"
    """The feed is on the Earth, and the field does not say where it is."""
    SILENT = "silent"
    """Nothing came for longer than usual."""
    LOST = "lost"
    """The source cannot be read; it is tried again."""


class BadReading(InvalidData):
    """A line of a feed cannot be used; ``problem`` says why in one word."""

    def __init__(self, problem: FeedProblem, text: str) -> None:
        super().__init__(f"{problem}: {text}")
        self.problem = problem


@dataclass(frozen=True)
class Fix:
    """The vehicle's pose at ``time_ns`` of the feed's clock, nanoseconds of the Unix epoch.

    Either ``geodetic``, latitude and longitude in degrees and height in metres above the ellipsoid
    of WGS 84 (``None``: not measured), or ``xyz_m`` in the global metric frame of the drives.
    ``heading_deg``: of the vehicle's x axis, clockwise from north. ``rotation``: of the vehicle's
    axes (x forward, y left, z up) to east, north, up, or to the global frame with ``xyz_m``; it
    takes precedence over the heading. Standard deviations: one sigma, in metres along the axes of
    the position.
    """

    time_ns: int
    geodetic: tuple[float, float, float | None] | None
    xyz_m: Vec3 | None
    position_std_m: Vec3
    heading_deg: float | None = None
    rotation: Rotation | None = None
    rotation_std_deg: float = 3.0


def finite(name: str, value: object, low: float = -math.inf, high: float = math.inf) -> float:
    """Return a number of a reading; raise ``BadReading`` for anything else, or out of range."""
    if isinstance(value, bool) or not isinstance(value, (int, float, str, Decimal)):
        raise BadReading(FeedProblem.MALFORMED, f"{name} is {value!r}, not a number")
    try:
        number = float(value)
    except (ValueError, OverflowError) as error:
        raise BadReading(FeedProblem.MALFORMED, f"{name} is {value!r}, not a number") from error
    if not (math.isfinite(number) and low <= number <= high):
        raise BadReading(FeedProblem.NOT_FINITE, f"{name} is {number}, outside {low:g}..{high:g}")
    return number


LOOKING_FORWARD = Pose.from_matrix([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0]])
"""vehicle_from_cam of a camera that looks along x."""


@dataclass(frozen=True)
class CameraMount:
    """The camera's place on the vehicle, seen from the point that the feed's position is of."""

    at_m: Vec3 = (0.0, 0.0, 0.0)
    """Lever arm: forward, left, up, m."""
    turned_deg: Vec3 = (0.0, 0.0, 0.0)
    """Yaw to the left, then pitch downwards, then roll to the right; 0: it looks forward."""

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (*self.at_m, *self.turned_deg))):
            raise InvalidInput("mount", f"{self.at_m}, {self.turned_deg} must be finite")
        if math.hypot(*self.at_m) > 50:
            raise InvalidInput("mount.at_m", f"{self.at_m} is more than 50 m from the antenna")

    @property
    def vehicle_from_cam(self) -> Pose:
        """The camera's pose in the vehicle's axes."""
        yaw, pitch, roll = map(math.radians, self.turned_deg)
        turn = _turned((0.0, 0.0, yaw)).compose(_turned((0.0, pitch, 0.0)))
        turn = turn.compose(_turned((roll, 0.0, 0.0))).compose(LOOKING_FORWARD)
        return Pose(self.at_m, turn.rotation)


@dataclass(frozen=True)
class FieldPlacement:
    """A field's anchor on the Earth, and its origin in the drives' global frame."""

    anchor: Anchor | None
    origin: TileOrigin
    mount: CameraMount = CameraMount()

    def measurement(self, fix: Fix, time_ns: int) -> PoseMeasurement:
        """Return the camera's pose that a fix measures, at ``time_ns`` of the agent's clock.

        Without heading and rotation the lever arm may point anywhere: then the position is the
        vehicle's, and its deviation grows by the arm's length. Raises ``InvalidInput`` for a
        position on the Earth where the field has no anchor.
        """
        position_m, std_m = self._position(fix)
        mount = self.mount.vehicle_from_cam
        reach_m = math.hypot(*mount.translation_m)
        vehicle = self._rotation(fix)
        if vehicle is None:
            return PoseMeasurement(time_ns, position_m, _widened(std_m, reach_m))
        camera = Pose(position_m, vehicle).compose(mount)
        swing_m = reach_m * math.radians(fix.rotation_std_deg)
        return PoseMeasurement(
            time_ns,
            camera.translation_m,
            _widened(std_m, swing_m),
            camera.rotation,
            fix.rotation_std_deg,
        )

    def _position(self, fix: Fix) -> tuple[Vec3, Vec3]:
        """Return position and standard deviations along the field's axes."""
        if fix.xyz_m is not None:
            local = self.origin.localise(Pose(fix.xyz_m, (1.0, 0.0, 0.0, 0.0)))
            return local.translation_m, fix.position_std_m
        if self.anchor is None or fix.geodetic is None:
            raise InvalidInput(
                "pose_feed",
                "states latitude and longitude, but the field has no anchor: "
                "`rfedge field anchor FIELD --at LATITUDE LONGITUDE HEIGHT` states one",
            )
        latitude_deg, longitude_deg, height_m = fix.geodetic
        if height_m is None:
            height_m = self.anchor.height_m
        position_m = self.anchor.world_from_geodetic(latitude_deg, longitude_deg, height_m)
        world_from_enu = _rotation_only(self.anchor.turned_from_enu((1.0, 0.0, 0.0, 0.0)))
        rows = world_from_enu.rotation_matrix()
        x, y, z = (
            math.hypot(*(r * s for r, s in zip(row, fix.position_std_m, strict=True)))
            for row in rows
        )
        return position_m, (x, y, z)

    def _rotation(self, fix: Fix) -> tuple[float, float, float, float] | None:
        """Return world_from_vehicle, None where the fix states no direction."""
        rotation = fix.rotation
        if rotation is None and fix.heading_deg is not None:
            yaw_rad = math.radians(90.0 - fix.heading_deg)
            rotation = quaternion_from_vector((0.0, 0.0, yaw_rad))
        if rotation is None or fix.xyz_m is not None or self.anchor is None:
            return rotation
        return self.anchor.turned_from_enu(rotation)


def _rotation_only(rotation: tuple[float, float, float, float]) -> Pose:
    return Pose((0.0, 0.0, 0.0), rotation)


def _turned(vector_rad: Vec3) -> Pose:
    return _rotation_only(quaternion_from_vector(vector_rad))


def _widened(std_m: Vec3, by_m: float) -> Vec3:
    x, y, z = (math.hypot(s, by_m) for s in std_m)
    return (x, y, z)
