"""Training of radiance fields from posed pictures."""

from rfcore.train.evaluation import mean_psnr_db
from rfcore.train.schedule import RateSchedule
from rfcore.train.splats import SplatTrainer, SplatTrainingConfig, TrainingProgress

__all__ = [
    "RateSchedule",
    "SplatTrainer",
    "SplatTrainingConfig",
    "TrainingProgress",
    "mean_psnr_db",
]
