"""Training of radiance fields from posed pictures."""

from rfcore.train.ngp import NgpModel, NgpSchedule, NgpTrainer, NgpTrainingConfig
from rfcore.train.schedule import Bands, DensityControl, RateSchedule, Regularisation
from rfcore.train.splats import SplatTrainer, SplatTrainingConfig
from rfcore.train.trainer import (
    Checkpoint,
    FieldTrainer,
    HeldOut,
    TrainingProgress,
    held_out_quality,
    mean_psnr_db,
    read_checkpoint,
    write_checkpoint,
)

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
