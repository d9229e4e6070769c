"""What a training loop needs of a trainer, whatever it trains."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from rfcore.camera import TileOrigin
from rfcore.errors import InvalidInput
from rfcore.field import RadianceField
from rfcore.train.checkpoint import Checkpoint

__all__ = ["FieldTrainer", "HeldOut", "TrainingProgress"]


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
