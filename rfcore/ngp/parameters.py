"""The numbers of a hash grid field: the table, five matrices, one bit per cell.

``matrices`` holds W0 [H, E], W1 [16, H] (density: encoding in, log density and 15 more out) and
W2 [H, 32], W3 [H, H], W4 [3, H] (colour: 16 harmonics of the direction and the 16 outputs of the
density network in), row-major, one after the other. No biases (NGP, section 4).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput
from rfcore.native.ngp import table_entries
from rfcore.ngp.shape import FEATURES, NgpShape

__all__ = ["NgpParameters", "initial_parameters", "matrix_shapes"]

OUTPUTS = 16
"""Of the density network."""
HARMONICS = 16
TABLE_RANGE = 1e-4
"""Entries of a new table are uniform in +- this (NGP, section 4)."""

F32 = NDArray[np.float32]
U32 = NDArray[np.uint32]


@dataclass(frozen=True)
class NgpParameters:
    """``table`` [entries, 2], ``matrices`` [weights], float32; ``occupancy`` uint32 words.

    Raises ``InvalidInput`` on a shape or dtype that does not fit ``shape``, or values that are not
    finite. Cell (x, y, z) is bit i % 32 of word i // 32, i = x + X (y + Y z).
    """

    shape: NgpShape
    table: F32
    matrices: F32
    occupancy: U32

    def __post_init__(self) -> None:
        weights = sum(math.prod(s) for s in matrix_shapes(self.shape))
        grid = self.shape.grid
        entries = table_entries(grid.array, grid.T)
        expected = {
            "table": ((entries, FEATURES), np.float32),
            "matrices": ((weights,), np.float32),
            "occupancy": ((self.shape.occupancy_words,), np.uint32),
        }
        for name, (size, dtype) in expected.items():
            array = getattr(self, name)
            if array.shape != size or array.dtype != dtype or not array.flags.c_contiguous:
                raise InvalidInput(
                    f"ngp.{name}",
                    f"{array.dtype} {array.shape} must be contiguous {np.dtype(dtype)} {size}",
                )
        for name in ("table", "matrices"):
            bad = int(np.count_nonzero(~np.isfinite(getattr(self, name))))
            if bad:
                raise InvalidInput(f"ngp.{name}", f"{bad} numbers are not finite")

    def split_matrices(self) -> tuple[F32, ...]:
        """Return the five matrices as views [outputs, inputs]."""
        shapes = matrix_shapes(self.shape)
        ends = np.cumsum([math.prod(shape) for shape in shapes])
        parts = np.split(self.matrices, ends[:-1])
        return tuple(part.reshape(shape) for part, shape in zip(parts, shapes, strict=True))


def matrix_shapes(shape: NgpShape) -> tuple[tuple[int, int], ...]:
    """Return [outputs, inputs] of the five matrices."""
    h = shape.hidden
    return ((h, shape.encoded), (OUTPUTS, h), (h, HARMONICS + OUTPUTS), (h, h), (3, h))


def initial_parameters(shape: NgpShape, occupancy: U32, rng: np.random.Generator) -> NgpParameters:
    """Return what training starts from: a small uniform table, matrices after He et al. 2015."""
    grid = shape.grid
    entries = table_entries(grid.array, grid.T)
    table = (rng.random((entries, FEATURES), dtype=np.float32) * 2 - 1) * np.float32(TABLE_RANGE)
    parts = []
    for outputs, inputs in matrix_shapes(shape):
        limit = np.float32(math.sqrt(6.0 / inputs))
        parts.append((rng.random(outputs * inputs, dtype=np.float32) * 2 - 1) * limit)
    return NgpParameters(shape, table, np.concatenate(parts), occupancy)
