"""Position of an object on the ground, from sightings of several moments, places and cameras.

A *sighting* is the direction in which a camera saw the object and, if it saw its foot, the
distance. The two errors differ much: the direction is wrong by pixels, the range by the length of
ground that a pixel covers there, which grows with the square of the distance. Directions that cross
place the object by themselves (parallax). With a camera at c, the unit direction n and its normal
m, time t_i of each sighting, and the object at p with velocity v at the time t of the newest::

    q = p + v (t_i - t) - c
    n . q = range  +- range_sigma,      m . q = 0  +- bearing_sigma * distance,      v = 0  +- SPEED

which is linear least squares for p and v; the distance of a sighting without a range is that of the
last round (Stansfield, Proc. IEE 94 IIIA, 1947). An object stands, v = 0, unless moving explains
its sightings better by ``EVIDENCE``.

A sighting that the others contradict, like that of a camera with a wrong pose, is outvoted: the
worst one is left out while its error is more than ``LIMIT_SIGMAS`` and most remain. Sightings of
one vehicle at one moment share one ``vote``, which also weights their squared errors: they err
together where the vehicle's pose does.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput

SPEED_MPS = 10.0
"""Standard deviation of an object's velocity along each axis."""
EVIDENCE = 4.0
"""Decrease of the sum of squared errors, in sigmas, that shows motion: a standing object, with
errors as stated, is taken for moving in 14 % of cases (chi-square, two degrees of freedom)."""
LIMIT_SIGMAS = 4.0
TIE = 1e-9
"""Relative tolerance of a tie between two halves of the votes: shares are rounded."""
LEAST_TO_MOVE, LEAST_SPAN_S = 3, 0.05
"""Least number of sightings, and least time between the first and the last, for a velocity."""
BEARING_ROUNDS = 6
MOST_SIGMA_M = 1000.0
"""A position that is less certain than this along some direction is no position."""

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Sighting:
    """An object seen from ``eye_m`` (x, y) at ``time_s``.

    ``bearing_rad``: its direction from x towards y; ``range_m``: its distance on the ground, None
    if its foot was not seen; ``vote``: its weight. Raises ``InvalidInput`` for a value that is not
    finite, or a sigma, range or vote that is not above 0.
    """

    time_s: float
    eye_m: tuple[float, float]
    bearing_rad: float
    bearing_sigma_rad: float
    range_m: float | None = None
    range_sigma_m: float = 0.0
    vote: float = 1.0

    def __post_init__(self) -> None:
        given = (self.time_s, *self.eye_m, self.bearing_rad)
        if not all(math.isfinite(value) for value in given):
            raise InvalidInput("sighting", f"time, place and bearing {given} are not all finite")
        if not 0 < self.bearing_sigma_rad < math.inf:
            raise InvalidInput("sighting.bearing_sigma_rad", _not_above_0(self.bearing_sigma_rad))
        if not 0 < self.vote < math.inf:
            raise InvalidInput("sighting.vote", _not_above_0(self.vote))
        if self.range_m is not None:
            for name, value in (("range_m", self.range_m), ("range_sigma_m", self.range_sigma_m)):
                if not 0 < value < math.inf:
                    raise InvalidInput(f"sighting.{name}", _not_above_0(value))


@dataclass(frozen=True, eq=False)
class Placement:
    """Position and velocity of an object at the time of its newest sighting.

    ``covariance_m2``: of the position, [2, 2]; the velocity of a standing object is exactly 0;
    ``outvoted``: indices of the sightings that were left out.
    """

    at_m: tuple[float, float]
    velocity_mps: tuple[float, float]
    covariance_m2: F64
    outvoted: tuple[int, ...]


def placed(sightings: Sequence[Sighting]) -> Placement:
    """Return the placement of an object from its sightings.

    Raises ``InvalidInput`` where there is none: without sightings, and for directions without a
    range that do not cross, or cross behind a camera.
    """
    if not sightings:
        raise InvalidInput("sightings", "there are none; one with a range or two directions place")
    rays = _Rays.of(sightings)
    stands = _majority(rays, moves=False)
    moves = _majority(rays, moves=True) if rays.can_tell_velocity else stands
    best = moves if stands.cost - moves.cost > EVIDENCE else stands
    x_m, y_m, vx_mps, vy_mps = (float(value) for value in best.state)
    left_out = set(range(len(sightings))) - set(best.kept.tolist())
    return Placement((x_m, y_m), (vx_mps, vy_mps), best.covariance_m2, tuple(sorted(left_out)))


@dataclass(frozen=True, eq=False)
class _Rays:
    """Sightings as arrays: ``eye_m``, ``towards``, ``across`` [N, 2], the others [N];
    ``elapsed_s``: since the newest, so at most 0; ``range_m`` NaN where there is none."""

    eye_m: F64
    towards: F64
    across: F64
    elapsed_s: F64
    range_m: F64
    range_sigma_m: F64
    bearing_sigma_rad: F64
    votes: F64

    @staticmethod
    def of(sightings: Sequence[Sighting]) -> _Rays:
        times_s = np.array([each.time_s for each in sightings])
        bearings = np.array([each.bearing_rad for each in sightings])
        ranges = [math.nan if each.range_m is None else each.range_m for each in sightings]
        cos, sin = np.cos(bearings), np.sin(bearings)
        return _Rays(
            np.array([each.eye_m for each in sightings], np.float64),
            np.stack([cos, sin], axis=1),
            np.stack([-sin, cos], axis=1),
            times_s - times_s.max(),
            np.array(ranges, np.float64),
            np.array([each.range_sigma_m for each in sightings], np.float64),
            np.array([each.bearing_sigma_rad for each in sightings], np.float64),
            np.array([each.vote for each in sightings], np.float64),
        )

    def __getitem__(self, chosen: NDArray[np.intp]) -> _Rays:
        return _Rays(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))

    @property
    def can_tell_velocity(self) -> bool:
        """Whether there are enough sightings over time."""
        return len(self.elapsed_s) >= LEAST_TO_MOVE and self.elapsed_s.min() <= -LEAST_SPAN_S


@dataclass(frozen=True, eq=False)
class _Fit:
    """A fit: x, y and velocity [4] at the newest time; ``off``: error of each kept sighting, in
    sigmas."""

    state: F64
    covariance_m2: F64
    off: F64
    cost: float
    kept: NDArray[np.intp]


def _majority(rays: _Rays, *, moves: bool) -> _Fit:
    """Return the fit to the sightings that agree with it, at least most of them."""
    kept, total = np.arange(len(rays.votes)), float(rays.votes.sum())
    while True:
        fit = _fitted(rays[kept], kept, moves=moves)
        worst = int(np.argmax(fit.off))
        left = float(np.delete(rays.votes[kept], worst).sum())
        if fit.off[worst] <= LIMIT_SIGMAS or 2 * left <= total * (1 + TIE):
            break
        kept = np.delete(kept, worst)
    if np.isinf(fit.off).any():
        raise InvalidInput("sightings", "their directions cross behind a camera")
    return _Fit(
        fit.state,
        fit.covariance_m2,
        fit.off,
        fit.cost + LIMIT_SIGMAS**2 * (total - float(rays.votes[kept].sum())),
        kept,
    )


def _fitted(rays: _Rays, kept: NDArray[np.intp], *, moves: bool) -> _Fit:
    """Return the least-squares fit to these sightings."""
    seen = ~np.isnan(rays.range_m)
    distance_m = np.where(seen, rays.range_m, 1.0)
    for _ in range(1 if seen.all() else BEARING_ROUNDS):
        terms, sides = _equations(rays, seen, distance_m, moves=moves)
        normal = terms.T @ terms
        if np.linalg.eigvalsh(normal)[0] * MOST_SIGMA_M**2 < 1:
            raise InvalidInput(
                "sightings",
                f"of {len(kept)} sightings none has a range, and their directions do not cross",
            )
        state = np.zeros(4)
        state[: terms.shape[1]] = np.linalg.solve(normal, terms.T @ sides)
        at_m = state[:2] + rays.elapsed_s[:, None] * state[2:] - rays.eye_m
        along_m = (at_m * rays.towards).sum(axis=1)
        distance_m = np.where(seen, rays.range_m, np.maximum(np.linalg.norm(at_m, axis=1), 0.1))
    errors = terms @ state[: terms.shape[1]] - sides
    squares = (errors[: len(kept)] ** 2 + errors[len(kept) : 2 * len(kept)] ** 2) / rays.votes
    off = np.where(~seen & (along_m <= 0), np.inf, np.sqrt(squares))
    covariance = np.asarray(np.linalg.inv(normal)[:2, :2], np.float64)
    return _Fit(state, covariance, off, float((errors**2).sum()), kept)


def _equations(
    rays: _Rays, seen: NDArray[np.bool_], distance_m: F64, *, moves: bool
) -> tuple[F64, F64]:
    """Return terms [2 N, 2] for what stands, [2 N + 2, 4] for what moves, and the right sides: all
    in sigmas; along the directions first, then across, then the velocity's own."""
    weight = np.sqrt(rays.votes)
    along = np.where(seen, weight / np.where(seen, rays.range_sigma_m, 1.0), 0.0)
    across = weight / (rays.bearing_sigma_rad * distance_m)
    terms = np.concatenate([rays.towards * along[:, None], rays.across * across[:, None]])
    ranges_m = np.where(seen, rays.range_m, 0.0) + (rays.towards * rays.eye_m).sum(axis=1)
    sides = np.concatenate([ranges_m * along, (rays.across * rays.eye_m).sum(axis=1) * across])
    if not moves:
        return terms, sides
    elapsed_s = np.tile(rays.elapsed_s, 2)[:, None]
    own = np.concatenate([np.zeros((2, 2)), np.eye(2) / SPEED_MPS], axis=1)
    terms = np.concatenate([np.concatenate([terms, terms * elapsed_s], axis=1), own])
    return terms, np.concatenate([sides, np.zeros(2)])


def _not_above_0(value: float) -> str:
    return f"{value:g} is not a number above 0"
