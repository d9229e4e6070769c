"""Training of a hash grid field from posed pictures (Mueller et al. 2022).

Stochastic descent on the squared error of random pixels, with Adam. A batch has about as many
samples, not rays, in every iteration. The same pictures, points, settings and seed give the same
field to the last bit, whatever the instruction set and the number of threads, and whether or not
the run was interrupted.

The box of the grid holds the cameras and what is near them; the rest of space is contracted.
If a dataset has points, training begins with only the cells near them occupied, which on the sample
street is one cell in twenty.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, TileOrigin
from rfcore.errors import InvalidInput
from rfcore.field import NgpField
from rfcore.field.interface import NGP
from rfcore.geodesy import Anchor
from rfcore.ngp.shape import (
    HashGrid,
    Marching,
    NgpParameters,
    NgpShape,
    Space,
    grid_levels,
    initial_parameters,
)
from rfcore.ngp.trainable import MAX_BLOCK_RAYS, NgpRates, TrainableNgp
from rfcore.train.targets import RaySampler, load_targets
from rfcore.train.trainer import Checkpoint, FieldTrainer, HeldOut, settings_of
from rfcore.views import PointCloud, PosedPicture

MARGIN_SHARE = 0.01
"""Margin around the points in the box, as a share of its longest side."""
KEPT_SHARE = 0.995
"""Share of the points near the cameras that lies in the box, along each axis and side."""
SAMPLE = 8192
"""Points that are used to find how far surfaces are from the cameras."""

F64 = NDArray[np.float64]
Cells = tuple[int, int, int]


def space_around(cameras: Sequence[Camera], points: PointCloud | None) -> Space:
    """Return an unbounded space whose box holds the cameras and the nearer half of the points.

    Without points: the cameras, and what lies before them as far as they lie apart.
    """
    if not cameras:
        raise InvalidInput("cameras", "at least one is needed to place a field")
    centres = np.array([camera.world_from_cam.translation_m for camera in cameras])
    corners = _looked_at(cameras, centres) if points is None else _near(centres, points)
    low, high = (np.percentile(corners, 100 * share, axis=0) for share in _shares(points))
    low, high = np.minimum(low, centres.min(axis=0)), np.maximum(high, centres.max(axis=0))
    margin = max(MARGIN_SHARE * float((high - low).max()), 1e-3)
    half, centre = (high - low) / 2 + margin, (high + low) / 2
    return Space(_triple(centre), _triple(half), unbounded=True)


def _shares(points: PointCloud | None) -> tuple[float, float]:
    return (0.0, 1.0) if points is None else (1 - KEPT_SHARE, KEPT_SHARE)


def _looked_at(cameras: Sequence[Camera], centres: F64) -> F64:
    """Return points in front of the cameras, at half and all of the radius of their positions."""
    axes = np.array([camera.world_from_cam.rotation_matrix() for camera in cameras])[:, :, 2]
    radius = np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()
    reach_m = max(float(radius), 1.0)
    return np.concatenate([centres + 0.5 * reach_m * axes, centres + reach_m * axes])


def _near(centres: F64, points: PointCloud) -> F64:
    """Return the points no farther from the cameras' box than half of them are from a camera."""
    xyz = points.xyz_m.astype(np.float64)
    if not len(xyz):
        raise InvalidInput("points", "there are none; leave them out")
    some = xyz[:: max(1, len(xyz) // SAMPLE)]
    reach_m = np.median([np.sqrt(((centres - p) ** 2).sum(axis=1).min()) for p in some])
    low, high = centres.min(axis=0) - reach_m, centres.max(axis=0) + reach_m
    inside = ((xyz >= low) & (xyz <= high)).all(axis=1)
    return xyz[inside] if inside.any() else xyz


def _triple(values: F64) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return (x, y, z)


def occupancy_cells(space: Space, budget: int) -> Cells:
    """Return cells along x, y, z: about ``budget`` in all, as long as wide in the box."""
    volume = math.prod(space.aspect)
    along_longest = (budget / volume) ** (1 / 3)
    x, y, z = (max(8, round(along_longest * share)) for share in space.aspect)
    return (x, y, z)


def cells_near(space: Space, cells: Cells, points: PointCloud) -> NDArray[np.bool_]:
    """Return [X Y Z], x fastest: whether a cell or one of its 26 neighbours holds a point."""
    x = (points.xyz_m.astype(np.float64) - space.centre_m) / space.half_m
    outside = np.maximum(np.abs(x).max(axis=1, keepdims=True), 1.0)
    u = 0.5 + 0.25 * (2 - 1 / outside) * x / outside
    at = np.minimum((u * cells).astype(np.int64), np.array(cells) - 1)
    grid = np.zeros((cells[2] + 2, cells[1] + 2, cells[0] + 2), bool)
    grid[at[:, 2] + 1, at[:, 1] + 1, at[:, 0] + 1] = True
    for axis in range(3):
        grid |= np.roll(grid, 1, axis) | np.roll(grid, -1, axis)
    return np.ascontiguousarray(grid[1:-1, 1:-1, 1:-1]).ravel()


BLOCKS = 16
"""Tasks of a batch; their number affects the result, since sums are made block by block."""
MAX_SAMPLES = 8192
"""Most samples of a block: twice its average."""
REBUILD_EVERY = 64
"""Iterations after which the occupied cells are found anew."""
FIRST_SAMPLES_PER_RAY = 64.0
FIRST_PEAK = 2.0
"""First peak of a cell, times the threshold: a dozen visits must find it empty to drop it."""
BLIND_SHARE = 1 / 15
"""Share of the occupancy's cells without points, when all cells start occupied and need visits."""


@dataclass(frozen=True)
class NgpModel:
    """The size of a field: L, T, N_min and N_max as in the paper."""

    L: int = 16
    log2_T: int = 18
    N_min: int = 16
    N_max: int = 4096
    """Cells along the longest side of the contracted space, of which the box is half."""
    hidden: int = 32
    occupancy: int = 30_000_000
    """Approximate number of cells of the occupancy grid. With N_max 4096 and 64 steps, the street's
    held-out drive is at 23.3 dB after 1000 iterations instead of 23.0 dB with 2048, 8 million and
    48."""
    steps_per_doubling: int = 64
    """Steps along a ray until its distance has doubled: with 64 a step is 1.1 % of the distance."""
    near_share: float = 0.008
    """Start of rays, in units of the longest half side of the box."""
    far_share: float = 8.0
    """End of rays, in the same unit."""


@dataclass(frozen=True)
class NgpSchedule:
    """Adam's rate: constant for a while, then falling exponentially."""

    rate: float = 1e-2
    held_share: float = 0.4
    final_factor: float = 0.03
    threshold: float = 0.01
    """Optical thickness of a sample above which its cell is occupied."""

    def __post_init__(self) -> None:
        if not 0 < self.rate <= 1:
            raise InvalidInput("training.rate", f"{self.rate} is outside 0..1")
        if not 0 <= self.held_share < 1:
            raise InvalidInput("training.held_share", f"{self.held_share} is outside 0..1")
        if not 0 < self.final_factor <= 1:
            raise InvalidInput("training.final_factor", f"{self.final_factor} is outside 0..1")
        if not 0 < self.threshold <= 1:
            raise InvalidInput("training.threshold", f"{self.threshold} is outside 0..1")

    def at(self, progress: float) -> NgpRates:
        """Return the rates at ``progress``, 0..1."""
        fall = max(0.0, (progress - self.held_share) / (1.0 - self.held_share))
        rate = self.rate * self.final_factor**fall
        return NgpRates(table=rate, matrices=rate)


@dataclass(frozen=True)
class NgpTrainingConfig:
    """Settings of a training run. ``threads`` and ``isa`` change only the time it takes."""

    iterations: int = 10_000
    batch_samples: int = 65_536
    """Approximate number of samples of an iteration."""
    model: NgpModel = field(default_factory=NgpModel)
    schedule: NgpSchedule = field(default_factory=NgpSchedule)
    threads: int = 1
    isa: str | None = None

    def __post_init__(self) -> None:
        if not 1 <= self.iterations <= 1_000_000:
            raise InvalidInput("training.iterations", f"{self.iterations} is outside 1..1000000")
        most = BLOCKS * MAX_SAMPLES // 2
        if not BLOCKS <= self.batch_samples <= most:
            raise InvalidInput(
                "training.batch_samples", f"{self.batch_samples} is outside {BLOCKS}..{most}"
            )


@dataclass(frozen=True)
class _Groups:
    """The groups of parameters that may diverge."""

    table: NDArray[np.float32]
    matrices: NDArray[np.float32]


class NgpTrainer(FieldTrainer):
    """One training run.

    ``points``, where there are any, say which cells can be occupied. Every picture is read into
    memory at once. Raises ``InvalidInput`` on settings or no pictures, and ``DatasetError`` on
    pictures that cannot be read.
    """

    kind = NGP

    def __init__(
        self,
        pictures: Sequence[PosedPicture],
        points: PointCloud | None = None,
        config: NgpTrainingConfig | None = None,
        *,
        seed: int = 0,
    ) -> None:
        self.config = config if config is not None else NgpTrainingConfig()
        targets, pictures_digest = load_targets(pictures)
        self._sampler = RaySampler(targets, seed)
        cameras = [target.camera for target in targets]
        shape = _shape(self.config.model, cameras, points)
        initial, peaks = _start(shape, points, self.config.schedule.threshold, seed)
        digest = _training_digest(pictures_digest, points, self.config, seed)
        super().__init__(self.config.iterations, digest, cameras)
        self._samples_per_ray = FIRST_SAMPLES_PER_RAY
        self._trainable = TrainableNgp(
            initial, peaks, threads=self.config.threads, isa=self.config.isa
        )
        self._numbers = initial.table.size + initial.matrices.size
        self._trainable.rebuild_occupancy(self.config.schedule.threshold)

    @property
    def primitives(self) -> int:
        """The number of parameters being learned."""
        return self._numbers

    def field(
        self,
        name: str = "",
        tile_origin: TileOrigin | None = None,
        held_out: HeldOut | None = None,
        anchor: Anchor | None = None,
    ) -> NgpField:
        """Return what has been learnt so far as a field."""
        metadata = self._metadata(name, tile_origin, held_out, anchor=anchor)
        numbers, config = self._trainable.parameters(), self.config
        return NgpField(numbers, metadata, threads=config.threads, isa=config.isa)

    def checkpoint(self) -> Checkpoint:
        """Return the state for ``restore`` of a trainer with the same inputs."""
        values = {"samples_per_ray": self._samples_per_ray, "watch": self._watch.values()}
        state = self._trainable.state()
        return Checkpoint(self.kind, self.training_digest, self.iteration, values, state)

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go on after ``checkpoint``. Raises ``InvalidInput`` when it is of another run."""
        checkpoint.check(self.kind, self.training_digest)
        self._trainable.restore(checkpoint.arrays)
        self._samples_per_ray = float(checkpoint.values["samples_per_ray"])
        self._watch.restore(checkpoint.values["watch"])
        self.iteration = checkpoint.iteration

    def _descend(self, progress: float) -> float:
        """Do one step of Adam on a batch of about ``batch_samples``; return its loss."""
        wanted = int(self.config.batch_samples / BLOCKS / self._samples_per_ray)
        rays = min(max(wanted, 1), MAX_BLOCK_RAYS)
        batch = self._sampler.batch(self.iteration, rays, BLOCKS, MAX_SAMPLES // rays)
        loss = self._trainable.accumulate(batch)
        self._trainable.update(self.config.schedule.at(progress))
        seen = max(self._trainable.samples / (rays * BLOCKS), 1.0)
        self._samples_per_ray += 0.1 * (seen - self._samples_per_ray)
        return loss

    def _after_iteration(self, progress: float) -> None:  # noqa: ARG002 - whatever the progress
        if self.iteration % REBUILD_EVERY == 0:
            self._trainable.rebuild_occupancy(self.config.schedule.threshold)

    def _parameters(self) -> _Groups:
        numbers = self._trainable.parameters()
        return _Groups(numbers.table, numbers.matrices)


def _training_digest(
    pictures: str, points: PointCloud | None, config: NgpTrainingConfig, seed: int
) -> str:
    digest = hashlib.sha256(repr((NGP, pictures, settings_of(config), seed)).encode())
    if points is not None:
        digest.update(points.xyz_m.tobytes())
    return digest.hexdigest()


def _shape(model: NgpModel, cameras: Sequence[Camera], points: PointCloud | None) -> NgpShape:
    space = space_around(cameras, points)
    grid = HashGrid(grid_levels(model.L, model.N_min, model.N_max, space.aspect), model.log2_T)
    budget = model.occupancy if points is not None else round(BLIND_SHARE * model.occupancy)
    cells = occupancy_cells(space, budget)
    return NgpShape(grid, space, _marching(model, space), model.hidden, cells)


def _marching(model: NgpModel, space: Space) -> Marching:
    longest = max(space.half_m)
    return Marching.between(
        model.near_share * longest, model.far_share * longest, model.steps_per_doubling
    )


def _start(
    shape: NgpShape, points: PointCloud | None, threshold: float, seed: int
) -> tuple[NgpParameters, NDArray[np.float32]]:
    """Return the first numbers and peaks."""
    cells = math.prod(shape.occupancy_cells)
    peaks = np.full(cells, FIRST_PEAK * threshold, np.float32)
    if points is not None:
        peaks[~cells_near(shape.space, shape.occupancy_cells, points)] = 0
    nothing = np.zeros(shape.occupancy_words, np.uint32)
    return initial_parameters(shape, nothing, np.random.default_rng(seed)), peaks
