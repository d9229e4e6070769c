"""The shape of a hash grid field: levels, networks, the space it covers, the steps along a ray.

Names as in Mueller et al., "Instant Neural Graphics Primitives with a Multiresolution Hash
Encoding", ACM TOG 41(4), 2022 (below: NGP): L levels of at most T entries of F features, N_l cells
on level l. Positions are metres relative to the tile's origin until ``Space`` maps them to 0..1.

The parameters of a hash grid field are the table, five matrices, and one bit per cell.
``matrices`` holds W0 [H, E], W1 [16, H] (density: encoding in, log density and 15 more out) and
W2 [H, 32], W3 [H, H], W4 [3, H] (colour: 16 harmonics of the direction and the 16 outputs of the
density network in), row-major, one after the other. No biases (NGP, section 4).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput
from rfcore.native import _native

FEATURES = 2
"""F: features an entry; the kernels are written for the two of NGP, section 4."""
MAX_LEVELS = 16
MAX_CELLS = 1 << 19
MAX_LOG2_T = 24
MAX_OCCUPANCY_CELLS = 1 << 28
HIDDEN = (16, 32, 48, 64)
MAX_STEPS = 8192
MAX_FAR_M = 1e9
Vec3 = tuple[float, float, float]
Cells = tuple[int, int, int]


@dataclass(frozen=True)
class HashGrid:
    """``level_cells``: cells along x, y, z of every level, coarse to fine; ``log2_T``.

    The cells are data and not a formula, so that no logarithm of some machine decides a byte.
    """

    level_cells: tuple[Cells, ...]
    log2_T: int

    def __post_init__(self) -> None:
        if not 1 <= len(self.level_cells) <= MAX_LEVELS:
            raise InvalidInput("ngp.L", f"{len(self.level_cells)} is outside 1..{MAX_LEVELS}")
        if not 4 <= self.log2_T <= MAX_LOG2_T:
            raise InvalidInput("ngp.log2_T", f"{self.log2_T} is outside 4..{MAX_LOG2_T}")
        for cells in self.level_cells:
            if len(cells) != 3 or not all(1 <= n <= MAX_CELLS for n in cells):
                raise InvalidInput("ngp.level_cells", f"{cells} must be 3 of 1..{MAX_CELLS}")

    @property
    def L(self) -> int:
        """Number of levels."""
        return len(self.level_cells)

    @property
    def T(self) -> int:
        """Most entries of a level."""
        return 1 << self.log2_T

    @cached_property
    def array(self) -> NDArray[np.int32]:
        """``level_cells`` as [L, 3]."""
        return np.array(self.level_cells, dtype=np.int32)


def grid_levels(L: int, N_min: int, N_max: int, aspect: Vec3) -> tuple[Cells, ...]:
    """Return the cells of L levels: N_l = floor(N_min b^l), b as in NGP, eq. 3.

    N_l is along the longest side; ``aspect`` is every side's share of it, in 0..1, so that cells
    are as long as wide in metres.
    """
    if not 1 <= N_min <= N_max <= MAX_CELLS:
        raise InvalidInput("ngp.N_min", f"{N_min}, N_max {N_max}: must be 1 <= N_min <= N_max")
    growth = (math.log(N_max) - math.log(N_min)) / max(L - 1, 1)
    sizes = [math.floor(N_min * math.exp(growth * level) + 1e-6) for level in range(L)]
    return tuple(_along_sides(size, aspect) for size in sizes)


def _along_sides(size: int, aspect: Vec3) -> Cells:
    x, y, z = (max(1, math.ceil(size * share - 1e-9)) for share in aspect)
    return (x, y, z)


@dataclass(frozen=True)
class Space:
    """The box the field is made for, and whether there is anything outside.

    An unbounded field contracts what is outside as Mip-NeRF 360 (Barron et al. 2022, eq. 10), with
    the largest coordinate for the norm: x' = (2 - 1/|x|) x / |x| for |x| > 1, where x runs from -1
    to 1 in the box. A bounded field is empty and black outside, and does not pay for the rest.
    """

    centre_m: Vec3
    half_m: Vec3
    unbounded: bool

    def __post_init__(self) -> None:
        values = (*self.centre_m, *self.half_m)
        if len(values) != 6 or not all(math.isfinite(v) and abs(v) <= 1e6 for v in values):
            raise InvalidInput("ngp.space", f"{values} must be 6 numbers of at most 1e6 m")
        if not all(half >= 1e-6 for half in self.half_m):
            raise InvalidInput("ngp.space.half_m", f"{self.half_m} must be at least 1e-6 m")

    @property
    def aspect(self) -> Vec3:
        """Every side's share of the longest."""
        longest = max(self.half_m)
        x, y, z = (half / longest for half in self.half_m)
        return (x, y, z)


@dataclass(frozen=True)
class Marching:
    """Steps along a ray: step k reaches from near growth^k to near growth^(k+1) metres."""

    near_m: float
    growth: float
    steps: int

    def __post_init__(self) -> None:
        if not (math.isfinite(self.near_m) and 1e-6 <= self.near_m <= 1e6):
            raise InvalidInput("ngp.near_m", f"{self.near_m} is outside 1e-6..1e6")
        if not 1.0 < self.growth <= 2.0:
            raise InvalidInput("ngp.growth", f"{self.growth} is outside 1..2, 1 excluded")
        if not 1 <= self.steps <= MAX_STEPS:
            raise InvalidInput("ngp.steps", f"{self.steps} is outside 1..{MAX_STEPS}")
        log_far = math.log(self.near_m) + self.steps * math.log(self.growth)
        if not log_far <= math.log(MAX_FAR_M):
            raise InvalidInput("ngp.steps", f"{self.steps} reach e^{log_far:.1f} m, over 1e9 m")

    @staticmethod
    def between(near_m: float, far_m: float, per_doubling: int) -> Marching:
        """Return steps from ``near_m`` to at least ``far_m``, so many per doubling of distance."""
        if not 0 < near_m < far_m or per_doubling < 1:
            raise InvalidInput("ngp.near_m", f"{near_m} and {far_m} m, {per_doubling} per doubling")
        growth = 2.0 ** (1.0 / per_doubling)
        return Marching(near_m, growth, math.ceil(math.log2(far_m / near_m) * per_doubling))

    @cached_property
    def edges_m(self) -> NDArray[np.float32]:
        """The steps' edges [steps + 1], by repeated multiplication in float64."""
        edges = [self.near_m]
        for _ in range(self.steps):
            edges.append(edges[-1] * self.growth)
        return np.array(edges, dtype=np.float64).astype(np.float32)


@dataclass(frozen=True)
class NgpShape:
    """Everything about a field except its parameters.

    ``hidden``: width of the hidden layers, 16, 32, 48 or 64; ``occupancy_cells`` along x, y, z.
    """

    grid: HashGrid
    space: Space
    marching: Marching
    hidden: int
    occupancy_cells: Cells

    def __post_init__(self) -> None:
        if self.hidden not in HIDDEN:
            raise InvalidInput("ngp.hidden", f"{self.hidden} is none of {HIDDEN}")
        cells = self.occupancy_cells
        count = math.prod(cells)
        if len(cells) != 3 or min(cells) < 1 or count > MAX_OCCUPANCY_CELLS:
            raise InvalidInput("ngp.occupancy_cells", f"{cells}: at most {MAX_OCCUPANCY_CELLS}")

    @property
    def encoded(self) -> int:
        """Inputs of the density network: F L, filled up with zeros to a multiple of 16."""
        return -(-FEATURES * self.grid.L // 16) * 16

    @property
    def occupancy_words(self) -> int:
        """Length of the occupancy's bits in uint32."""
        return -(-math.prod(self.occupancy_cells) // 32)


OUTPUTS = 16
"""Outputs of the density network."""
HARMONICS = 16
TABLE_RANGE = 1e-4
"""Entries of a new table are uniform in +- this (NGP, section 4)."""
F32 = NDArray[np.float32]
U32 = NDArray[np.uint32]


def table_entries(grid: HashGrid) -> int:
    """Return the entries of all levels: the vertices of one that fits T, filled up to 16; or T."""
    return _native.ngp_table_entries(grid.array, grid.T)


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
        entries = table_entries(grid)
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
    """Return random parameters to start training: a small uniform table, matrices after He 2015."""
    grid = shape.grid
    entries = table_entries(grid)
    table = (rng.random((entries, FEATURES), dtype=np.float32) * 2 - 1) * np.float32(TABLE_RANGE)
    parts = []
    for outputs, inputs in matrix_shapes(shape):
        limit = np.float32(math.sqrt(6.0 / inputs))
        parts.append((rng.random(outputs * inputs, dtype=np.float32) * 2 - 1) * limit)
    return NgpParameters(shape, table, np.concatenate(parts), occupancy)
