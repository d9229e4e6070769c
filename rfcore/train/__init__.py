"""Training of radiance fields from posed pictures."""

from rfcore.train.checkpoint import Checkpoint, read_checkpoint, write_checkpoint
from rfcore.train.density import DensityControl
from rfcore.train.ngp import NgpModel, NgpSchedule, NgpTrainer, NgpTrainingConfig
from rfcore.train.protocol import (
    FieldTrainer,
    HeldOut,
    TrainingProgress,
    held_out_quality,
    mean_psnr_db,
)
from rfcore.train.schedule import Bands, RateSchedule, Regularisation
from rfcore.train.splats import SplatTrainer, SplatTrainingConfig

__all__ = [
    "Bands",
    "Checkpoint",
    "DensityControl",
    "FieldTrainer",
    "HeldOut",
    "NgpModel",
    "NgpSchedule",
    "NgpTrainer",
    "NgpTrainingConfig",
    "RateSchedule",
    "Regularisation",
    "SplatTrainer",
    "SplatTrainingConfig",
    "TrainingProgress",
    "held_out_quality",
    "mean_psnr_db",
    "read_checkpoint",
    "write_checkpoint",
]
