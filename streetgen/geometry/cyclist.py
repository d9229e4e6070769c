"""Model cyclists: wheels roll, the crank turns, and the legs follow the pedals.

As in ``person`` x points forward, y to the left and z up. The origin is on the ground below the
bottom bracket. Lengths are of a city bicycle with wheels of 28 inches; the saddle's height fits the
rider's legs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from streetgen.classes import Label
from streetgen.geometry.mesh import F64, Material, Mesh, joined
from streetgen.geometry.person import (
    ANKLE,
    FOREARM,
    HAND,
    HIP,
    HIP_APART,
    NECK_FOOT,
    SHANK,
    SHOULDER,
    SHOULDER_APART,
    SIDES,
    THIGH,
    UPPER_ARM,
    BodyPart,
    Person,
    body_parts,
    hinge,
    hung,
    person_materials,
)
from streetgen.geometry.solids import Surface, boxes, disc, loft, tube
from streetgen.geometry.vehicle import revolved

Point = tuple[float, float]
"""A place in the plane of the bicycle: (x, z), metres."""
WHEEL_RADIUS_M, TYRE_RADIUS_M = 0.345, 0.019
REAR_M: Point = (-0.46, WHEEL_RADIUS_M)
FRONT_M: Point = (0.60, WHEEL_RADIUS_M)
BRACKET_M: Point = (0.0, 0.28)
HEAD_LOW_M, HEAD_HIGH_M = (0.475, 0.66), (0.42, 0.84)
CRANK_M, PEDAL_THICK_M = 0.17, 0.024
BALL_M = 0.10
"""Distance from the ankle forward to the ball of the foot, which is over the pedal's axle."""
GEAR_M = 4.8
"""Distance ridden in a turn of the crank."""
SEAT_TUBE = (-math.sin(0.30), math.cos(0.30))
STRETCHED = 0.97
"""Distance from hip to ankle at the lowest pedal over the length of thigh and shank."""
LEAN_RAD, NOD_RAD = 0.5, 0.15
GRIP_M, GRIP_UP_M = 0.38, 0.08
"""Position of the hands along x, and their height above the hips."""

PAINTS = {
    "bicycle black": (0.014, 0.014, 0.015),
    "bicycle red": (0.33, 0.02, 0.018),
    "bicycle blue": (0.02, 0.09, 0.26),
    "bicycle green": (0.03, 0.14, 0.07),
    "bicycle silver": (0.44, 0.45, 0.46),
}
RUBBER = Surface("bicycle rubber", Label.BICYCLE)
METAL = Surface("bicycle metal", Label.BICYCLE)
MATERIALS = (
    *(Material(name, colour, gloss=True) for name, colour in PAINTS.items()),
    Material("bicycle rubber", (0.02, 0.02, 0.02)),
    Material("bicycle metal", (0.5, 0.5, 0.5), roughness=0.4, metallic=0.9),
)


def cyclist_materials() -> tuple[Material, ...]:
    """Return all materials of bicycles and riders; the same objects at each call."""
    return (*MATERIALS, *person_materials())


@dataclass(frozen=True)
class Cyclist:
    """A rider and the paint of the bicycle."""

    rider: Person = field(default_factory=Person)
    paint: str = "bicycle black"

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Cyclist:
        """Return one by chance."""
        rider = Person.drawn(rng)
        return cls(rider, tuple(PAINTS)[int(rng.integers(len(PAINTS)))])

    @property
    def hip_m(self) -> Point:
        """The place of the hips on the line of the seat tube, where legs reach each pedal."""
        reach_m = STRETCHED * (THIGH + SHANK) * self.rider.height_m - CRANK_M
        from_orbit = np.subtract(BRACKET_M, self._orbit_m)
        along = float(from_orbit @ SEAT_TUBE)
        saddle_m = -along + math.sqrt(along**2 - float(from_orbit @ from_orbit) + reach_m**2)
        return BRACKET_M[0] + saddle_m * SEAT_TUBE[0], BRACKET_M[1] + saddle_m * SEAT_TUBE[1]

    @property
    def pedal_y_m(self) -> float:
        """Distance of the pedals from the middle; they are below the hips."""
        return HIP_APART * self.rider.height_m

    @property
    def _orbit_m(self) -> Point:
        """The middle of the circle that an ankle moves on."""
        return BRACKET_M[0] - BALL_M, BRACKET_M[1] + PEDAL_THICK_M / 2 + self._ankle_m

    @property
    def _ankle_m(self) -> float:
        return ANKLE * self.rider.height_m

    def pedal_m(self, turned_rad: float, side: int) -> Point:
        """Return where a pedal's axle is; at 0 the left one is lowest."""
        turn = turned_rad + (0.0 if side > 0 else math.pi)
        x, z = BRACKET_M
        return x - CRANK_M * math.sin(turn), z - CRANK_M * math.cos(turn)

    def ankle_m(self, turned_rad: float, side: int) -> Point:
        """Return where an ankle is, the sole being on the pedal."""
        x, z = self.pedal_m(turned_rad, side)
        return x - BALL_M, z + PEDAL_THICK_M / 2 + self._ankle_m


def riding(looks: Cyclist, ridden_m: float) -> dict[BodyPart, F64]:
    """Return person_from_part (4x4) of every part of bicycle and rider after ``ridden_m``."""
    rolled, turned = ridden_m / WHEEL_RADIUS_M, 2 * math.pi * ridden_m / GEAR_M
    found = {
        ("frame", 0): np.eye(4),
        ("wheel", 1): _upright(FRONT_M, -rolled),
        ("wheel", -1): _upright(REAR_M, -rolled),
        ("crank", 0): _upright(BRACKET_M, -turned),
    }
    for side in SIDES:
        x, z = looks.pedal_m(turned, side)
        found["pedal", side] = hinge(x, side * looks.pedal_y_m, z, 0.0)
        found |= _leg(looks, looks.ankle_m(turned, side), side)
    return found | _upper_body(looks)


def _upright(place_m: Point, swing_rad: float) -> F64:
    return hinge(place_m[0], 0.0, place_m[1], swing_rad)


def _leg(looks: Cyclist, ankle_m: Point, side: int) -> dict[BodyPart, F64]:
    size = looks.rider.height_m
    thigh_m, shank_m = THIGH * size, SHANK * size
    thigh, shank = _bent(looks.hip_m, ankle_m, (thigh_m, shank_m), 1)
    x, z = looks.hip_m
    links = ((thigh, thigh_m), (shank, shank_m), (0.0, 0.0))
    return hung(side, ("thigh", "shank", "foot"), (x, side * looks.pedal_y_m, z), links)


def _upper_body(looks: Cyclist) -> dict[BodyPart, F64]:
    """Return the frames of the upper body, which does not move: the hands hold the grips."""
    size, hip = looks.rider.height_m, looks.hip_m
    shoulder, neck = (
        (hip[0] + up * size * math.sin(LEAN_RAD), hip[1] + up * size * math.cos(LEAN_RAD))
        for up in (SHOULDER - HIP, NECK_FOOT)
    )
    found = {("trunk", 0): _upright(hip, -LEAN_RAD), ("head", 0): _upright(neck, -NOD_RAD)}
    lengths = UPPER_ARM * size, (FOREARM + HAND) * size
    upper, lower = _bent(shoulder, _grip_m(looks), lengths, -1)
    links = ((upper, lengths[0]), (lower, 0.0))
    for side in SIDES:
        start = shoulder[0], side * SHOULDER_APART * size, shoulder[1]
        found |= hung(side, ("upper arm", "forearm"), start, links)
    return found


def _grip_m(looks: Cyclist) -> Point:
    return GRIP_M, looks.hip_m[1] + GRIP_UP_M


def _bent(start: Point, end: Point, lengths: tuple[float, float], way: int) -> tuple[float, float]:
    """Return the angles of two limbs between places; ``way`` 1 bends the joint forward, -1 back.

    A limb is stretched towards what it does not reach.
    """
    first, second = lengths
    x, z = end[0] - start[0], end[1] - start[1]
    apart = math.hypot(x, z)
    cosine = (first**2 + apart**2 - second**2) / (2 * first * apart)
    upper = math.atan2(x, -z) + way * math.acos(min(max(cosine, -1.0), 1.0))
    joint_x, joint_z = first * math.sin(upper), -first * math.cos(upper)
    return upper, math.atan2(x - joint_x, joint_z - z)


def cyclist_parts(looks: Cyclist) -> dict[str, tuple[Mesh, ...]]:
    """Return the meshes of each part in its own frame, metres; those of both sides are alike."""
    half = np.array([0.045, 0.05, PEDAL_THICK_M / 2])
    return body_parts(looks.rider) | {
        "frame": tuple(joined(_frame(looks))),
        "wheel": tuple(joined(_wheel())),
        "crank": tuple(joined(_crank(looks.pedal_y_m))),
        "pedal": (boxes(RUBBER, -half, half),),
    }


def _frame(looks: Cyclist) -> list[Mesh]:
    """Return the tubes, the saddle and the handlebars."""
    paint = Surface(looks.paint, Label.BICYCLE)
    hip, grip = looks.hip_m, _grip_m(looks)
    saddle = hip[0], hip[1] - 0.055 * looks.rider.height_m
    cluster = BRACKET_M[0] + 0.5 * SEAT_TUBE[0], BRACKET_M[1] + 0.5 * SEAT_TUBE[1]
    main = [(BRACKET_M, cluster), (BRACKET_M, HEAD_LOW_M), (cluster, HEAD_HIGH_M)]
    found = [_tube(paint, *ends, 0.017) for ends in (*main, (HEAD_LOW_M, HEAD_HIGH_M))]
    for side in SIDES:
        stays = ((BRACKET_M, REAR_M), (cluster, REAR_M), (HEAD_LOW_M, FRONT_M))
        found += [_tube(paint, *ends, 0.010, side * 0.045) for ends in stays]
    stem = (grip[0] + 0.02, grip[1])
    found += [_tube(METAL, *ends, 0.013) for ends in ((cluster, saddle), (HEAD_HIGH_M, stem))]
    wide_m = SHOULDER_APART * looks.rider.height_m + 0.06
    bar = [(grip[0], -wide_m, grip[1]), (stem[0], -0.1, grip[1]), (stem[0], 0.1, grip[1])]
    found.append(tube(METAL, [*bar, (grip[0], wide_m, grip[1])], 0.012, 8))
    return [*found, _saddle(saddle)]


def _tube(surface: Surface, start: Point, end: Point, radius_m: float, y_m: float = 0.0) -> Mesh:
    path = [(start[0], y_m, start[1]), (end[0], y_m, end[1])]
    return tube(surface, path, radius_m, 8)


def _saddle(top_m: Point) -> Mesh:
    x, z = top_m
    sections = [(-0.05, 0.0, 0.02, 0.02), (-0.02, 0.03, 0.13, 0.07), (0.0, 0.03, 0.12, 0.06)]
    closed = [*sections, (0.005, 0.03, 1e-4, 1e-4)]
    return loft(RUBBER, np.add(closed, (z, x, 0.0, 0.0)), 14)


SPOKES = 16


def _wheel() -> list[Mesh]:
    """Return a wheel about the y axis with its middle at the origin: tyre, rim, spokes and hub."""
    turn = np.linspace(0.5 * np.pi, -1.5 * np.pi, 9)
    middle_m = WHEEL_RADIUS_M - TYRE_RADIUS_M
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    tyre = revolved(RUBBER, TYRE_RADIUS_M * circle + (middle_m, 0.0), 36)
    rim = revolved(METAL, 0.011 * circle + (middle_m - 0.022, 0.0), 36)
    hub = tube(METAL, [(0, -0.04, 0), (0, 0.04, 0)], 0.02, 8)
    return [tyre, rim, hub, *(_spoke(i, middle_m - 0.02) for i in range(SPOKES))]


def _spoke(number: int, reach_m: float) -> Mesh:
    angle = 2 * math.pi * number / SPOKES
    cos, sin, y = math.cos(angle), math.sin(angle), 0.03 * (-1) ** number
    path = [(0.02 * cos, y, 0.02 * sin), (reach_m * cos, 0.0, reach_m * sin)]
    return tube(METAL, path, 0.0016, 3)


def _crank(pedal_y_m: float) -> list[Mesh]:
    """Return the chainring on the right and two arms, of which the left one hangs down."""
    ring_y = -0.045
    found = [
        disc(METAL, (0, ring_y, 0), (0, -1, 0), 0.09),
        disc(METAL, (0, ring_y + 0.004, 0), (0, 1, 0), 0.09),
        tube(METAL, [(0, -0.06, 0), (0, 0.06, 0)], 0.02, 8),
    ]
    for side in SIDES:
        end_z = -side * CRANK_M
        low, high = sorted((0.0, end_z))
        y = side * 0.055
        found.append(boxes(METAL, (-0.012, y - 0.006, low), (0.012, y + 0.006, high)))
        axle = [(0, y, end_z), (0, side * (pedal_y_m + 0.05), end_z)]
        found.append(tube(METAL, axle, 0.008, 6))
    return found
