"""Objects that stand in a field of a street: their splats among the street's, drawn together, so
that each hides what is behind it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rfcore.camera import Pose
from rfcore.errors import InvalidInput
from rfcore.field import SplatField
from rfcore.field.similarity import Similarity, moved
from rfcore.raster.gaussians import Gaussians, joined

MOST_SPLATS = 5_000_000
"""Most splats of the objects of one picture: some gigabytes while they are placed."""


@dataclass(frozen=True)
class PlacedObject:
    """A field of splats in the object's own axes, and where it stands."""

    shape: SplatField
    world_from_object: Pose


def with_objects(street: SplatField, objects: Sequence[PlacedObject]) -> SplatField:
    """Return the street with the objects in it, with the same bytes on every machine; without any,
    the street itself.

    Raises ``InvalidInput`` for objects of more than ``MOST_SPLATS`` splats.
    """
    if not objects:
        return street
    count = sum(len(each.shape.gaussians) for each in objects)
    if count > MOST_SPLATS:
        raise InvalidInput(
            "dynamic_objects", f"{count} splats are above {MOST_SPLATS}; ask for fewer objects"
        )
    parts = [street.gaussians]
    parts += [moved(each.shape.gaussians, Similarity(each.world_from_object)) for each in objects]
    bands = max(part.sh.shape[1] for part in parts)
    whole = joined(*(_with_bands(part, bands) for part in parts))
    return SplatField(whole, street.metadata, threads=street.threads, isa=street.isa)


def _with_bands(gaussians: Gaussians, bands: int) -> Gaussians:
    """Return them with coefficients of 0 up to ``bands`` of them."""
    missing = bands - gaussians.sh.shape[1]
    if not missing:
        return gaussians
    return replace(gaussians, sh=np.pad(gaussians.sh, ((0, 0), (0, missing), (0, 0))))
