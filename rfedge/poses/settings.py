"""What can be chosen about poses from pictures."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from rfcore.dataset.colmap_model import parameter_count
from rfcore.errors import InvalidInput

__all__ = ["Matching", "PoseSettings", "SharedCamera"]


class Matching(StrEnum):
    """Which pairs of pictures are matched."""

    EXHAUSTIVE = "exhaustive"
    SEQUENTIAL = "sequential"


class SharedCamera(StrEnum):
    """Where the intrinsics of new pictures come from when there is a dataset to register to."""

    DATASET = "dataset"
    ESTIMATE = "estimate"


@dataclass(frozen=True)
class PoseSettings:
    """``max_side_px``: pictures are reduced to it to find features; ``features``: at most so many
    a picture; ``model``: the camera model of new pictures, ``parameters`` its values in COLMAP's
    order where they are known, which are then held; ``seed`` of RANSAC.
    """

    matching: Matching = Matching.EXHAUSTIVE
    camera: SharedCamera = SharedCamera.DATASET
    model: str = "SIMPLE_RADIAL"
    parameters: tuple[float, ...] = ()
    max_side_px: int = 1600
    features: int = 8192
    threads: int = 2
    seed: int = 1

    def __post_init__(self) -> None:
        needed = parameter_count("model", self.model)
        if self.parameters and len(self.parameters) != needed:
            raise InvalidInput(
                "parameters", f"{self.model} has {needed}, not {len(self.parameters)}"
            )
        for name in ("max_side_px", "features", "threads"):
            if getattr(self, name) < 1:
                raise InvalidInput(name, f"{getattr(self, name)} must be at least 1")
