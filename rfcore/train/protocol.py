"""What a training loop needs of a trainer, whatever it trains.

How well a field shows pictures it was not trained on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import TileOrigin
from rfcore.errors import InvalidInput
from rfcore.field import RadianceField
from rfcore.metrics import psnr, ssim
from rfcore.train.checkpoint import Checkpoint
from rfcore.views import PosedPicture

__all__ = ["FieldTrainer", "HeldOut", "TrainingProgress", "held_out_quality", "mean_psnr_db"]


@dataclass(frozen=True)
class TrainingProgress:
    """What one iteration did: ``iteration`` counts from 1 to ``total``."""

    iteration: int
    total: int
    loss: float


@dataclass(frozen=True)
class HeldOut:
    """Quality on pictures never trained on: means over them of RGB PSNR and SSIM."""

    psnr_db: float
    ssim: float | None = None

    def __post_init__(self) -> None:
        if not math.isfinite(self.psnr_db):
            raise InvalidInput("held_out.psnr_db", f"{self.psnr_db} must be finite")


class FieldTrainer(Protocol):
    """One training run, an iteration at a time."""

    @property
    def kind(self) -> str:
        """``splats`` or ``ngp``."""
        ...

    @property
    def training_digest(self) -> str:
        """SHA-256 of everything the result depends on."""
        ...

    @property
    def iteration(self) -> int:
        """How many iterations have been done."""
        ...

    @property
    def total(self) -> int:
        """How many iterations the settings ask for."""
        ...

    @property
    def primitives(self) -> int:
        """How many Gaussians, or grid entries, are being learned."""
        ...

    @property
    def finished(self) -> bool:
        """Whether every iteration has been done."""
        ...

    def step(self, progress: float | None = None) -> TrainingProgress:
        """Do one iteration; ``progress`` 0..1 replaces the share of iterations done."""
        ...

    def field(
        self,
        name: str = "",
        tile_origin: TileOrigin | None = None,
        held_out: HeldOut | None = None,
    ) -> RadianceField:
        """Return what has been learned so far."""
        ...

    def checkpoint(self) -> Checkpoint:
        """Return what ``restore`` goes on from."""
        ...

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go on after a checkpoint of the same run."""
        ...


def mean_psnr_db(field: RadianceField, pictures: Sequence[PosedPicture]) -> float:
    """Return the mean over pictures of the RGB PSNR of the field's view, clipped to 0..1."""
    _check(pictures)
    return float(np.mean([psnr(*_pair(field, p), peak=1.0) for p in pictures]))


def held_out_quality(field: RadianceField, pictures: Sequence[PosedPicture]) -> HeldOut:
    """Return the means over pictures of RGB PSNR and SSIM of the field's view."""
    _check(pictures)
    pairs = [_pair(field, picture) for picture in pictures]
    return HeldOut(
        psnr_db=float(np.mean([psnr(*pair, peak=1.0) for pair in pairs])),
        ssim=float(np.mean([ssim(*pair, peak=1.0) for pair in pairs])),
    )


def _check(pictures: Sequence[PosedPicture]) -> None:
    if not pictures:
        raise InvalidInput("pictures", "at least one is needed to measure a field")


def _pair(
    field: RadianceField, picture: PosedPicture
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    colour = np.clip(field.render_colour(picture.camera).astype(np.float64), 0.0, 1.0)
    return colour, picture.read() / 255.0
