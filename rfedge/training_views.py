"""Which pictures a run trains on, which are held out, and which points it starts from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rfcore.dataset import Dataset, Distortion, read_dataset
from rfcore.dataset.assemble import localised
from rfcore.dataset.points import read_points
from rfcore.errors import InvalidInput
from rfcore.views import PosedPicture
from rfedge.training_depth import points_from_depth_maps

__all__ = ["ViewChoice", "read_views", "share_of_views", "split_every"]


@dataclass(frozen=True)
class ViewChoice:
    """What to read. ``held_out`` is another dataset, ``holdout`` every so many of this one."""

    dataset: Path
    held_out: Path | None = None
    holdout: int | None = None
    percent: float = 100.0
    """Of the pictures that are not held out."""
    points: Path | None = None
    """A .ply instead of the dataset's own points."""
    depths: Path | None = None
    """A folder of depth maps to take points from instead."""
    size_px: tuple[int, int] | None = None
    undistort: bool = False

    def __post_init__(self) -> None:
        if self.held_out is not None and self.holdout is not None:
            raise InvalidInput("holdout", "goes without --held-out: choose one of the two")
        if self.points is not None and self.depths is not None:
            raise InvalidInput("depths", "goes without --points: choose one of the two")
        if not 0 < self.percent <= 100:
            raise InvalidInput("views_percent", f"{self.percent} is outside 0..100")


def read_views(choice: ViewChoice) -> tuple[Dataset, Dataset | None]:
    """Return what to train on, and what to measure on, around the same origin."""
    distortion = Distortion.UNDISTORT if choice.undistort else Distortion.REFUSE
    dataset = read_dataset(choice.dataset, distortion=distortion, size_px=choice.size_px)
    held_out = None
    if choice.held_out is not None:
        held_out = read_dataset(
            choice.held_out,
            tile_origin=dataset.tile_origin,
            distortion=distortion,
            size_px=choice.size_px,
        )
    elif choice.holdout is not None:
        dataset, held_out = split_every(dataset, choice.holdout)
    if choice.points is not None:
        points = localised(read_points(choice.points), dataset.tile_origin)
        dataset = replace(dataset, points=points)
    dataset = replace(dataset, pictures=share_of_views(dataset.pictures, choice.percent))
    if choice.depths is not None:
        points = points_from_depth_maps(dataset.pictures, choice.depths)
        dataset = replace(dataset, points=points)
    return dataset, held_out


def split_every(dataset: Dataset, every: int) -> tuple[Dataset, Dataset]:
    """Return the dataset without every ``every``-th picture, the first among them, and those.

    The convention of mip-NeRF 360 and of 3DGS (``llffhold``).
    """
    if not 2 <= every <= len(dataset.pictures):
        raise InvalidInput("holdout", f"{every} is outside 2..{len(dataset.pictures)}")
    kept = tuple(picture for i, picture in enumerate(dataset.pictures) if i % every)
    held_out = dataset.pictures[::every]
    return replace(dataset, pictures=kept), replace(dataset, pictures=held_out)


def share_of_views(pictures: Sequence[PosedPicture], percent: float) -> tuple[PosedPicture, ...]:
    """Return ``percent`` of the pictures, at least one, spread evenly over all of them."""
    count = max(1, round(len(pictures) * percent / 100))
    return tuple(pictures[i * len(pictures) // count] for i in range(count))
