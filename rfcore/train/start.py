"""The Gaussians a training run starts from, and points for them when a dataset brings none.

Points come from the dataset, from depth maps, or are drawn at random along the cameras' rays. Each
becomes one isotropic Gaussian, as wide as its neighbourhood (3DGS, section 5.1: the mean distance
to the three nearest neighbours), half opaque, of the point's colour from every side.

Points lie on surfaces, but the sky has none. It gets Gaussians of its own, so far away that they do
not move between pictures (``sky_gaussians``).

Neighbours are found exactly, in a balanced k-d tree whose leaves hold at most ``LEAF_POINTS``
points each: 120,000 points take 0.7 s of one core. Squared distances are float32 sums in the order
x, y, z.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, Intrinsics
from rfcore.errors import InvalidInput
from rfcore.harmonics import SH_DC
from rfcore.image import Rgb
from rfcore.raster.gaussians import SKY_M, Gaussians
from rfcore.train.targets import Target
from rfcore.views import PointCloud, PosedPicture

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


@dataclass(frozen=True)
class RandomStart:
    """Placement of random points along the rays of random pixels.

    Distances are log-uniform between ``nearest`` and ``farthest`` times the distance at which the
    cameras look, or, if their axes do not meet, the distance between cameras. A point is kept if
    ``seen_by`` cameras have it in view.

    Closer or farther points cost decibels on held-out pictures (docs/how-to/training.md): Gaussians
    near a camera that few others see are learned by heart.
    """

    nearest: float = 0.5
    farthest: float = 4.0
    seen_by: int = 6

    def __post_init__(self) -> None:
        if not 0 < self.nearest < self.farthest <= 1e4:
            raise InvalidInput("start.nearest", f"{self.nearest}..{self.farthest} is not a range")
        if self.seen_by < 1:
            raise InvalidInput("start.seen_by", f"{self.seen_by} must be at least 1")


def random_points(
    pictures: Sequence[PosedPicture],
    count: int,
    rng: np.random.Generator,
    start: RandomStart | None = None,
) -> PointCloud:
    """Return ``count`` points in the volume the cameras see, of the colour of their pixel.

    Raises ``InvalidInput`` without pictures or when too few points are seen by enough cameras.
    """
    if not pictures:
        raise InvalidInput("pictures", "at least one is needed to start from")
    start = start if start is not None else RandomStart()
    cameras = [picture.camera for picture in pictures]
    unit_m = looking_distance_m(cameras)
    share = 4 * count // len(pictures) + 1  # about one in four is thrown away, at worst
    drawn = [_along_rays(picture, share, unit_m, start, rng) for picture in pictures]
    xyz_m, rgb = (np.concatenate(parts) for parts in zip(*drawn, strict=True))
    seen = _views_of(xyz_m, cameras) >= min(start.seen_by, len(cameras))
    kept = rng.permutation(np.flatnonzero(seen))[:count]
    if len(kept) < min(count, 100):
        raise InvalidInput("start", f"only {len(kept)} of {len(xyz_m)} points are in common view")
    return PointCloud(xyz_m[kept].astype(np.float32), rgb[kept])


def points_from_depth(camera: Camera, rgb: Rgb, depth_m: F32, step_px: int) -> PointCloud:
    """Return a point for every ``step_px``-th pixel with a depth.

    ``depth_m`` float32 [H, W] is z in the camera, as ``View.depth``; 0 or not finite: unknown.
    """
    k = camera.intrinsics
    shape = (k.height_px, k.width_px)
    if depth_m.shape != shape or rgb.shape[:2] != shape:
        raise InvalidInput("depth", f"{depth_m.shape} and {rgb.shape[:2]} must both be {shape}")
    if step_px < 1:
        raise InvalidInput("step_px", f"{step_px} must be at least 1")
    rows, columns = (np.arange(step_px // 2, side, step_px) for side in shape)
    v, u = (grid.ravel() for grid in np.meshgrid(rows, columns, indexing="ij"))
    z = depth_m[v, u].astype(np.float64)
    known = np.isfinite(z) & (z > 0)
    u, v, z = u[known], v[known], z[known]
    xyz_m = _in_world(camera, np.float64(0.5) + u, np.float64(0.5) + v, z)
    return PointCloud(xyz_m.astype(np.float32), np.ascontiguousarray(rgb[v, u]))


def looking_distance_m(cameras: Sequence[Camera]) -> float:
    """Return the distance from the cameras to the point nearest to all their axes.

    Where that point is behind most of them, or they are one: the cameras' extent, at least 1 m.
    """
    centres = np.array([camera.world_from_cam.translation_m for camera in cameras])
    axes = np.array([camera.world_from_cam.rotation_matrix() for camera in cameras])[:, :, 2]
    extent_m = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    normal = across.sum(axis=0)
    if np.linalg.cond(normal) > 1e6:
        return max(2 * extent_m, 1.0)
    point = np.linalg.solve(normal, (across @ centres[:, :, None]).sum(axis=0))[:, 0]
    ahead = ((point - centres) * axes).sum(axis=1)
    if np.median(ahead) <= 0.1 * extent_m:
        return max(2 * extent_m, 1.0)
    return float(np.median(ahead))


def _along_rays(
    picture: PosedPicture,
    count: int,
    unit_m: float,
    start: RandomStart,
    rng: np.random.Generator,
) -> tuple[F64, NDArray[np.uint8]]:
    k = picture.camera.intrinsics
    u, v = rng.integers(0, k.width_px, count), rng.integers(0, k.height_px, count)
    if (mask := picture.read_mask()) is not None and mask.any():
        rows, columns = np.nonzero(mask)
        chosen = (v * k.width_px + u) % len(rows)
        u, v = columns[chosen], rows[chosen]
    log_z = rng.uniform(np.log(start.nearest), np.log(start.farthest), count)
    xyz_m = _in_world(
        picture.camera, np.float64(0.5) + u, np.float64(0.5) + v, np.exp(log_z) * unit_m
    )
    return xyz_m, picture.read()[v, u]


def _in_world(camera: Camera, u_px: F64, v_px: F64, z_m: F64) -> F64:
    k, pose = camera.intrinsics, camera.world_from_cam
    x, y = (u_px - k.cx_px) / k.fx_px * z_m, (v_px - k.cy_px) / k.fy_px * z_m
    turned = np.column_stack([x, y, z_m]) @ np.array(pose.rotation_matrix()).T
    return np.asarray(turned + np.array(pose.translation_m))


def _views_of(xyz_m: F64, cameras: Sequence[Camera]) -> NDArray[np.int64]:
    """Return how many cameras have each point in view."""
    views = np.zeros(len(xyz_m), np.int64)
    for camera in cameras:
        pose = camera.cam_from_world()
        in_camera = xyz_m @ np.array(pose.rotation_matrix()).T + pose.translation_m
        views += _in_picture(camera.intrinsics, in_camera)[2]
    return views


def _in_picture(k: Intrinsics, in_camera: F64) -> tuple[F64, F64, NDArray[np.bool_]]:
    """Return u and v [N] in px of points in the camera's axes, and which are in the picture."""
    x, y, z = in_camera.T
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = k.fx_px * x / z + k.cx_px, k.fy_px * y / z + k.cy_px
        is_inside = (z > 0) & (u > 0) & (u < k.width_px) & (v > 0) & (v < k.height_px)
    return u, v, is_inside


NEIGHBOURS = 3
MIN_SPACING_M = 1e-3
"""Coincident points have no spacing; this keeps their logarithm finite."""
MAX_SPACING_M = 20.0
"""A stray point far from all others would cover the picture."""
LEAF_POINTS = 16
QUERIES = 4096
"""Points whose neighbours are searched together; their data fits the cache."""


def gaussians_from_points(
    points: PointCloud,
    count: int,
    scale: float,
    rng: np.random.Generator,
    *,
    sh_degree: int = 3,
) -> Gaussians:
    """Return Gaussians on ``count`` points drawn from ``points``, or on all.

    ``scale`` is a Gaussian's standard deviation in units of the distance to its neighbours.
    Raises ``InvalidInput`` for fewer than four points.
    """
    if len(points.xyz_m) <= NEIGHBOURS:
        raise InvalidInput("points", f"{len(points.xyz_m)} are too few, 4 or more are needed")
    chosen = np.sort(rng.permutation(len(points.xyz_m))[:count])
    means = np.ascontiguousarray(points.xyz_m[chosen], dtype=np.float32)
    log_scales = np.log(np.clip(spacing_m(means), MIN_SPACING_M, MAX_SPACING_M) * scale)
    return _balls(means, log_scales, 0.0, points.rgb[chosen], sh_degree)


def _balls(
    means: F32, log_scales: F64, logit: float, rgb: NDArray[np.integer], sh_degree: int
) -> Gaussians:
    """Return isotropic Gaussians of one colour each; ``rgb`` [N, 3] is 0..255."""
    n = len(means)
    sh = np.zeros((n, (sh_degree + 1) ** 2, 3), np.float32)
    sh[:, 0] = (rgb / 255.0 - 0.5) / SH_DC
    return Gaussians(
        means=means,
        quaternions=np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        log_scales=np.repeat(log_scales[:, None].astype(np.float32), 3, axis=1),
        opacity_logits=np.full(n, logit, np.float32),
        sh=sh,
    )


SKY_DISTANCE_M = 10 * SKY_M
"""Distance of the sky: its depth is beyond ``SKY_M`` in every picture of up to 168 degrees."""
SKY_LOGIT = 2.0
SKY_LEVELS = 15
"""Most difference, of 255, between pictures of the same piece of a cloud."""
SKY_BASELINE = 0.1
"""Least distance between agreeing cameras, as a share of the extent of all cameras: cameras at one
place agree about everything."""
DIRECTIONS = 4096
"""Directions that are processed together; their colours in 1000 pictures take 25 MB."""
NOT_SEEN = np.iinfo(np.int16).max


def sky_gaussians(
    targets: Sequence[Target], directions: int, scale: float, *, sh_degree: int = 3
) -> Gaussians:
    """Return Gaussians 100 km away in those of so many directions where pictures agree.

    The directions are spread evenly over the sphere (Fibonacci lattice). A direction is kept if
    more than half of the pictures that see it, from different places, show the same colour. Nearer
    things change by parallax unless they have no texture, like a road; Gaussians behind those are
    kept, too, but hidden. ``scale`` is the standard deviation in units of the distance between
    directions.
    """
    centres_m = np.array([target.camera.world_from_cam.translation_m for target in targets])
    towards = _lattice(directions)
    parts = [
        _agreed_colour(targets, centres_m, towards[first : first + DIRECTIONS])
        for first in range(0, directions, DIRECTIONS)
    ]
    colour, is_kept = (np.concatenate(values) for values in zip(*parts, strict=True))
    means = centres_m.mean(axis=0) + SKY_DISTANCE_M * towards[is_kept]
    width_m = scale * SKY_DISTANCE_M * math.sqrt(4 * math.pi / directions)
    log_scales = np.full(len(means), math.log(width_m))
    return _balls(means.astype(np.float32), log_scales, SKY_LOGIT, colour[is_kept], sh_degree)


def _lattice(count: int) -> F64:
    """Return unit vectors [count, 3], as evenly over the sphere as a spiral can be."""
    turn = np.arange(count) + 0.5
    up = 1 - 2 * turn / count
    azimuth, level = math.pi * (1 + math.sqrt(5)) * turn, np.sqrt(1 - up * up)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), up], axis=1)


def _agreed_colour(
    targets: Sequence[Target], centres_m: F64, towards: F64
) -> tuple[NDArray[np.int16], NDArray[np.bool_]]:
    """Return the median colour [D, 3] in each direction, and whether the pictures agree on it."""
    colours = np.stack([_colours_at_infinity(target, towards) for target in targets])
    is_seen = colours[..., 0] != NOT_SEEN
    seen = is_seen.sum(axis=0)
    middle = np.maximum(seen - 1, 0) // 2
    median = np.take_along_axis(np.sort(colours, axis=0), middle[None, :, None], axis=0)[0]
    agrees = is_seen & (np.abs(colours - median).max(axis=-1) <= SKY_LEVELS)
    all_apart_m = np.linalg.norm(np.ptp(centres_m, axis=0))
    are_apart = _extent_m(centres_m, agrees) > SKY_BASELINE * all_apart_m
    return median, (2 * agrees.sum(axis=0) > seen) & are_apart


def _extent_m(centres_m: F64, is_in: NDArray[np.bool_]) -> F64:
    """Return the diagonal [D] of the box around the centres [V, 3] selected by ``is_in`` [V, D]; 0
    if none is."""
    among = is_in[:, :, None]
    low = np.where(among, centres_m[:, None], np.inf).min(axis=0)
    high = np.where(among, centres_m[:, None], -np.inf).max(axis=0)
    return np.asarray(np.linalg.norm(np.where(high >= low, high - low, 0.0), axis=1))


def _colours_at_infinity(target: Target, towards: F64) -> NDArray[np.int16]:
    """Return the picture's colour [D, 3] in each direction, ``NOT_SEEN`` outside of it."""
    in_camera = towards @ np.array(target.camera.world_from_cam.rotation_matrix())
    u, v, is_inside = _in_picture(target.camera.intrinsics, in_camera)
    colours = np.full(towards.shape, NOT_SEEN, np.int16)
    rows, columns = v[is_inside].astype(np.int64), u[is_inside].astype(np.int64)
    colours[is_inside] = target.rgb[rows, columns]
    if target.mask is not None:
        is_inside[is_inside] = ~target.mask[rows, columns]
        colours[is_inside] = NOT_SEEN
    return colours


def spacing_m(xyz_m: F32) -> NDArray[np.float64]:
    """Return the mean distance [N] of each of N >= 2 points to its three nearest neighbours."""
    tree = _KdTree.of(xyz_m)
    squared = np.concatenate(
        [
            _nearest_squared(tree, first, min(NEIGHBOURS + 1, len(xyz_m)))
            for first in range(0, tree.order.size, QUERIES)
        ]
    )
    spacing = np.empty(tree.order.size)
    spacing[tree.order] = np.sqrt(squared.astype(np.float64))[:, 1:].mean(axis=1)
    return spacing[: len(xyz_m)]


@dataclass(frozen=True)
class _KdTree:
    """N points in L = 2^n leaves of m places; unused places hold a point at infinity.

    ``points`` float32 [L, m, 3]; ``order`` [L m]: the index of the point in a place, N or more if
    unused.
    ``boxes``: lowest and highest corner [2^l, 3] of the nodes of each level l, the root's first.
    """

    points: F32
    order: NDArray[np.int64]
    boxes: tuple[tuple[F32, F32], ...]

    @staticmethod
    def of(xyz_m: F32) -> _KdTree:
        """Build the tree: halve each node at the median of the axis along which it is longest."""
        levels = max(0, math.ceil(math.log2(len(xyz_m) / LEAF_POINTS)))
        places = -(-len(xyz_m) // 2**levels) * 2**levels
        padded = np.full((places, 3), np.inf, np.float32)
        padded[: len(xyz_m)] = xyz_m
        order = np.arange(places)[None]
        for _ in range(levels):
            nodes = padded[order]
            with np.errstate(invalid="ignore"):  # infinity less infinity, in a node without points
                longest = (nodes.max(axis=1) - nodes.min(axis=1)).argmax(axis=1)
            along = np.take_along_axis(nodes, longest[:, None, None], axis=2)[:, :, 0]
            halved = np.argpartition(along, order.shape[1] // 2, axis=1)
            order = np.take_along_axis(order, halved, axis=1).reshape(2 * len(order), -1)
        points = padded[order]
        boxes = [(points.min(axis=1), points.max(axis=1))]
        for _ in range(levels):
            low, high = (corner.reshape(-1, 2, 3) for corner in boxes[-1])
            boxes.append((low.min(axis=1), high.max(axis=1)))
        return _KdTree(points, order.ravel(), tuple(reversed(boxes)))


def _nearest_squared(tree: _KdTree, first: int, count: int) -> F32:
    """Return the ``count`` least squared distances [Q, count], ascending, for Q places from
    ``first`` on: to the point itself, which is 0, and to its neighbours."""
    size = tree.points.shape[1]
    places = np.arange(first, min(first + QUERIES, tree.order.size))
    own, points = places // size, tree.points.reshape(-1, 3)[places]
    least = np.full((len(places), count), np.inf, np.float32)
    in_leaf = _least(_squared(points[:, None], tree.points[own]), count)
    least[:, : in_leaf.shape[1]] = np.sort(in_leaf, axis=1)
    query, leaf = _leaves_within(tree, points, least[:, -1])
    query, leaf = query[leaf != own[query]], leaf[leaf != own[query]]
    found = _least(_squared(points[query, None], tree.points[leaf]), count)
    whose = np.concatenate([np.repeat(np.arange(len(places)), count), query.repeat(found.shape[1])])
    squared = np.concatenate([least.ravel(), found.ravel()])
    ascending = np.lexsort((squared, whose))
    start = np.searchsorted(whose[ascending], np.arange(len(places)))
    return np.asarray(squared[ascending][start[:, None] + np.arange(count)])


def _leaves_within(
    tree: _KdTree, points: F32, squared: F32
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return pairs of a point's index and a leaf whose box is nearer to it than ``squared``."""
    query = np.flatnonzero(np.isfinite(points[:, 0]))
    node = np.zeros(len(query), np.int64)
    reach = squared * np.float32(1 + 1e-5)  # the distance to a box is rounded too
    for low, high in tree.boxes[1:]:
        query, node = query.repeat(2), (2 * node).repeat(2)
        node[1::2] += 1
        at = points[query]
        outside = np.maximum(low[node] - at, 0) + np.maximum(at - high[node], 0)
        near = (outside * outside).sum(axis=1) < reach[query]
        query, node = query[near], node[near]
    return query, node


def _squared(a: F32, b: F32) -> F32:
    """Return squared distances along the last axis; infinite where both are at infinity."""
    with np.errstate(invalid="ignore"):
        x, y, z = np.moveaxis((a - b) ** 2, -1, 0)
    return np.asarray(np.nan_to_num(x + y + z, nan=np.inf, posinf=np.inf))


def _least(values: F32, count: int) -> F32:
    """Return the ``count`` least of each row, or the whole row where it is shorter."""
    count = min(count, values.shape[1])
    return np.asarray(np.partition(values, count - 1, axis=1)[:, :count])
