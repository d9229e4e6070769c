"""What can be chosen about poses from pictures."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

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
    a picture; ``model``: the camera model where intrinsics are estimated; ``seed`` of RANSAC.
    """

    matching: Matching = Matching.EXHAUSTIVE
    camera: SharedCamera = SharedCamera.DATASET
    model: str = "SIMPLE_RADIAL"
    max_side_px: int = 1600
    features: int = 8192
    threads: int = 2
    seed: int = 1

    def __post_init__(self) -> None:
        for name in ("max_side_px", "features", "threads"):
            if getattr(self, name) < 1:
                raise InvalidInput(name, f"{getattr(self, name)} must be at least 1")
