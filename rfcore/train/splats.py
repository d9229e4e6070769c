"""Training of 3D Gaussians from posed pictures (3DGS, sections 5 and 7.1).

Stochastic descent on L1 and D-SSIM, one view an iteration, with Adam and density control. The same
pictures, start, settings and seed give the same field to the last bit, whatever the instruction
set and the number of threads, and whether or not the run was interrupted.

How far a run is, ``progress``, goes from 0 to 1: by default it is the share of the iterations done;
a run limited by time passes its own, and then repeats itself only as well as its clock does.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import islice, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, TileOrigin
from rfcore.errors import InvalidInput, TrainingDiverged
from rfcore.field import SplatField
from rfcore.field.interface import SPLATS
from rfcore.geodesy import Anchor
from rfcore.raster.gaussians import MAX_GAUSSIANS, Gaussians, joined
from rfcore.raster.trainable import LearningRates, TrainableRasterizer, TrainingState
from rfcore.train.poses import PoseCorrection, PoseModel, pose_gradient, typical_depth_m
from rfcore.train.schedule import (
    Bands,
    DensityControl,
    RateSchedule,
    Regularisation,
    control_density,
    is_order_due,
    view_order,
)
from rfcore.train.start import gaussians_from_points, sky_gaussians
from rfcore.train.targets import ExposureModel, Target, halved, load_targets
from rfcore.train.trainer import Checkpoint, FieldTrainer, HeldOut, settings_of
from rfcore.views import PointCloud, PosedPicture

STATE_PARTS = ("gaussians", "first_moments", "second_moments")
"""Fields of ``TrainingState`` that have the shape of Gaussians."""


@dataclass(frozen=True)
class SplatTrainingConfig:
    """Settings of a training run. ``threads`` and ``isa`` change only the time it takes."""

    gaussians: int = 150_000
    """Most points that are drawn from those given."""
    sky: int = 0
    """Directions, over the whole sphere, in which Gaussians at infinity may be placed."""
    iterations: int = 2000
    initial_scale: float = 0.6
    """Standard deviation at the start, in units of the distance to the three nearest points."""
    rates: RateSchedule = field(default_factory=RateSchedule)
    density: DensityControl = field(default_factory=DensityControl)
    regularisation: Regularisation = field(default_factory=Regularisation)
    bands: Bands = field(default_factory=Bands)
    halved_until: tuple[float, ...] = ()
    """Falling shares of the run until which pictures are halved once, twice and so on: small ones
    cost less and are enough to place Gaussians (DashGaussian, Chen et al. 2025, with fixed
    shares). Of ``(0.5, 0.2)``, the first fifth sees pictures of a quarter of the width and
    height."""
    antialiased: bool = False
    """Train for the antialiased mode; the field's metadata will say so."""
    exposure: bool = False
    """Learn an affine map of colours per picture; the field shows the mean picture."""
    refine_poses: bool = False
    """Learn a correction of every picture's pose; the dataset's poses stay right on average."""
    threads: int = 1
    isa: str | None = None

    def __post_init__(self) -> None:
        if not 1 <= self.gaussians <= MAX_GAUSSIANS:
            raise InvalidInput("training.gaussians", f"{self.gaussians} not in 1..{MAX_GAUSSIANS}")
        if not 0 <= self.sky <= 1_000_000:
            raise InvalidInput("training.sky", f"{self.sky} is outside 0..1000000")
        if not 1 <= self.iterations <= 1_000_000:
            raise InvalidInput("training.iterations", f"{self.iterations} is outside 1..1000000")
        if not 0.01 <= self.initial_scale <= 10:
            raise InvalidInput("training.initial_scale", f"{self.initial_scale} not in 0.01..10")
        shares = (1.0, *self.halved_until, 0.0)
        if not all(first > then for first, then in pairwise(shares)):
            raise InvalidInput("training.halved_until", f"{self.halved_until} do not fall in 0..1")
        if self.refine_poses and self.exposure:
            raise InvalidInput("training.refine_poses", "goes without exposure: learn one of them")


class SplatTrainer(FieldTrainer):
    """One training run.

    ``start`` is the points to start from, or Gaussians to go on with. Every picture is read into
    memory at once. Raises ``InvalidInput`` on settings, too few points or no pictures, and
    ``DatasetError`` on pictures that cannot be read.

    >>> from rfcore.camera import Intrinsics, Pose
    >>> camera = Camera(Intrinsics(32, 24, 30.0, 30.0, 16.0, 12.0), Pose.identity())
    >>> picture = PosedPicture("a.png", camera, lambda: np.full((24, 32, 3), 200, np.uint8))
    >>> xyz_m = np.random.default_rng(0).uniform(-1, 1, (50, 3)).astype(np.float32)
    >>> points = PointCloud(xyz_m + np.float32([0, 0, 4]), np.full((50, 3), 200, np.uint8))
    >>> trainer = SplatTrainer([picture], points, SplatTrainingConfig(iterations=3))
    >>> [progress.iteration for progress in trainer.steps()]
    [1, 2, 3]
    >>> trainer.field("wall").primitives
    50
    """

    kind = SPLATS

    def __init__(
        self,
        pictures: Sequence[PosedPicture],
        start: PointCloud | Gaussians,
        config: SplatTrainingConfig | None = None,
        *,
        seed: int = 0,
    ) -> None:
        self.config = config if config is not None else SplatTrainingConfig()
        self._seed = seed
        self._targets, pictures_digest = load_targets(pictures)
        initial = self._initial(start, np.random.default_rng(seed))
        self._order = view_order(len(self._targets), self._order_rng())
        self._unit_m = float(np.median(np.exp(initial.log_scales.astype(np.float64))))
        digest = _training_digest(pictures_digest, initial, self.config, seed)
        cameras = [target.camera for target in self._targets]
        super().__init__(self.config.iterations, digest, cameras)
        self._sizes = [self._targets]
        for _ in self.config.halved_until:
            self._sizes.append(tuple(halved(target) for target in self._sizes[-1]))
        self._exposure = ExposureModel(len(self._targets)) if self.config.exposure else None
        self._names = [picture.name for picture in pictures]
        self.depth_m = typical_depth_m(initial, cameras)
        self._poses = PoseModel(cameras, self.depth_m) if self.config.refine_poses else None
        self._rasterizer = self._rasterizer_of(initial)
        self._rasterizer.order_along_curve()

    @property
    def primitives(self) -> int:
        """The present number of Gaussians."""
        return len(self._rasterizer)

    def gaussians(self) -> Gaussians:
        """Return the parameters as they are now."""
        return self._rasterizer.gaussians()

    def cameras(self) -> list[Camera]:
        """Return the pictures' cameras as they are now."""
        if self._poses is None:
            return [target.camera for target in self._targets]
        return [self._poses.camera(view) for view in range(len(self._targets))]

    def pose_corrections(self) -> list[PoseCorrection]:
        """Return how far each picture's pose was moved; empty if poses are not refined."""
        return [] if self._poses is None else self._poses.corrections(self._names)

    def field(
        self,
        name: str = "",
        tile_origin: TileOrigin | None = None,
        held_out: HeldOut | None = None,
        anchor: Anchor | None = None,
    ) -> SplatField:
        """Return what has been learnt so far as a field."""
        config = self.config
        metadata = self._metadata(
            name, tile_origin, held_out, anchor=anchor, antialiased=config.antialiased
        )
        return SplatField(self.gaussians(), metadata, threads=config.threads, isa=config.isa)

    def checkpoint(self) -> Checkpoint:
        """Return the state for ``restore`` of a trainer with the same inputs.

        Raises ``TrainingDiverged`` when a parameter is no longer finite.
        """
        try:
            state = self._rasterizer.state()
        except InvalidInput as error:
            group = error.field.split(".")[-1]
            raise TrainingDiverged(self.iteration, group, str(error)) from error
        arrays: dict[str, NDArray[Any]] = {"scores": state.scores}
        for part in STATE_PARTS:
            values = getattr(state, part)
            arrays |= {f"{part}.{f.name}": getattr(values, f.name) for f in fields(values)}
        values = {"beta_powers": list(state.beta_powers), "watch": self._watch.values()}
        for model in self._models_of_pictures():
            arrays |= model.adam.arrays()
        return Checkpoint(self.kind, self.training_digest, self.iteration, values, arrays)

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go on after ``checkpoint``. Raises ``InvalidInput`` when it is of another run."""
        checkpoint.check(self.kind, self.training_digest)
        arrays = checkpoint.arrays
        parts = {
            part: Gaussians(**{f.name: arrays[f"{part}.{f.name}"] for f in fields(Gaussians)})
            for part in STATE_PARTS
        }
        first_power, second_power = checkpoint.values["beta_powers"]
        state = TrainingState(
            **parts, scores=arrays["scores"], beta_powers=(first_power, second_power)
        )
        self._rasterizer = self._rasterizer_of(state.gaussians)
        self._rasterizer.set_optimiser(state)
        for model in self._models_of_pictures():
            model.adam.restore(arrays)
        self._watch.restore(checkpoint.values["watch"])
        self._order = view_order(len(self._targets), self._order_rng())
        for _ in islice(self._order, checkpoint.iteration):
            pass
        self.iteration = checkpoint.iteration

    def _models_of_pictures(self) -> list[ExposureModel | PoseModel]:
        return [model for model in (self._exposure, self._poses) if model is not None]

    def _order_rng(self) -> np.random.Generator:
        return np.random.default_rng([self._seed, 1])

    def _descend(self, progress: float) -> float:
        """Do one step of Adam on the next view; return the loss."""
        view = next(self._order)
        config, target = self.config, self._target(view, progress)
        rates = config.regularisation.added_to(
            config.rates.at(progress, self._unit_m), len(self._rasterizer)
        )
        exposure = self._exposure.of_view(view) if self._exposure is not None else None
        if self._poses is not None:
            return self._descend_with_pose(self._poses, view, rates, progress)
        loss = self._rasterizer.iterate(
            target.camera,
            target.colour(),
            rates,
            sh_degree=config.bands.at(progress),
            exposure=exposure,
            mask=target.mask,
        )
        if self._exposure is not None and exposure is not None:
            self._exposure.step(view, exposure.gradient, config.rates.factor(progress))
        return loss

    def _target(self, view: int, progress: float) -> Target:
        """Return the target picture ``view`` in its present size."""
        return self._sizes[sum(progress < share for share in self.config.halved_until)][view]

    def _descend_with_pose(
        self, poses: PoseModel, view: int, rates: LearningRates, progress: float
    ) -> float:
        """Do one step of Adam on the Gaussians and on the picture's pose; return the loss."""
        target = self._target(view, progress)
        camera = replace(poses.camera(view), intrinsics=target.camera.intrinsics)
        rasterizer = self._rasterizer
        shown = rasterizer.forward(camera, sh_degree=self.config.bands.at(progress)).colour
        loss = rasterizer.loss(target.colour_beside(shown))
        rasterizer.backward()
        centre_m = camera.world_from_cam.translation_m
        gradient = pose_gradient(self.gaussians(), rasterizer.gradients(), centre_m)
        rasterizer.adam_step(rates)
        poses.step(view, gradient, progress)
        return loss

    def _after_iteration(self, progress: float) -> None:
        control = self.config.density
        control_density(self._rasterizer, control, self.iteration, progress, self._seed)
        if is_order_due(control, self.iteration, progress):
            self._rasterizer.order_along_curve()

    def _parameters(self) -> Gaussians:
        return self.gaussians()

    def _initial(self, start: PointCloud | Gaussians, rng: np.random.Generator) -> Gaussians:
        if isinstance(start, Gaussians):
            return start
        config, degree = self.config, self.config.bands.degree
        scale = config.initial_scale
        surfaces = gaussians_from_points(start, config.gaussians, scale, rng, sh_degree=degree)
        if not config.sky:
            return _within(config.density, surfaces)
        sky = sky_gaussians(self._targets, config.sky, scale, sh_degree=degree)
        return _within(config.density, surfaces, sky)

    def _rasterizer_of(self, gaussians: Gaussians) -> TrainableRasterizer:
        config = self.config
        rasterizer = TrainableRasterizer(
            gaussians, threads=config.threads, isa=config.isa, antialiased=config.antialiased
        )
        rasterizer.keep_scores(config.density.limit > 0 and config.density.drawn_by == "gradient")
        return rasterizer


def _within(density: DensityControl, surfaces: Gaussians, *sky: Gaussians) -> Gaussians:
    """Return all as one set; raise ``InvalidInput`` if it exceeds the limit of growth."""
    start = joined(surfaces, *sky) if sky else surfaces
    if 0 < density.limit < len(start):
        beside = f", {len(sky[0])} of them sky" if sky else ""
        raise InvalidInput(
            "density.limit",
            f"{density.limit} Gaussians are fewer than the {len(start)} to start with{beside}: "
            "raise it (--limit) or start with fewer (--gaussians, --sky)",
        )
    return start


def _training_digest(
    pictures: str, initial: Gaussians, config: SplatTrainingConfig, seed: int
) -> str:
    digest = hashlib.sha256(repr((pictures, settings_of(config), seed)).encode())
    for array in fields(initial):
        digest.update(getattr(initial, array.name).data)
    return digest.hexdigest()
