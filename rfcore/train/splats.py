"""Training of 3D Gaussians from posed pictures and points (3DGS, sections 5.1 and 7.1).

Stochastic descent on L1 and D-SSIM, one view an iteration, with Adam. No density control: the
number of Gaussians is that of the start. The same pictures, points, settings and seed give the
same field to the last bit, whatever the instruction set and the number of threads.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields

import numpy as np

from rfcore.camera import TileOrigin
from rfcore.errors import InvalidInput
from rfcore.field import FieldMetadata, SplatField
from rfcore.raster.gaussians import MAX_GAUSSIANS, Gaussians
from rfcore.raster.native import TrainableRasterizer
from rfcore.train.initialise import gaussians_from_points
from rfcore.train.schedule import RateSchedule, view_order
from rfcore.train.targets import load_targets
from rfcore.views import PointCloud, PosedPicture

__all__ = ["SplatTrainer", "SplatTrainingConfig", "TrainingProgress"]


@dataclass(frozen=True)
class SplatTrainingConfig:
    """How to train. ``threads`` and ``isa`` change how long it takes, nothing else."""

    gaussians: int = 150_000
    """At most as many points are drawn from those given."""
    iterations: int = 1500
    initial_scale: float = 0.6
    """Standard deviation at the start, in units of the distance to the three nearest points."""
    rates: RateSchedule = field(default_factory=RateSchedule)
    threads: int = 1
    isa: str | None = None

    def __post_init__(self) -> None:
        if not 1 <= self.gaussians <= MAX_GAUSSIANS:
            raise InvalidInput("training.gaussians", f"{self.gaussians} not in 1..{MAX_GAUSSIANS}")
        if not 1 <= self.iterations <= 1_000_000:
            raise InvalidInput("training.iterations", f"{self.iterations} is outside 1..1000000")
        if not 0.01 <= self.initial_scale <= 10:
            raise InvalidInput("training.initial_scale", f"{self.initial_scale} not in 0.01..10")


@dataclass(frozen=True)
class TrainingProgress:
    """What one iteration did: ``iteration`` counts from 1 to ``total``."""

    iteration: int
    total: int
    loss: float


class SplatTrainer:
    """One training run.

    ``start`` is the points to start from, or Gaussians to go on with. Every picture is read into
    memory at once. Raises ``InvalidInput`` on settings, too few points or no pictures, and
    ``DatasetError`` on pictures that cannot be read.
    """

    def __init__(
        self,
        pictures: Sequence[PosedPicture],
        start: PointCloud | Gaussians,
        config: SplatTrainingConfig | None = None,
        *,
        seed: int = 0,
    ) -> None:
        self.config = config if config is not None else SplatTrainingConfig()
        self._targets, pictures_digest = load_targets(pictures)
        rng = np.random.default_rng(seed)
        initial = self._initial(start, rng)
        self._order = view_order(len(self._targets), rng)
        self._unit_m = float(np.median(np.exp(initial.log_scales.astype(np.float64))))
        self._digest = self._training_digest(pictures_digest, initial, seed)
        self._done = 0
        self._rasterizer = TrainableRasterizer(
            initial, threads=self.config.threads, isa=self.config.isa
        )

    @property
    def training_digest(self) -> str:
        """SHA-256 of pictures, start, settings and seed, in hex; known before the first step."""
        return self._digest

    @property
    def finished(self) -> bool:
        """Whether every iteration has been done."""
        return self._done >= self.config.iterations

    def step(self) -> TrainingProgress:
        """Do one iteration; raise ``InvalidInput`` when the run is finished."""
        if self.finished:
            raise InvalidInput("training", f"all {self.config.iterations} iterations are done")
        progress = self._done / self.config.iterations
        target = self._targets[next(self._order)]
        rates = self.config.rates.at(progress, self._unit_m)
        loss = self._rasterizer.iterate(target.camera, target.colour(), rates)
        self._done += 1
        return TrainingProgress(self._done, self.config.iterations, loss)

    def steps(self) -> Iterator[TrainingProgress]:
        """Do the iterations that are left, one at a time."""
        while not self.finished:
            yield self.step()

    def gaussians(self) -> Gaussians:
        """Return the parameters as they are now."""
        return self._rasterizer.gaussians()

    def field(
        self,
        name: str = "",
        tile_origin: TileOrigin | None = None,
        held_out_psnr_db: float | None = None,
    ) -> SplatField:
        """Return what has been learnt so far as a field."""
        origin = tile_origin if tile_origin is not None else TileOrigin()
        metadata = FieldMetadata(name, origin, self._digest, held_out_psnr_db)
        return SplatField(
            self.gaussians(), metadata, threads=self.config.threads, isa=self.config.isa
        )

    def _initial(self, start: PointCloud | Gaussians, rng: np.random.Generator) -> Gaussians:
        if isinstance(start, Gaussians):
            return start
        config = self.config
        return gaussians_from_points(start, config.gaussians, config.initial_scale, rng)

    def _training_digest(self, pictures: str, initial: Gaussians, seed: int) -> str:
        """Leave out what does not change the result: threads and instruction set."""
        kept = [f for f in fields(self.config) if f.name not in ("threads", "isa")]
        settings = [(f.name, getattr(self.config, f.name)) for f in kept]
        digest = hashlib.sha256(repr((pictures, settings, seed)).encode())
        for array in fields(initial):
            digest.update(getattr(initial, array.name).data)
        return digest.hexdigest()
