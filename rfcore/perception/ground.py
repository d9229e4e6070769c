"""The plane of the ground ahead of a camera, from several views of the field along its way.

A field's depth of the road is wrong by decimetres: what stands for the surface is thick, so that
along the road depth is too short (by 1.7 of 17 m on the sample's field), and splats that float
before a camera shorten all of its depths alike. So the field is drawn from places every ``STEP_M``
on the way ahead, as high as the camera, looking down a little, as those looked that it was trained
on: the ground that is ``NEAR_M`` from those places looks neither too near nor, in the mean of many
views, too high. What floats above it raises it, and nothing lowers it: so the plane is the one that
``LOWER`` of its points lie below, by quantile regression (Koenker and Bassett, Regression
Quantiles, 1978; iteratively reweighted least squares). Their median was up to 0.08 m too high on
the sample's field, which is 0.8 m of road at a distance of 16 m; slopes of the ground further away,
whose depth is too short, were 0.8 % where the street is level.

The places lie on a lattice and are drawn once, for whichever camera comes there first. Cameras,
planes and points are in the field's upright frame (``rfcore.vertical``), in which z is up.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, Intrinsics, Pose, Vec3
from rfcore.vertical import Z_UP, upright_from
from rfcore.views import View

STEP_M, STEPS = 4.0, 6
SIDE_STEP_M, HEIGHT_STEP_M, TURN_STEP_RAD = 2.0, 0.1, math.pi / 8
LOOKING_DOWN_RAD = 0.25
WIDTH_PX, HEIGHT_PX, FOCAL_PX = 192, 128, 96.0
"""Size of the views; in one of half that size the depth of a far row mixes metres of road."""
OPAQUE = 0.9
NEAR_M = (3.0, 8.0)
ASIDE_M = 3.5
BELOW_M = (0.8, 3.0)
"""Range of heights below the camera that may be ground."""
NTH = 16
"""Every so-many-th point of a view is kept."""
LEAST_POINTS = 30
LOWER = 0.3
"""With 0.25 to 0.4 the position errors of objects differ little, on the sample's drive and on two
others of other vehicles: at the 95th percentile 0.7 to 1.0, 0.8 to 1.0 and 1.3 to 1.4 m."""
ROUNDS, LEAST_ERROR_M = 12, 0.02
LEVEL_WEIGHT = 1.0
"""Weight of level ground, metres squared for each point: where the ground ahead is short, its slope
is 0."""
MOST_VIEWS = 512

F64 = NDArray[np.float64]
Index = NDArray[np.intp]
LatticePoint = tuple[int, int, int, int]


@dataclass(frozen=True)
class GroundPlane:
    """A plane: ``height_m`` of the ground at ``below`` (x, y), and its slopes along x and y."""

    below: tuple[float, float]
    height_m: float
    slopes: tuple[float, float]

    def heights_m(self, at_m: F64) -> F64:
        """Return the height of the plane at points [N, 2]."""
        return np.asarray(self.height_m + (at_m - self.below) @ np.array(self.slopes))

    def depths_m(self, eye_m: tuple[float, float, float], rays: F64) -> F64:
        """Return the distance of the plane along rays [N, 3] from ``eye_m``, infinite where it is
        not ahead."""
        falls = rays[:, 2] - rays[:, :2] @ np.array(self.slopes)
        above_m = eye_m[2] - self.heights_m(np.array([eye_m[:2]]))[0]
        return np.asarray(np.where(falls < -1e-6, above_m / np.maximum(-falls, 1e-6), np.inf))


class FieldGround:
    """The ground of one field, drawn by ``render`` where it is asked for; ``up``: the field's
    vertical."""

    def __init__(self, render: Callable[[Camera], View], up: Vec3 = Z_UP) -> None:
        self._render = render
        self.up = up
        self._upright_from_field = upright_from(up)
        self._field_from_upright = self._upright_from_field.inverse()
        self._views: OrderedDict[LatticePoint, F64] = OrderedDict()

    def upright(self, camera: Camera) -> Camera:
        """Return a camera of the field in its upright frame."""
        return replace(
            camera, world_from_cam=self._upright_from_field.compose(camera.world_from_cam)
        )

    def in_field(self, point_m: Vec3) -> Vec3:
        """Return a point of the upright frame in the field's axes."""
        return self._field_from_upright.apply(point_m)

    def warm_up(self, at_m: Vec3) -> None:
        """Draw the place nearest to a point of the field, so that the memory for drawing is there
        and the next ones are faster."""
        self._seen(_place_at(*self._upright_from_field.apply(at_m), 0.0))

    def ahead_of(self, camera: Camera) -> GroundPlane | None:
        """Return the ground ahead of an upright camera, ``None`` where the field shows too little
        of it."""
        pose = camera.world_from_cam
        x_m, y_m, z_m = pose.translation_m
        forward = np.array(pose.rotation_matrix())[:, 2]
        heading_rad = math.atan2(forward[1], forward[0])
        step_m = STEP_M * math.cos(heading_rad), STEP_M * math.sin(heading_rad)
        ahead = [
            self._seen(_place_at(x_m + n * step_m[0], y_m + n * step_m[1], z_m, heading_rad))
            for n in range(STEPS)
        ]
        points_m = np.concatenate(ahead)
        return None if len(points_m) < LEAST_POINTS else _plane_above(points_m, LOWER)

    def _seen(self, place: LatticePoint) -> F64:
        """Return points of the ground near a place [N, 3]."""
        seen = self._views.pop(place, None)
        if seen is None:
            seen = self._drawn(place)
            if len(self._views) >= MOST_VIEWS:
                self._views.popitem(last=False)
        self._views[place] = seen
        return seen

    def _drawn(self, place: LatticePoint) -> F64:
        camera, heading_rad = _camera_at(place)
        view = self._render(
            replace(camera, world_from_cam=self._field_from_upright.compose(camera.world_from_cam))
        )
        rows, columns = np.nonzero((view.opacity > OPAQUE) & (view.depth > 0))
        points_m = points_of(camera, rows, columns, view.depth[rows, columns].astype(np.float64))
        away_m = points_m - np.array(camera.world_from_cam.translation_m)
        across = np.array([-math.sin(heading_rad), math.cos(heading_rad)])
        ground = (-away_m[:, 2] > BELOW_M[0]) & (-away_m[:, 2] < BELOW_M[1])
        ground &= np.abs(away_m[:, :2] @ across) < ASIDE_M
        range_m = np.linalg.norm(away_m[:, :2], axis=1)
        ground &= (range_m > NEAR_M[0]) & (range_m < NEAR_M[1])
        return np.asarray(points_m[ground][::NTH])


def rays_of(camera: Camera, rows: Index, columns: Index) -> F64:
    """Return directions of pixel centres in the world [N, 3], 1 long along the optical axis."""
    k = camera.intrinsics
    across, down = (columns + 0.5 - k.cx_px) / k.fx_px, (rows + 0.5 - k.cy_px) / k.fy_px
    turn = np.array(camera.world_from_cam.rotation_matrix())
    return np.asarray(np.stack([across, down, np.ones(len(rows))], axis=1) @ turn.T)


def points_of(camera: Camera, rows: Index, columns: Index, z_m: F64) -> F64:
    """Return the points [N, 3] that pixels show at depths, relative to the tile's origin."""
    eye_m = np.array(camera.world_from_cam.translation_m)
    return np.asarray(rays_of(camera, rows, columns) * z_m[:, None] + eye_m)


def _plane_above(points_m: F64, share: float) -> GroundPlane:
    """Return the plane that a share of points [N, 3] lies below."""
    middle_m = np.median(points_m[:, :2], axis=0)
    heights_m = points_m[:, 2]
    at_m = np.column_stack([np.ones(len(points_m)), points_m[:, :2] - middle_m])
    level = LEVEL_WEIGHT * len(points_m) * np.diag([0.0, 1.0, 1.0])
    fit = np.array([np.quantile(heights_m, share), 0.0, 0.0])
    for _ in range(ROUNDS):
        error_m = heights_m - at_m @ fit
        weight = np.where(error_m > 0, share, 1 - share) / np.maximum(abs(error_m), LEAST_ERROR_M)
        weighted = at_m * weight[:, None]
        fit = np.linalg.solve(weighted.T @ at_m + level, weighted.T @ heights_m)
    height_m, *slopes = (float(value) for value in fit)
    return GroundPlane((float(middle_m[0]), float(middle_m[1])), height_m, (slopes[0], slopes[1]))


def _place_at(x_m: float, y_m: float, z_m: float, heading_rad: float) -> LatticePoint:
    turns = round(math.tau / TURN_STEP_RAD)
    return (
        round(x_m / SIDE_STEP_M),
        round(y_m / SIDE_STEP_M),
        round(z_m / HEIGHT_STEP_M),
        round(heading_rad / TURN_STEP_RAD) % turns,
    )


def _camera_at(place: LatticePoint) -> tuple[Camera, float]:
    """Return the camera of a place of the lattice, and its heading."""
    x_m, y_m = (SIDE_STEP_M * step for step in place[:2])
    heading_rad = TURN_STEP_RAD * place[3]
    cos, sin = math.cos(heading_rad), math.sin(heading_rad)
    level, fall = math.cos(LOOKING_DOWN_RAD), math.sin(LOOKING_DOWN_RAD)
    rows = [
        [sin, -fall * cos, level * cos, x_m],
        [-cos, -fall * sin, level * sin, y_m],
        [0.0, -level, -fall, HEIGHT_STEP_M * place[2]],
    ]
    middle_px = WIDTH_PX / 2, HEIGHT_PX / 2
    intrinsics = Intrinsics(WIDTH_PX, HEIGHT_PX, FOCAL_PX, FOCAL_PX, *middle_px)
    return Camera(intrinsics, Pose.from_matrix(rows)), heading_rad
