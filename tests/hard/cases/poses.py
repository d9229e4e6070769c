"""Hard poses: magnitudes of UTM and ECEF, half turns, tiny turns, signs. All of it is float64."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

from hard.cases.case import Case, Finding, refusal, statement, within
from rfcore.camera import Camera, Intrinsics, Pose, TileOrigin, Vec3
from rfcore.errors import InvalidInput
from rfcore.motion import interpolated, quaternion_from_vector, rotation_vector

GROUP = "Poses"
HALF = (0.5, 0.5, 0.5, 0.5)
"""A third of a turn about the diagonal: x to y, y to z, z to x, exactly, in any precision."""
ECEF_M = (4_177_123.456, 855_001.789, 4_728_456.123)
EPSILON = 2.0**-52
AXIS = (2.0 / 7.0, -3.0 / 7.0, 6.0 / 7.0)


def _utm_composition() -> Finding:
    """Every number has a finite binary expansion, so the answer is exact."""
    a = Pose((691_608.125, 5_334_759.5, 521.0), HALF)
    b = Pose((-0.25, 12.5, 3.0), HALF)
    got = a.compose(b).translation_m
    want = (691_608.125 + 3.0, 5_334_759.5 - 0.25, 521.0 + 12.5)
    return within(_distance_m(got, want), 0.0, f"{got}")


def _ecef_round_trip() -> Finding:
    pose = Pose(ECEF_M, quaternion_from_vector((0.3, -1.2, 2.0)))
    point = (4_177_200.0, 855_050.0, 4_728_500.0)
    back = pose.inverse().apply(pose.apply(point))
    size = math.hypot(*ECEF_M) + math.hypot(*point)
    return within(_distance_m(back, point), 16 * EPSILON * size, "metres of a point on the globe")


def _tile_origin() -> Finding:
    origin = TileOrigin(691_608.0, 5_334_760.0, 520.0)
    pose = Pose((691_608.015625, 5_334_759.5, 521.25), HALF)
    got = origin.localise(pose).translation_m
    return within(_distance_m(got, (0.015625, -0.5, 1.25)), 0.0, f"{got}")


def _projection_at_ecef() -> Finding:
    """A point 10 m ahead of a camera on the globe lands where it does at the origin."""
    turn = quaternion_from_vector((0.3, -1.2, 2.0))
    k = Intrinsics(640, 360, 320.0, 320.0, 320.0, 180.0)
    here, there = Camera(k, Pose((0.0, 0.0, 0.0), turn)), Camera(k, Pose(ECEF_M, turn))
    point = here.world_from_cam.apply((1.0, -0.5, 10.0))
    far = (point[0] + ECEF_M[0], point[1] + ECEF_M[1], point[2] + ECEF_M[2])
    (u, v, _), (x, y, _) = here.project(point), there.project(far)
    pixels_a_metre = 320.0 / 10.0
    limit = 8 * EPSILON * math.hypot(*ECEF_M) * pixels_a_metre
    return within(math.hypot(u - x, v - y), limit, "px")


def _sign_flip() -> Finding:
    w, x, y, z = quaternion_from_vector((0.3, -1.2, 2.0))
    a, b = Pose(ECEF_M, (w, x, y, z)), Pose(ECEF_M, (-w, -x, -y, -z))
    same = a.rotation_matrix() == b.rotation_matrix() and a.inverse().apply((1, 2, 3)) == (
        b.inverse().apply((1, 2, 3))
    )
    return statement(same, "equal bits", "q and -q differ")


def _log_of_exp(angle_rad: float) -> Finding:
    vector = _along_axis(angle_rad)
    back = rotation_vector(quaternion_from_vector(vector))
    return within(
        _distance_m(back, vector) / angle_rad, 4 * EPSILON, f"|v| = {math.hypot(*back)!r}"
    )


def _half_turn() -> Finding:
    """At exactly pi both signs of the axis are right."""
    back = rotation_vector((0.0, *AXIS))
    want = _along_axis(math.pi)
    flipped = tuple(-value for value in want)
    error = min(_distance_m(back, want), _distance_m(back, (flipped[0], flipped[1], flipped[2])))
    return within(error, 4 * EPSILON * math.pi, f"|v| = {math.hypot(*back)!r}")


def _log_across_pi() -> Finding:
    """A hair beyond pi is the same rotation the other way round."""
    over = rotation_vector(quaternion_from_vector(_along_axis(math.pi + 1e-6)))
    want = _along_axis(-(math.pi - 1e-6))
    return within(_distance_m(over, want), 8 * EPSILON * math.pi, f"|v| = {math.hypot(*over)!r}")


def _no_turn() -> Finding:
    same = rotation_vector((1.0, 0.0, 0.0, 0.0)) == (0.0, 0.0, 0.0)
    exactly = quaternion_from_vector((0.0, 0.0, 0.0)) == (1.0, 0.0, 0.0, 0.0)
    return statement(same and exactly, "exact both ways", "not exact")


def _many_turns() -> Finding:
    """1000 whole turns and a bit: the sine of the library reduces by pi exactly."""
    angle_rad = 1000 * 2 * math.pi + 0.5
    back = rotation_vector(quaternion_from_vector(_along_axis(angle_rad)))
    return within(_distance_m(back, _along_axis(0.5)), 2 * EPSILON * angle_rad, "0.5 rad")


def _composed_long() -> Finding:
    """Ten thousand steps of 36 mrad are 57 turns and what is left of 360 rad."""
    step = Pose((0.0, 0.0, 0.0), quaternion_from_vector(_along_axis(0.036)))
    pose = Pose.identity()
    for _ in range(10_000):
        pose = pose.compose(step)
    norm = math.hypot(*pose.rotation)
    want = _along_axis(math.remainder(360.0, 2 * math.pi))
    error = max(_distance_m(rotation_vector(pose.rotation), want), abs(norm - 1.0))
    return within(error, 10_000 * EPSILON, f"norm {norm!r}")


def _interpolation_takes_the_short_way() -> Finding:
    a = quaternion_from_vector(_along_axis(0.2))
    w, x, y, z = quaternion_from_vector(_along_axis(0.4))
    first, second = Pose(ECEF_M, a), Pose(ECEF_M, (-w, -x, -y, -z))
    middle = interpolated(first, second, 0.5)
    error = _distance_m(rotation_vector(middle.rotation), _along_axis(0.3))
    return within(
        max(error, _distance_m(middle.translation_m, ECEF_M)), 1e-9, "0.3 rad of 0.2..0.4"
    )


def _interpolation_of_a_hair() -> Finding:
    """Between poses 1e-12 rad apart, where a quotient of sines has no digits."""
    first, second = (
        Pose((0.0, 0.0, 0.0), quaternion_from_vector(_along_axis(angle))) for angle in (0.0, 1e-12)
    )
    got = rotation_vector(interpolated(first, second, 0.25).rotation)
    return within(_distance_m(got, _along_axis(0.25e-12)) / 0.25e-12, 1e-14, "relative")


def _matrix_near_half_turn(missing_rad: float) -> Finding:
    pose = Pose((0.0, 0.0, 0.0), quaternion_from_vector(_along_axis(math.pi - missing_rad)))
    rows = [[*row, 0.0] for row in pose.rotation_matrix()]
    back = Pose.from_matrix(rows)
    turn = math.hypot(*rotation_vector(back.inverse().compose(pose).rotation))
    return within(turn, 1e-15, "rad away")


def _nearly_unit() -> Finding:
    stretched = Pose((0.0, 0.0, 0.0), (0.5, 0.5, 0.5, 0.5 + 9e-7))
    r = stretched.rotation_matrix()
    dots = [sum(a * b for a, b in zip(r[i], r[j], strict=True)) for i in range(3) for j in range(3)]
    error = max(abs(dot - (i % 4 == 0)) for i, dot in enumerate(dots))
    return within(error, 8 * EPSILON, "R R^T - 1")


def _not_unit() -> Finding:
    return refusal(lambda: Pose((0, 0, 0), (1.0, 2e-3, 0, 0)), InvalidInput, "norm 1.000002")


def _not_a_number() -> Finding:
    return refusal(
        lambda: Pose((math.nan, 0, 0), (1, 0, 0, 0)), InvalidInput, "translation_m", "nan"
    )


def _mirrored() -> Finding:
    rows = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0]]
    return refusal(lambda: Pose.from_matrix(rows), InvalidInput, "left-handed")


def _along_axis(angle_rad: float) -> Vec3:
    return (angle_rad * AXIS[0], angle_rad * AXIS[1], angle_rad * AXIS[2])


def _distance_m(a: Vec3, b: Vec3) -> float:
    return math.dist(a, b)


def _case(name: str, expected: str, measure: Callable[[], Finding]) -> Case:
    return Case(GROUP, name, expected, measure)


LOG_ANGLES_RAD = (1e-300, 1e-12, 1e-4, 1.0, 3.0, math.pi - 1e-8, math.pi - 1e-12)

CASES = (
    _case("UTM poses composed", "exactly the sum of binary fractions", _utm_composition),
    _case("ECEF pose there and back", "the point, to 16 roundings of its size", _ecef_round_trip),
    _case("tile origin at UTM", "exactly the difference", _tile_origin),
    _case(
        "projection on the globe", "the pixel at the origin, to 8 roundings", _projection_at_ecef
    ),
    _case("quaternion times -1", "the same bits", _sign_flip),
    *(
        _case(
            f"log of exp at {angle:.16g} rad", "the vector, relative", partial(_log_of_exp, angle)
        )
        for angle in LOG_ANGLES_RAD
    ),
    _case("log at exactly pi", "the axis or its opposite, times pi", _half_turn),
    _case("log beyond pi", "the shorter way round", _log_across_pi),
    _case("no turn", "zero and one, exactly", _no_turn),
    _case("1000 turns and 0.5 rad", "0.5 rad", _many_turns),
    _case("10,000 turns of 36 mrad", "360 rad less whole turns, norm 1", _composed_long),
    _case("interpolation to -q", "the shorter way", _interpolation_takes_the_short_way),
    _case("interpolation over 1e-12 rad", "a quarter of it, relative", _interpolation_of_a_hair),
    *(
        _case(
            f"matrix {missing:g} rad before pi",
            "the same rotation",
            partial(_matrix_near_half_turn, missing),
        )
        for missing in (0.0, 1e-9, 1e-4)
    ),
    _case("quaternion of norm 1 + 5e-7", "normalised: an orthogonal matrix", _nearly_unit),
    _case("quaternion of norm 1 + 2e-6", "refused, saying the norm", _not_unit),
    _case("NaN in a pose", "refused, saying where", _not_a_number),
    _case("mirrored matrix", "refused as left-handed", _mirrored),
)
