"""Georeferencing: places a field on the Earth, between WGS 84 and the field's own axes.

An anchor states the coordinates of one point of a world on the WGS 84 ellipsoid, and the rotation
from the world's axes to east, north, up there. Positions in between follow from the tangent plane
at the anchor (local Cartesian ENU by ECEF, float64), which ``pymap3d`` computes; it comes with the
extra ``localise`` and is imported on first use. Latitude and longitude in degrees, heights in
metres above the ellipsoid: NMEA states them above mean sea level and adds the geoid's separation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

from rfcore.camera import Pose, TileOrigin, Vec3
from rfcore.errors import InvalidInput
from rfcore.extras import needs

Rotation = tuple[float, float, float, float]
UPRIGHT: Rotation = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Anchor:
    """The point ``point_m`` of a world is at these coordinates of WGS 84.

    ``enu_from_world``: unit quaternion w, x, y, z; the identity where the world's axes are east,
    north, up. Raises ``InvalidInput`` for a latitude outside -90..90, a longitude outside
    -180..180 degrees, a height outside -1000..10000 m, and what ``Pose`` refuses.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float = 0.0
    enu_from_world: Rotation = UPRIGHT
    point_m: Vec3 = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        check_geodetic("anchor", self.latitude_deg, self.longitude_deg, self.height_m)
        Pose(self.point_m, self.enu_from_world)

    @staticmethod
    def of_ecef(point_m: Vec3) -> Anchor:
        """Return the anchor of a world that is ECEF of WGS 84, at one of its points."""
        with needs("localise"):
            from pymap3d import ecef2geodetic
        lat, lon, height_m = map(float, ecef2geodetic(*point_m))
        (sin_p, cos_p), (sin_l, cos_l) = (
            (math.sin(angle), math.cos(angle)) for angle in map(math.radians, (lat, lon))
        )
        east, north = (-sin_l, cos_l, 0.0), (-sin_p * cos_l, -sin_p * sin_l, cos_p)
        up = (cos_p * cos_l, cos_p * sin_l, sin_p)
        turn = Pose.from_matrix([[*axis, 0.0] for axis in (east, north, up)])
        return Anchor(lat, lon, height_m, turn.rotation, point_m)

    def relative_to(self, origin: TileOrigin) -> Anchor:
        """Return the anchor of the world whose origin is at ``origin`` of this one."""
        moved = origin.localise(Pose(self.point_m, UPRIGHT))
        return replace(self, point_m=moved.translation_m)

    def world_from_geodetic(
        self, latitude_deg: float, longitude_deg: float, height_m: float
    ) -> Vec3:
        """Return the point of the world at coordinates of WGS 84; raise ``InvalidInput``."""
        check_geodetic("position", latitude_deg, longitude_deg, height_m)
        with needs("localise"):
            from pymap3d import geodetic2enu
        enu = geodetic2enu(
            latitude_deg, longitude_deg, height_m,
            self.latitude_deg, self.longitude_deg, self.height_m,
        )  # fmt: skip
        return self._world_from_enu().apply(tuple(map(float, enu)))

    def geodetic_from_world(self, point_m: Vec3) -> tuple[float, float, float]:
        """Return latitude and longitude in degrees and height in metres of a point of the world."""
        with needs("localise"):
            from pymap3d import enu2geodetic
        east_m, north_m, up_m = self._world_from_enu().inverse().apply(point_m)
        found = enu2geodetic(
            east_m, north_m, up_m, self.latitude_deg, self.longitude_deg, self.height_m
        )
        latitude_deg, longitude_deg, height_m = map(float, found)
        return latitude_deg, longitude_deg, height_m

    def turned_from_enu(self, enu_from_body: Rotation) -> Rotation:
        """Return world_from_body of a body's orientation to east, north, up."""
        turn = Pose((0.0, 0.0, 0.0), self.enu_from_world).inverse()
        return turn.compose(Pose((0.0, 0.0, 0.0), enu_from_body)).rotation

    def _world_from_enu(self) -> Pose:
        return Pose(self.point_m, Pose((0.0, 0.0, 0.0), self.enu_from_world).inverse().rotation)


def check_geodetic(name: str, latitude_deg: float, longitude_deg: float, height_m: float) -> None:
    """Raise ``InvalidInput`` for coordinates that no road on the Earth has."""
    for axis, value, low, high, unit in (
        ("latitude_deg", latitude_deg, -90.0, 90.0, "degrees"),
        ("longitude_deg", longitude_deg, -180.0, 180.0, "degrees"),
        ("height_m", height_m, -1000.0, 10_000.0, "m"),
    ):
        if not (math.isfinite(value) and low <= value <= high):
            raise InvalidInput(f"{name}.{axis}", f"{value} is outside {low:g}..{high:g} {unit}")


def anchor_values(anchor: Anchor) -> dict[str, Any]:
    """Return an anchor as JSON, as ``anchor_of_values`` reads it."""
    return {key: list(v) if isinstance(v, tuple) else v for key, v in asdict(anchor).items()}


def anchor_of_values(values: Mapping[str, Any]) -> Anchor:
    """Return the anchor that JSON or TOML states.

    ``height_m`` may be left out (0), and so may ``enu_from_world`` and ``point_m``. Raises
    ``InvalidInput`` for other keys, missing ones and values of another kind.
    """
    known = Anchor.__dataclass_fields__
    if not isinstance(values, Mapping) or not {"latitude_deg", "longitude_deg"} <= set(values):
        raise InvalidInput("anchor", "must be a table with latitude_deg and longitude_deg")
    if unknown := sorted(set(values) - set(known)):
        raise InvalidInput("anchor", f"'{unknown[0]}' is none of {', '.join(known)}")
    lengths = {"enu_from_world": 4, "point_m": 3}
    numbers: dict[str, Any] = {}
    for key, value in values.items():
        parts = value if key in lengths else [value]
        if not isinstance(parts, (list, tuple)) or len(parts) != lengths.get(key, 1):
            raise InvalidInput(f"anchor.{key}", f"{value!r} must be {lengths.get(key, 1)} numbers")
        if not all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in parts):
            raise InvalidInput(f"anchor.{key}", f"{value!r} is not a number")
        numbers[key] = tuple(map(float, parts)) if key in lengths else float(value)
    return Anchor(**numbers)
