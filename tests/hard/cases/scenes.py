"""Small scenes with room for something poisonous, and their distance from the float64 definition.

A dozen translucent blobs stand 2 to 7 m before a 40 x 24 px camera; a poison replaces some of them.
The float64 definition is ``rfcore.raster.reference``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.raster.gaussians import F32, Gaussians
from rfcore.raster.native import Rasterizer
from rfcore.raster.trainable import LearningRates, TrainableRasterizer
from rfcore.views import View

INTRINSICS = Intrinsics(40, 24, 30.0, 30.0, 20.0, 12.0)
AHEAD = Camera(INTRINSICS, Pose.identity())
TURNED = Camera(INTRINSICS, Pose((0.1, -0.05, -0.2), (0.96, 0.0, 0.28, 0.0)))
RATES = LearningRates(means=1e-2)

PICTURE_LIMIT = 1e-5
"""exp2 is good to 2.6e-6 and weights sum to at most 1; colours here stay below 3."""

EVERY = 4
"""One in so many blobs is replaced by the poison."""

F64 = NDArray[np.float64]
Values = Mapping[str, object]


@dataclass(frozen=True)
class Gradients:
    """The native and the float64 gradients of all parameters, by name."""

    native: Mapping[str, F32]
    float64: Mapping[str, F64]


def blobs(count: int = 24, degree: int = 1, seed: int = 1) -> Gaussians:
    """Return translucent blobs of 0.05 to 0.4 m in view of the cameras."""
    rng = np.random.default_rng(seed)
    sh = rng.normal(0.0, 0.15, (count, (degree + 1) ** 2, 3))
    sh[:, 0] += rng.uniform(-0.5, 1.5, (count, 3))
    values = (
        rng.uniform((-1.5, -1.0, 2.0), (1.5, 1.0, 7.0), (count, 3)),
        rng.normal(size=(count, 4)),
        rng.uniform(np.log(0.05), np.log(0.4), (count, 3)),
        rng.uniform(-2.0, 2.0, count),
        sh,
    )
    return Gaussians(*(np.ascontiguousarray(v, dtype=np.float32) for v in values))


def one_splat(**changes: object) -> Gaussians:
    """Return one grey ball of 0.2 m, half opaque, 4 m ahead on the axis, with ``changes``."""
    values: dict[str, object] = {
        "means": [0.0, 0.0, 4.0],
        "quaternions": [1.0, 0.0, 0.0, 0.0],
        "log_scales": [np.log(0.2)] * 3,
        "opacity_logits": 0.0,
        "sh": [[1.0, 1.0, 1.0]],
        **changes,
    }
    return Gaussians(**{name: np.array([value], np.float32) for name, value in values.items()})


def poisoned(gaussians: Gaussians, values: Values, every: int = EVERY) -> Gaussians:
    """Return a copy in which one in ``every`` Gaussians has ``values`` in the fields named."""
    changed = {name: getattr(gaussians, name).copy() for name in values}
    for name, value in values.items():
        changed[name][::every] = value
    return replace(gaussians, **changed)


def without(gaussians: Gaussians, every: int = EVERY) -> Gaussians:
    """Return the Gaussians that ``poisoned`` leaves alone."""
    kept = np.arange(len(gaussians)) % every != 0
    return Gaussians(*(np.ascontiguousarray(array[kept]) for array in arrays_of(gaussians)))


def joined(*parts: Gaussians) -> Gaussians:
    """Return all Gaussians of all parts, in order; they have one SH degree."""
    columns = zip(*(arrays_of(part) for part in parts), strict=True)
    return Gaussians(*(np.concatenate(column) for column in columns))


def arrays_of(gaussians: Gaussians) -> tuple[F32, ...]:
    """Return the five arrays of a set of Gaussians."""
    return tuple(getattr(gaussians, field.name) for field in fields(gaussians))


def same_view(a: View, b: View) -> bool:
    """Tell whether two views are equal to the last bit."""
    pairs = ((a.colour, b.colour), (a.depth, b.depth), (a.opacity, b.opacity))
    return all(x.tobytes() == y.tobytes() for x, y in pairs)


def picture_error(
    gaussians: Gaussians, camera: Camera = AHEAD, *, antialiased: bool = False
) -> float:
    """Return the largest difference of a colour or opacity from the float64 definition."""
    import torch

    from rfcore.raster import reference

    view = Rasterizer(gaussians, antialiased=antialiased).render(camera)
    with torch.no_grad():
        colour, _, opacity = reference.render(
            reference.parameters(gaussians), camera, antialiased=antialiased
        )
    return float(
        max(
            np.abs(view.colour - colour.numpy()).max(), np.abs(view.opacity - opacity.numpy()).max()
        )
    )


def gradients(gaussians: Gaussians, camera: Camera, antialiased: bool) -> Gradients:
    """Return the gradients of a sum of colours with random weights."""
    import torch

    from rfcore.raster import reference

    k = camera.intrinsics
    weights = np.random.default_rng(3).normal(size=(k.height_px, k.width_px, 3)).astype(np.float32)
    native = TrainableRasterizer(gaussians, antialiased=antialiased)
    native.forward(camera)
    native.backward(weights)
    params = reference.parameters(gaussians, requires_grad=True)
    colour, _, _ = reference.render(params, camera, antialiased=antialiased)
    (colour * torch.tensor(weights, dtype=torch.float64)).sum().backward()
    return Gradients(native.gradients(), {n: _grad(p) for n, p in params.items()})


def gradient_error(
    gaussians: Gaussians, camera: Camera = AHEAD, *, antialiased: bool = False
) -> float:
    """Return the largest relative difference, in the L2 norm, of a parameter group's gradient."""
    pairs = gradients(gaussians, camera, antialiased)
    errors = []
    for name, want in pairs.float64.items():
        size = float(np.linalg.norm(want))
        errors.append(float(np.linalg.norm(pairs.native[name] - want)) / size if size else 0.0)
    return max(errors)


def _grad(parameter: object) -> F64:
    grad = getattr(parameter, "grad", None)
    return np.asarray(grad.numpy(), dtype=np.float64)
