"""Fine-tunes all parameters of a splat field to passes.

Stochastic descent on L1 and D-SSIM, one frame an iteration, starts from the present field. L1 leads
every splat to the median of its observations, so the majority of passes wins. Pixels that the other
passes contradict (``rfcore.update.passes``) are left out: at first compared with the present
field, which decides between two passes in its own light, and from half-way on compared with what
was learnt until then, for another light. Density control splits Gaussians where the gradient stays
large, and removes faded ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput
from rfcore.field import SplatField
from rfcore.field.importance import contributions, most_important_first, reordered
from rfcore.raster.trainable import LearningRates, TrainableRasterizer
from rfcore.train.levels import LevelFitConfig, with_levels
from rfcore.train.schedule import DensityControl, control_density, view_order
from rfcore.update.passes import SeenFrame, both, trusted_pixels

Progress = Callable[[str, int, int], None]
"""Called with the present task, how much of it is done, and how much there is."""
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class FineTuning:
    """Settings of fine-tuning. ``threads`` changes only the time it takes.

    Rates were measured on the benchmark street's dusk drive, 18 of 24 frames learnt, 6 held back,
    with the field of noon (12.4 dB): colours at 5e-3 reach 20.3 dB in 300 iterations, at 2e-2 25.8,
    at 4e-2 28.0; 600 iterations 28.6 dB, 34 s of one core.
    """

    iterations: int = 600
    means: float = 2e-3
    """Rate of the means in metres a step."""
    log_scales: float = 5e-3
    quaternions: float = 1e-3
    opacity: float = 2e-2
    sh_dc: float = 4e-2
    sh_rest: float = 1e-3
    final_factor: float = 0.05
    """Factor on the rates at the end; they fall exponentially."""
    growth: float = 0.02
    """Most growth of the number of Gaussians, as a share."""
    level_iterations: int = 60
    """Iterations of fitting each lower level of detail, if the field has some; 0 leaves
    prefixes."""
    seed: int = 0
    threads: int = 1

    def __post_init__(self) -> None:
        if not 1 <= self.iterations <= 100_000:
            raise InvalidInput("update.iterations", f"{self.iterations} is outside 1..100000")
        if not 0 <= self.growth <= 1:
            raise InvalidInput("update.growth", f"{self.growth} is outside 0..1")

    def rates(self, progress: float) -> LearningRates:
        """Return Adam's rates at ``progress`` 0..1."""
        factor = self.final_factor**progress
        return LearningRates(
            means=self.means * factor,
            log_scales=self.log_scales * factor,
            quaternions=self.quaternions * factor,
            opacity=self.opacity * factor,
            sh_dc=self.sh_dc * factor,
            sh_rest=self.sh_rest * factor,
        )

    def density(self, count: int) -> DensityControl:
        """Return how the set of ``count`` Gaussians grows: in five rounds."""
        limit = count + int(count * self.growth)
        interval = max(1, self.iterations // 10)
        return DensityControl(
            limit=limit, interval=interval, growth=self.growth / 5, start=0.1, stop=0.65
        )


def fine_tuned(
    field: SplatField,
    frames: Sequence[SeenFrame],
    config: FineTuning,
    progress: Progress | None = None,
    *,
    keep_order: bool = False,
) -> SplatField:
    """Return another field with all parameters fine-tuned to ``frames``, uncompressed.

    Its splats are in order of importance. With ``keep_order`` they stay in the field's order, with
    added ones at the end, so that every level of detail draws the same splats as before. Raises
    ``InvalidInput`` without frames or splats.
    """
    if not frames or not field.primitives:
        raise InvalidInput("update", f"{len(frames)} frames, {field.primitives} splats: not enough")
    descent = _Descent(field, frames, config)
    for iteration in range(config.iterations):
        if iteration in (0, config.iterations // 2):
            descent.trust()
        descent.step(iteration)
        if progress is not None:
            progress("fine-tuning", iteration + 1, config.iterations)
    made = descent.field()
    return _finished(made, frames, config, progress, bool(field.levels), keep_order)


class _Descent:
    """The state of fine-tuning."""

    def __init__(self, field: SplatField, frames: Sequence[SeenFrame], config: FineTuning) -> None:
        self._start, self._frames, self._config = field, frames, config
        self._targets = [frame.colour() for frame in frames]
        self._trusted: Sequence[Mask | None] = [None] * len(frames)
        self._order = view_order(len(frames), np.random.default_rng(config.seed))
        self._density = config.density(field.primitives)
        self._rasterizer = TrainableRasterizer(
            field.gaussians, threads=config.threads, antialiased=field.metadata.antialiased
        )
        self._rasterizer.keep_scores(config.growth > 0)

    def trust(self) -> None:
        """Exclude from now on pixels that only single passes show."""
        if len({frame.pass_number for frame in self._frames}) > 1:
            self._trusted = both(self._trusted, trusted_pixels(self.field(), self._frames))

    def step(self, iteration: int) -> None:
        """Do one iteration and density control."""
        number, config = next(self._order), self._config
        progress = iteration / config.iterations
        camera, rates = self._frames[number].camera, config.rates(progress)
        target, trusted = self._targets[number], self._trusted[number]
        rasterizer = self._rasterizer
        if trusted is None:
            rasterizer.iterate(camera, target, rates)
        else:
            shown = rasterizer.forward(camera).colour
            rasterizer.loss(np.where(trusted[..., None], target, shown))
            rasterizer.backward()
            rasterizer.adam_step(rates)
        control_density(rasterizer, self._density, iteration + 1, progress, config.seed)

    def field(self) -> SplatField:
        """Return the present field."""
        metadata = replace(
            self._start.metadata, training_digest="", held_out_psnr_db=None, held_out_ssim=None
        )
        threads = self._config.threads
        return SplatField(self._rasterizer.gaussians(), metadata, threads=threads)


def _finished(
    field: SplatField,
    frames: Sequence[SeenFrame],
    config: FineTuning,
    progress: Progress | None,
    has_levels: bool,
    keep_order: bool,
) -> SplatField:
    """Return the field with ordered splats and its levels of detail."""
    cameras = [frame.camera for frame in frames]
    if has_levels and config.level_iterations:
        levels = LevelFitConfig(iterations=config.level_iterations, threads=config.threads)

        def told(done: int, total: int) -> None:
            if progress is not None:
                progress("levels of detail", done, total)

        return with_levels(field, cameras, levels, told, keep_order=keep_order)
    if keep_order:
        return field
    weights = contributions(
        field.gaussians, cameras, threads=config.threads, antialiased=field.metadata.antialiased
    )
    ordered = reordered(field.gaussians, most_important_first(weights))
    return SplatField(ordered, field.metadata, threads=config.threads)
