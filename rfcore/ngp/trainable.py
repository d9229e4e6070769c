"""Training on the native kernels: forward, squared error, backward and Adam without leaving C++.

Gradients are those of ``rfcore.ngp.reference`` in float64 to within rounding; like the pictures,
they do not depend on instruction set or number of threads: blocks of rays have a fixed size, their
sums are added in order, and one task goes through all samples of a level of the table.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput
from rfcore.native import _native
from rfcore.native.backend import check_backend
from rfcore.ngp.native import native_shape
from rfcore.ngp.shape import F32, NgpParameters

MAX_BLOCK_RAYS = 256
MAX_BLOCK_SAMPLES = 1 << 14
STATE = ("table", "matrices", "table_m", "table_v", "matrices_m", "matrices_v", "peaks")
"""Arrays of a trainer, in the order the kernels number them."""


@dataclass(frozen=True)
class RayBatch:
    """``origins``, ``directions`` (unit), ``targets`` [R, 3], ``jitter`` [R] in 0..1; float32.

    A sample lies at the share ``jitter`` of its step. A block of ``rays_per_block`` rays is one
    task, each with at most ``samples_per_ray`` samples.
    """

    origins: F32
    directions: F32
    jitter: F32
    targets: F32
    rays_per_block: int
    samples_per_ray: int

    def __post_init__(self) -> None:
        count = len(self.jitter)
        for name in ("origins", "directions", "jitter", "targets"):
            array = getattr(self, name)
            size = (count,) if name == "jitter" else (count, 3)
            if array.shape != size or array.dtype != np.float32 or not array.flags.c_contiguous:
                raise InvalidInput(f"rays.{name}", f"{array.dtype} {array.shape}, want {size}")
            if not np.isfinite(array).all():
                raise InvalidInput(f"rays.{name}", "must be finite; find the NaN in the data")
        if count == 0:
            raise InvalidInput("rays", "at least one is needed")
        rays, samples = self.rays_per_block, self.samples_per_ray
        if not 1 <= rays <= MAX_BLOCK_RAYS:
            raise InvalidInput("rays.rays_per_block", f"{rays} is outside 1..{MAX_BLOCK_RAYS}")
        if not 1 <= samples <= MAX_BLOCK_SAMPLES // rays:
            raise InvalidInput(
                "rays.samples_per_ray", f"{samples} is outside 1..{MAX_BLOCK_SAMPLES // rays}"
            )


@dataclass(frozen=True)
class NgpRates:
    """Adam's step sizes and constants (Kingma and Ba 2015), as in NGP, section 4.

    ``decay`` is that of the matrices. ``peak_decay``: what a visit leaves of a cell's peak.
    """

    table: float = 1e-2
    matrices: float = 1e-2
    beta1: float = 0.9
    beta2: float = 0.99
    epsilon: float = 1e-15
    decay: float = 1e-6
    peak_decay: float = 0.95

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (math.isfinite(value) and 0 <= value <= 1):
                raise InvalidInput(f"rates.{field.name}", f"{value} is outside 0..1")
        if max(self.beta1, self.beta2) >= 1 or self.epsilon < 1e-30:
            raise InvalidInput("rates", "betas must be below 1, epsilon at least 1e-30")


class TrainableNgp:
    """A field being optimised; the kernels hold parameters, Adam's moments and the grid's peaks.

    Adam moves the numbers whose gradient is not 0, and only their moments decay. A cell's peak is
    the largest optical thickness of a sample there, faded by every visit; ``rebuild_occupancy``
    makes the bits of the peaks. Gradients that are not finite or beyond 1e15 count as zero.
    """

    def __init__(
        self,
        parameters: NgpParameters,
        peaks: F32,
        *,
        threads: int = 1,
        isa: str | None = None,
    ) -> None:
        p, shape = parameters, parameters.shape
        cells = math.prod(shape.occupancy_cells)
        if peaks.shape != (cells,) or peaks.dtype != np.float32:
            raise InvalidInput(
                "ngp.peaks", f"{peaks.dtype} {peaks.shape} must be float32 [{cells}]"
            )
        self.isa = check_backend(threads, isa)
        self._shape = shape
        box, grid = native_shape(shape)
        table, matrices = p.table.size, p.matrices.size
        self._sizes = (table, matrices, table, table, matrices, matrices, cells)
        self._native = _native.NgpTrainer(
            box,
            grid,
            shape.grid.array,
            p.occupancy,
            shape.marching.edges_m,
            p.table,
            p.matrices,
            peaks,
            threads,
            self.isa,
        )

    @property
    def samples(self) -> int:
        """Samples of the last batch."""
        return self._native.samples

    def accumulate(self, batch: RayBatch) -> float:
        """Go forward and back; return the mean squared error over rays and channels."""
        total = self._native.accumulate(
            batch.origins,
            batch.directions,
            batch.jitter,
            batch.targets,
            batch.rays_per_block,
            batch.samples_per_ray,
        )
        return total / (3 * len(batch.jitter))

    def gradients(self) -> tuple[F32, F32]:
        """Return the gradients of table [entries, 2] and matrices of ``accumulate``, once."""
        table = np.empty(self._sizes[0], np.float32)
        matrices = np.empty(self._sizes[1], np.float32)
        self._native.gradients(table, matrices)
        return table.reshape(-1, 2), matrices

    def update(self, rates: NgpRates) -> None:
        """Take one step of Adam with the gradients of ``accumulate``."""
        r = rates
        self._native.update(
            [r.table, r.matrices, r.beta1, r.beta2, r.epsilon, r.decay], r.peak_decay
        )

    def rebuild_occupancy(self, threshold: float) -> int:
        """Occupy the cells whose peak is above ``threshold``; return how many."""
        return self._native.rebuild_occupancy(threshold)

    def parameters(self) -> NgpParameters:
        """Return the numbers as they are now."""
        state = self.state()
        return NgpParameters(
            self._shape, state["table"].reshape(-1, 2), state["matrices"], state["occupancy"]
        )

    def state(self) -> dict[str, NDArray[Any]]:
        """Return every array and counter that the next step depends on."""
        arrays: dict[str, NDArray[Any]] = {}
        for which, (name, size) in enumerate(zip(STATE, self._sizes, strict=True)):
            arrays[name] = np.empty(size, np.float32)
            self._native.read(which, arrays[name])
        arrays["occupancy"] = np.empty(self._shape.occupancy_words, np.uint32)
        self._native.read_occupancy(arrays["occupancy"])
        arrays["steps"] = np.array([self._native.steps], np.uint64)
        return arrays

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Take a ``state`` of a field of the same shape; raise ``InvalidInput`` otherwise."""
        for which, (name, size) in enumerate(zip(STATE, self._sizes, strict=True)):
            array = state[name]
            if array.shape != (size,) or array.dtype != np.float32:
                raise InvalidInput(f"state.{name}", f"{array.dtype} {array.shape}, want [{size}]")
            self._native.write(which, array)
        self._native.write_occupancy(np.asarray(state["occupancy"], np.uint32))
        self._native.set_steps(int(state["steps"][0]))
