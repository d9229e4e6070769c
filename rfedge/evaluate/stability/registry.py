"""Every hard case, in the order of the page."""

from __future__ import annotations

from rfedge.evaluate.stability import (
    delta,
    files,
    hash_grids,
    pictures,
    poses,
    splats,
    training,
    warps,
)
from rfedge.evaluate.stability.case import Case

__all__ = ["CASES"]

CASES: tuple[Case, ...] = (
    *splats.CASES,
    *training.CASES,
    *hash_grids.CASES,
    *poses.CASES,
    *pictures.CASES,
    *warps.CASES,
    *delta.CASES,
    *files.CASES,
)
"""Names are unique within a group."""
