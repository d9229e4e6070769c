"""Model people on foot: smooth parts, jointed at hips, knees, shoulders and elbows.

In a person's frame x points forward, y to the left and z up; its origin is on the ground below the
hips. Each part has a frame of its own with the joint as origin, in which a limb hangs down to -z;
turning it by a positive angle about y swings it forward. Lengths are shares of the body's height
after Drillis and Contini (1966), Body Segment Parameters.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from streetgen.classes import Label
from streetgen.geometry.mesh import F64, Colour, Material, Mesh, joined, placed
from streetgen.geometry.solids import Surface, loft

BodyPart = tuple[str, int]
"""A part's name and its side: 1 left, -1 right, 0 in the middle."""
SIDES = (1, -1)
HIP, SHOULDER = 0.530, 0.792
"""Heights of the joints of a standing person."""
HIP_APART, SHOULDER_APART = 0.050, 0.112
"""Distances of the joints from the middle of the body."""
THIGH, SHANK, UPPER_ARM, FOREARM = 0.245, 0.246, 0.186, 0.146
HAND = 0.045
"""Distance from the wrist to the middle of the hand."""
NECK_FOOT = 0.285
"""Distance from the hips up to where the head's part begins."""
ANKLE = 0.039
"""Distance from the ankle down to the sole, which reaches from ``HEEL`` to ``TOE`` along x."""
HEEL, TOE = -0.029, 0.113
POINT = 1e-4
"""Half width of the section that closes a body."""

COATS = {
    "coat black": (0.016, 0.016, 0.018),
    "coat navy": (0.014, 0.024, 0.07),
    "coat red": (0.36, 0.025, 0.02),
    "coat olive": (0.07, 0.075, 0.03),
    "coat sand": (0.42, 0.33, 0.2),
    "coat white": (0.62, 0.62, 0.6),
    "coat yellow": (0.62, 0.42, 0.03),
}
TROUSERS = {
    "trousers black": (0.013, 0.013, 0.014),
    "trousers jeans": (0.03, 0.055, 0.12),
    "trousers grey": (0.10, 0.10, 0.105),
    "trousers beige": (0.32, 0.25, 0.16),
}
SKINS = {
    "skin light": (0.55, 0.33, 0.24),
    "skin tan": (0.33, 0.18, 0.11),
    "skin dark": (0.09, 0.045, 0.03),
}
HAIRS = {
    "hair black": (0.012, 0.010, 0.009),
    "hair brown": (0.055, 0.03, 0.016),
    "hair fair": (0.35, 0.24, 0.11),
    "hair grey": (0.36, 0.35, 0.34),
}
SHOES: Mapping[str, Colour] = {"shoes": (0.025, 0.022, 0.02)}
MATERIALS = tuple(
    Material(name, colour)
    for colours in (COATS, TROUSERS, SKINS, HAIRS, SHOES)
    for name, colour in colours.items()
)


def person_materials() -> tuple[Material, ...]:
    """Return all materials of all people; the same objects at each call."""
    return MATERIALS


@dataclass(frozen=True)
class Person:
    """A person's height and the names of the materials of skin, hair and clothes."""

    height_m: float = 1.72
    coat: str = "coat navy"
    trousers: str = "trousers jeans"
    skin: str = "skin light"
    hair: str = "hair brown"

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Person:
        """Return a grown-up by chance: 1.72 m tall with a standard deviation of 9 cm."""
        height_m = float(np.clip(rng.normal(1.72, 0.09), 1.5, 1.98))
        names = (tuple(colours) for colours in (COATS, TROUSERS, SKINS, HAIRS))
        return cls(height_m, *(found[int(rng.integers(len(found)))] for found in names))


TRUNK = (
    *(
        (-0.080, 0.0, 0.072, 0.100),
        (-0.030, 0.0, 0.066, 0.096),
        (0.000, 0.0, 0.067, 0.097),
        (0.060, 0.0, 0.062, 0.088),
    ),
    *((0.130, 0.004, 0.066, 0.094), (0.200, 0.006, 0.067, 0.106), (0.250, 0.002, 0.055, 0.110)),
    *((0.278, -0.002, 0.038, 0.082), (0.292, -0.004, 0.028, 0.042), (0.298, -0.004, 0.024, 0.026)),
)
"""Sections of the coat above the hips: height, middle along x, half widths along x and y."""
SEAT = ((-0.075, 0.0, POINT, POINT), (-0.06, 0.0, 0.04, 0.055), (-0.02, 0.0, 0.064, 0.092))
NECK = ((0.270, -0.004, 0.03, 0.03), (0.350, 0.004, 0.03, 0.03))
SHOE = (
    *((-0.039, 0.042, POINT, POINT), (-0.0385, 0.042, 0.071, 0.024), (-0.030, 0.042, 0.073, 0.027)),
    *((-0.014, 0.026, 0.054, 0.025), (0.010, 0.004, 0.030, 0.022), (0.030, 0.0, 0.022, 0.02)),
)


def body_parts(looks: Person) -> dict[str, tuple[Mesh, ...]]:
    """Return the meshes of each part in its own frame, metres; those of both sides are alike.

    The ``trunk`` begins at the middle of the hips, the ``head`` at the neck's foot.
    """
    coat, trousers, skin, hair, shoes = (
        Surface(name, Label.PERSON)
        for name in (looks.coat, looks.trousers, looks.skin, looks.hair, "shoes")
    )
    shares = {
        "trunk": [loft(coat, TRUNK, 16), loft(trousers, SEAT, 16)],
        "head": _head(skin, hair),
        "upper arm": [_limb(coat, UPPER_ARM, 0.031, 0.025)],
        "forearm": [
            _limb(coat, FOREARM, 0.025, 0.019),
            _ball(skin, (0.004, -FOREARM - HAND), (0.026, 0.014, 0.05)),
        ],
        "thigh": [_limb(trousers, THIGH, 0.054, 0.037)],
        "shank": [_limb(trousers, SHANK, 0.037, 0.025)],
        "foot": [loft(shoes, SHOE, 16)],
    }
    size = np.diag([looks.height_m] * 3 + [1.0])
    return {
        name: tuple(joined([placed(mesh, size) for mesh in meshes]))
        for name, meshes in shares.items()
    }


def _head(skin: Surface, hair: Surface) -> list[Mesh]:
    """Return the neck, the head over it, and hair over its crown and back."""
    neck = np.array(NECK) - (NECK_FOOT, 0.0, 0.0, 0.0)
    return [
        loft(skin, neck),
        _ball(skin, (0.012, 0.116), (0.057, 0.047, 0.068)),
        _ball(hair, (-0.005, 0.132), (0.055, 0.051, 0.053)),
    ]


def _limb(surface: Surface, length: float, radius: float, end_radius: float) -> Mesh:
    """Return a cone from the joint down, with round ends about the joint and the next one."""
    turn = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 9)
    low, high = turn[:5], turn[4:]
    heights = [end_radius * np.sin(low) - length, radius * np.sin(high)]
    radii = [end_radius * np.cos(low), radius * np.cos(high)]
    z, r = (np.concatenate(values) for values in (heights, radii))
    r = np.maximum(r, POINT)
    return loft(surface, np.stack([z, 0 * z, r, r], axis=1))


def _ball(surface: Surface, middle: tuple[float, float], radii: tuple[float, float, float]) -> Mesh:
    """Return an ellipsoid about (x, z) with radii along x, y and z."""
    turn = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 11)
    wide = np.maximum(np.cos(turn), 1e-3)
    (x, z), (rx, ry, rz) = middle, radii
    return loft(
        surface, np.stack([z + rz * np.sin(turn), x + 0 * turn, rx * wide, ry * wide], axis=1)
    )


def hinge(x_m: float, y_m: float, z_m: float, swing_rad: float) -> F64:
    """Return 4x4: a frame at a place, turned about y so that what hangs in it swings forward."""
    cos, sin = np.cos(swing_rad), np.sin(swing_rad)
    return np.array([[cos, 0, -sin, x_m], [0, 1, 0, y_m], [sin, 0, cos, z_m], [0, 0, 0, 1.0]])


FRONT_RAD, BACK_RAD = 0.54, 0.32
"""Angles of a thigh's swing before and behind the body at a walk of 1.4 m/s."""
STANDING_BEND_RAD, SWINGING_BEND_RAD = 0.06, 0.95
"""Angle of a knee on the ground, and the addition in the middle of its swing forward."""
ARM_RAD, ELBOW_RAD = 0.38, 0.30


def stride_m(looks: Person, swing: float) -> float:
    """Return the length of two steps; ``swing`` 1 is a walk of 1.4 m/s, 0 is standing."""
    leg_m = (THIGH + SHANK) * looks.height_m
    return 2 * leg_m * (math.sin(FRONT_RAD * swing) + math.sin(BACK_RAD * swing))


def walking(looks: Person, phase_rad: float, swing: float) -> dict[BodyPart, F64]:
    """Return person_from_part (4x4) of every part; a stride is 2 pi of phase, and repeats.

    The left thigh is farthest forward at phase 0. Feet do not go below the ground, and one at least
    is on it: the hips are as high as the lower foot has them.
    """
    legs = {side: _leg(phase_rad + (np.pi if side < 0 else 0.0), swing) for side in SIDES}
    hip = -min(_lowest(*angles) for angles in legs.values())
    size = looks.height_m
    found = _trunk(hip * size, size)
    for side, (thigh, shank) in legs.items():
        found |= hung(
            side,
            ("thigh", "shank", "foot"),
            (0.0, side * HIP_APART * size, hip * size),
            ((thigh, THIGH * size), (shank, SHANK * size), (shank, 0.0)),
        )
        phase = phase_rad + (np.pi if side > 0 else 0.0)
        arm = swing * ARM_RAD * float(np.cos(phase))
        found |= hung(
            side,
            ("upper arm", "forearm"),
            (0.0, side * SHOULDER_APART * size, (hip + SHOULDER - HIP) * size),
            ((arm, UPPER_ARM * size), (arm + (0.2 + 0.8 * swing) * ELBOW_RAD, 0.0)),
        )
    return found


def _trunk(hip_m: float, size_m: float) -> dict[BodyPart, F64]:
    return {
        ("trunk", 0): hinge(0.0, 0.0, hip_m, 0.0),
        ("head", 0): hinge(0.0, 0.0, hip_m + NECK_FOOT * size_m, 0.0),
    }


def hung(
    side: int,
    names: Iterable[str],
    start_m: tuple[float, float, float],
    links: Iterable[tuple[float, float]],
) -> dict[BodyPart, F64]:
    """Return the frames of a chain of limbs from its first joint: of each its angle and length (m).

    Angles are against the vertical, positive forward.
    """
    found = {}
    x, y, z = start_m
    for name, (angle, length) in zip(names, links, strict=True):
        found[name, side] = hinge(x, y, z, angle)
        x, z = x + length * float(np.sin(angle)), z - length * float(np.cos(angle))
    return found


def _leg(phase_rad: float, swing: float) -> tuple[float, float]:
    """Return the angles of thigh and shank against the vertical.

    From 0 to pi the foot is on the ground and stays there: the ankle moves back at the speed that
    the body moves forward. From pi to 2 pi the leg swings forward with a bent knee.
    """
    turn = phase_rad % (2 * math.pi)
    forward, back = FRONT_RAD * swing, BACK_RAD * swing
    bend = STANDING_BEND_RAD * swing
    if turn < math.pi:
        share = turn / math.pi
        ahead = (1 - share) * math.sin(forward) - share * math.sin(back)
        thigh = math.asin(ahead) + 0.5 * bend
    else:
        thigh = 0.5 * (forward - back + bend + (forward + back) * math.cos(turn))
        bend += SWINGING_BEND_RAD * swing * math.sin(turn) ** 2
    return thigh, thigh - bend


def _lowest(thigh_rad: float, shank_rad: float) -> float:
    """Return the sole's lowest point below the hip as a negative share of the height."""
    knee = -THIGH * np.cos(thigh_rad) - SHANK * np.cos(shank_rad)
    tips = [end * np.sin(shank_rad) - ANKLE * np.cos(shank_rad) for end in (HEEL, TOE)]
    return float(knee + min(tips))
