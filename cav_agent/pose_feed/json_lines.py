"""Parses a line of JSON per pose: gpsd's reports, or a schema of our own for everything else.

gpsd (https://gpsd.gitlab.io/gpsd/gpsd_json.html): ``TPV`` gives the position, ``ATT`` the heading
of a compass or of two antennas (without a time, as from HDT, it is that of the next position), and
``GST`` the standard deviations; other classes are ignored. Without GST an RTK solution has those of
its kind, for gpsd's own estimates leave RTK out; other estimates count as 95 %.

Our own schema, one object a line, keys with units; what is not named here is refused:

* ``time_s``: seconds of the Unix epoch, or ``time``: ISO 8601 with a zone;
* ``latitude_deg``, ``longitude_deg``, ``height_m`` (above the ellipsoid; may be left out), or
  ``x_m``, ``y_m``, ``z_m`` in the drives' global metric frame;
* ``heading_deg`` clockwise from north, or ``quaternion`` [w, x, y, z] of the vehicle's axes
  (x forward, y left, z up) to east, north, up, or to the global frame; may be left out;
* ``covariance_m2``: 3 variances or 3 rows of 3 in m2, along east, north, up or x, y, z; default
  1 m2 each; ``rotation_std_deg``: of heading or quaternion, default 3.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from datetime import datetime
from typing import Any

from cav_agent.pose_feed.fix import BadReading, FeedProblem, Fix, finite
from rfcore.camera import Vec3

KEYS = {
    "time_s", "time", "latitude_deg", "longitude_deg", "height_m", "x_m", "y_m", "z_m",
    "heading_deg", "quaternion", "covariance_m2", "rotation_std_deg",
}  # fmt: skip
TWO_SIDED_95 = 1.96
RTK_STD_M = {3: 0.03, 4: 0.3}
"""Standard deviation by TPV's status: RTK fixed and float."""
LEAST_STD_M = 0.01
UNKNOWN_STD_M = 3.0
UNKNOWN_HEIGHT_STD_M = 50.0
COURSE_STD_DEG, COMPASS_STD_DEG = 3.0, 2.0
LEAST_SPEED_MPS = 1.5
MOST_TIME_S = 18e9
"""Less than 2^64 nanoseconds."""
FRESH_S = 1.0
"""A heading of ATT goes with positions for this time."""


class JsonParser:
    """Parses one line after another."""

    def __init__(self) -> None:
        self._attitude: tuple[int, float] | None = None
        self._heading_of_next: float | None = None
        self._std_m: tuple[int, Vec3] | None = None

    def receive(self, line: str) -> Fix | None:
        """Return the fix of a line, None for one that holds none; raise ``BadReading``."""
        try:
            values = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise BadReading(FeedProblem.MALFORMED, f"not JSON: {line[:80]!r}") from error
        if not isinstance(values, dict):
            raise BadReading(FeedProblem.MALFORMED, f"not an object: {line[:80]!r}")
        return self._report(values) if "class" in values else _own(values)

    def _report(self, values: Mapping[str, Any]) -> Fix | None:
        if values["class"] == "ATT" and "heading" in values:
            heading_deg = finite("heading", values["heading"], 0, 360)
            if "time" in values:
                self._attitude = (_time_ns(values), heading_deg)
            else:
                self._heading_of_next = heading_deg
        if values["class"] == "GST" and {"time", "lon", "lat", "alt"} <= set(values):
            east, north, up = (
                max(finite("GST", values[key], 0, 1e5), LEAST_STD_M)
                for key in ("lon", "lat", "alt")
            )
            self._std_m = (_time_ns(values), (east, north, up))
        if values["class"] != "TPV":
            return None
        if finite("mode", values.get("mode", 0), 0, 3) < 2 or "lat" not in values:
            raise BadReading(FeedProblem.NO_FIX, "gpsd has no position")
        time_ns = _time_ns(values)
        height_m = None
        if values.get("mode") == 3 and "altHAE" in values:
            height_m = finite("altHAE", values["altHAE"], -1000, 10_000)
        course_deg, std_deg = self._heading(values, time_ns)
        return Fix(
            time_ns=time_ns,
            geodetic=(*_place(values, "lat", "lon"), height_m),
            xyz_m=None,
            position_std_m=self._errors(values, time_ns, height_m is not None),
            heading_deg=course_deg,
            rotation_std_deg=std_deg,
        )

    def _errors(self, values: Mapping[str, Any], time_ns: int, has_height: bool) -> Vec3:
        std_m = _stated_errors(values)
        if self._std_m is not None and _is_fresh(self._std_m[0], time_ns):
            std_m = self._std_m[1]
        return std_m if has_height else (*std_m[:2], UNKNOWN_HEIGHT_STD_M)

    def _heading(self, values: Mapping[str, Any], time_ns: int) -> tuple[float | None, float]:
        heading_deg, self._heading_of_next = self._heading_of_next, None
        if heading_deg is not None:
            return heading_deg, COMPASS_STD_DEG
        if self._attitude is not None and _is_fresh(self._attitude[0], time_ns):
            return self._attitude[1], COMPASS_STD_DEG
        if "track" in values and finite("speed", values.get("speed", 0), 0, 500) > LEAST_SPEED_MPS:
            return finite("track", values["track"], 0, 360), COURSE_STD_DEG
        return None, COURSE_STD_DEG


def _is_fresh(then_ns: int, time_ns: int) -> bool:
    return abs(time_ns - then_ns) <= FRESH_S * 1e9


def _own(values: Mapping[str, Any]) -> Fix:
    """Return the fix of an object of our own schema."""
    if unknown := sorted(set(values) - KEYS):
        raise BadReading(FeedProblem.MALFORMED, f"key {unknown[0]!r} is not known")
    geodetic, xyz_m = None, None
    if "x_m" in values:
        x, y, z = (finite(key, values.get(key), -1e8, 1e8) for key in ("x_m", "y_m", "z_m"))
        xyz_m = (x, y, z)
    else:
        height_m = None
        if "height_m" in values:
            height_m = finite("height_m", values["height_m"], -1000, 10_000)
        geodetic = (*_place(values, "latitude_deg", "longitude_deg"), height_m)
    heading_deg, rotation = None, None
    if "quaternion" in values:
        rotation = _unit(_numbers("quaternion", values["quaternion"], 4))
    elif "heading_deg" in values:
        heading_deg = finite("heading_deg", values["heading_deg"], -360, 360)
    return Fix(
        time_ns=_time_ns(values),
        geodetic=geodetic,
        xyz_m=xyz_m,
        position_std_m=_standard_deviations(values.get("covariance_m2", [1.0, 1.0, 1.0])),
        heading_deg=heading_deg,
        rotation=rotation,
        rotation_std_deg=finite("rotation_std_deg", values.get("rotation_std_deg", 3.0), 1e-6, 180),
    )


def _time_ns(values: Mapping[str, Any]) -> int:
    if "time_s" in values:
        return round(finite("time_s", values["time_s"], 0, MOST_TIME_S) * 1e9)
    text = values.get("time")
    if not isinstance(text, str):
        raise BadReading(FeedProblem.MALFORMED, f"time is {text!r}, not ISO 8601")
    try:
        moment = datetime.fromisoformat(text)
        seconds = moment.timestamp()
    except (ValueError, OverflowError) as error:
        raise BadReading(FeedProblem.MALFORMED, f"time is {text!r}, not ISO 8601") from error
    if moment.tzinfo is None:
        raise BadReading(FeedProblem.MALFORMED, f"time {text!r} has no zone; write Z for UTC")
    return round(finite("time", seconds, 0, MOST_TIME_S) * 1e9)


def _place(values: Mapping[str, Any], latitude: str, longitude: str) -> tuple[float, float]:
    return (
        finite(latitude, values.get(latitude), -90, 90),
        finite(longitude, values.get(longitude), -180, 180),
    )


def _stated_errors(values: Mapping[str, Any]) -> Vec3:
    """Return standard deviations east, north, up of a TPV's status or error estimates."""
    rtk_m = RTK_STD_M.get(int(finite("status", values.get("status", 0), 0, 100)))
    if rtk_m is not None:
        return (rtk_m, rtk_m, 1.5 * rtk_m)

    def stated(*keys: str) -> float:
        for key in keys:
            if key in values:
                return max(finite(key, values[key], 0, 1e5) / TWO_SIDED_95, LEAST_STD_M)
        return UNKNOWN_STD_M

    return (stated("epx", "eph"), stated("epy", "eph"), stated("epv"))


def _standard_deviations(covariance: object) -> Vec3:
    if isinstance(covariance, list) and covariance and isinstance(covariance[0], list):
        rows = [_numbers("covariance_m2", row, 3) for row in covariance]
        if len(rows) != 3:
            raise BadReading(FeedProblem.MALFORMED, "covariance_m2 must be 3 or 3x3 numbers")
        variances = [rows[i][i] for i in range(3)]
    else:
        variances = _numbers("covariance_m2", covariance, 3)
    if not all(v > 0 for v in variances):
        raise BadReading(FeedProblem.NOT_FINITE, f"covariance_m2 {variances} must be above 0")
    x, y, z = map(math.sqrt, variances)
    return (x, y, z)


def _numbers(name: str, values: object, count: int) -> list[float]:
    if not isinstance(values, list) or len(values) != count:
        raise BadReading(FeedProblem.MALFORMED, f"{name} must be {count} numbers")
    return [finite(name, value, -1e10, 1e10) for value in values]


def _unit(values: list[float]) -> tuple[float, float, float, float]:
    """Return a quaternion normalised; text of few digits is off by up to a hundredth."""
    length = math.hypot(*values)
    if abs(length - 1.0) > 0.01:
        raise BadReading(FeedProblem.NOT_FINITE, f"quaternion has length {length:.4g}, not 1")
    w, x, y, z = (value / length for value in values)
    return (w, x, y, z)
