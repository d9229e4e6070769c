"""The 18 cameras of a car, which the CARLA recorder and streetgen both use.

The published method names the number of cameras, not their places. These are three rows of six.
Heights, reach and tilts follow the authors' later recorder (Maftej/rfdvc): low before the bumper
and tilted up, at roof height and level, high and tilted down. Each row looks to the front, 45
degrees to either side, to both sides and back.
"""

from __future__ import annotations

from dataclasses import dataclass

from rfcore.errors import InvalidInput


@dataclass(frozen=True)
class Mount:
    """A camera on the car, in CARLA's vehicle axes: x forward, y right, z up, metres, degrees."""

    name: str
    x_m: float
    y_m: float
    z_m: float
    pitch_deg: float
    yaw_deg: float


ROWS = (("low", 5.5, 0.5, 15.0), ("mid", 2.5, 2.5, 0.0), ("high", 2.5, 5.5, -15.0))
"""Name, reach before the car's middle, height, pitch."""


def _row(name: str, reach_m: float, z_m: float, pitch_deg: float) -> tuple[Mount, ...]:
    def mount(side: str, x_m: float, y_m: float, yaw_deg: float) -> Mount:
        return Mount(f"{name}_{side}", x_m, y_m, z_m, pitch_deg, yaw_deg)

    return (
        mount("front", reach_m, 0.0, 0.0),
        mount("front_left", reach_m, 0.0, -45.0),
        mount("front_right", reach_m, 0.0, 45.0),
        mount("left", 0.0, -1.0, -90.0),
        mount("right", 0.0, 1.0, 90.0),
        mount("back", -reach_m, 0.0, 180.0),
    )


RIG = tuple(mount for row in ROWS for mount in _row(*row))


def mounts_named(names: str) -> tuple[Mount, ...]:
    """Return ``all`` mounts or those of a comma-separated list."""
    if names == "all":
        return RIG
    known = {mount.name: mount for mount in RIG}
    for name in names.split(","):
        if name not in known:
            raise InvalidInput("cameras", f"'{name}' is none of {', '.join(known)}")
    return tuple(known[name] for name in names.split(","))
