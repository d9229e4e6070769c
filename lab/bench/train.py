"""Time one training iteration on the synthetic street: forward, loss, backward, Adam."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lab.bench.street import street_camera, street_gaussians
from rfcore.errors import RfedgeError
from rfcore.extras import needs
from rfcore.raster.gaussians import F32, Gaussians
from rfcore.raster.trainable import LearningRates, TrainableRasterizer
from rfedge.timing import median_ms

SIZES_PX = ((640, 360),)
THREADS = (1, 2)
RATES = LearningRates(
    means=1e-5, log_scales=1e-5, quaternions=1e-5, opacity=1e-5, sh_dc=1e-5, sh_rest=1e-5
)
"""Small, so that the scene stays what it is over the repetitions."""
CHECK_COUNT = 300
CHECK_SIZE_PX = (48, 32)
TOLERANCE = 1e-3
"""Relative, in norm; a pixel on a threshold may take part. The tests hold 1e-4 without those."""


@dataclass(frozen=True)
class TrainRow:
    """One picture size and number of threads; ``iteration_ms`` is a median."""

    width: int
    height: int
    gaussians: int
    threads: int
    iteration_ms: float


def train_rows() -> list[TrainRow]:
    """Return one row per size and number of threads; raise ``RfedgeError`` on wrong gradients."""
    check_gradients()
    gaussians = street_gaussians()
    return [_row(gaussians, size, threads) for size in SIZES_PX for threads in THREADS]


def check_gradients() -> None:
    """Raise ``RfedgeError`` unless the gradients of a small street follow the reference."""

    from rfcore.raster import reference

    with needs("reference"):
        import torch

    gaussians, camera = street_gaussians(CHECK_COUNT), street_camera(*CHECK_SIZE_PX)
    target = _target(CHECK_SIZE_PX)
    native = TrainableRasterizer(gaussians)
    native.forward(camera)
    native.loss(target)
    native.backward()
    params = reference.parameters(gaussians, requires_grad=True)
    colour, _, _ = reference.render(params, camera)
    loss = reference.loss_l1_dssim(colour, torch.tensor(target, dtype=torch.float64))
    torch.autograd.backward(loss)
    for name, got in native.gradients().items():
        grad = params[name].grad
        want = np.zeros_like(got, dtype=np.float64) if grad is None else grad.numpy()
        error = float(np.linalg.norm(got - want) / np.linalg.norm(want))
        if not error < TOLERANCE:
            raise RfedgeError(
                f"gradients of {name} are off by {error:.2g} (limit {TOLERANCE:g}): "
                "nothing was timed"
            )


def _row(gaussians: Gaussians, size: tuple[int, int], threads: int) -> TrainRow:
    trainable, camera, target = (
        TrainableRasterizer(gaussians, threads=threads),
        street_camera(*size),
        _target(size),
    )
    return TrainRow(
        width=size[0],
        height=size[1],
        gaussians=len(gaussians),
        threads=threads,
        iteration_ms=median_ms(lambda: trainable.iterate(camera, target, RATES)),
    )


def _target(size: tuple[int, int]) -> F32:
    """A picture unlike the render: loss and gradients are at full strength everywhere."""
    return np.random.default_rng(0).random((size[1], size[0], 3), dtype=np.float32)
