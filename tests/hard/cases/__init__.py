"""Hard cases: inputs at the limits of arithmetic, each with what is right and how it is judged.

A module a subject; ``case`` says what a case is, ``page`` makes a result of a run.
"""

from hard.cases import (
    delta,
    files,
    hash_grids,
    pictures,
    poses,
    splats,
    training,
    warps,
)
from hard.cases.case import Case

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
"""Every case, in the order of the page. Names are unique within a group."""
