"""Hard hash grid fields: densities that overflow, rays that see nothing, graze or run along a face.

The field is a box of 4 x 4 x 4 m around (0, 0, 4) in which log density and colour are the same
everywhere, so that every ray has a closed form: 1 - exp(-density length), the length that of its
steps whose middle lies in the box. Random fields are held to ``rfcore.ngp.reference`` in float64.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from hard.cases.case import Case, Finding, refusal, statement, within
from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfcore.ngp.native import NgpRenderer
from rfcore.ngp.shape import (
    HashGrid,
    Marching,
    NgpParameters,
    NgpShape,
    Space,
    grid_levels,
    initial_parameters,
    matrix_shapes,
)
from rfcore.ngp.trainable import NgpRates, RayBatch, TrainableNgp
from rfcore.views import View

GROUP = "Hash grids"
LIMIT = 2e-5
"""Each of up to 60 samples is good to a few 1e-7; random fields change within a 40th of the box."""
GRADIENT_LIMIT = 1e-4
SH0 = 0.28209479177387814
COLOUR = 0.75
HALF_M = 2.0
CENTRE_M = (0.0, 0.0, 4.0)
CELLS = 8
MIN_TRANSMITTANCE = 1e-4


@dataclass(frozen=True)
class Make:
    """The parameters of a field; ``log_density`` None makes a random one."""

    log_density: float | None = None
    unbounded: bool = False
    occupied: bool = True
    steps_per_doubling: int = 16


def _field(make: Make) -> NgpParameters:
    space = Space(CENTRE_M, (HALF_M,) * 3, make.unbounded)
    grid = HashGrid(grid_levels(4, 3, 40, space.aspect), 8)
    marching = Marching.between(0.25, 16.0, make.steps_per_doubling)
    shape = NgpShape(grid, space, marching, 16, (CELLS, CELLS, CELLS))
    bits = np.full(shape.occupancy_words, 0xFFFFFFFF if make.occupied else 0, np.uint32)
    random = initial_parameters(shape, bits, np.random.default_rng(0))
    if make.log_density is None:
        table = np.random.default_rng(1).random(random.table.shape, dtype=np.float32) * 2 - 1
        return replace(random, table=table)
    return replace(
        random,
        table=np.ones_like(random.table),
        matrices=_uniform_matrices(shape, make.log_density),
    )


def _uniform_matrices(shape: NgpShape, log_density: float) -> NDArray[np.float32]:
    """Features are 1 everywhere and the first harmonic is a constant: one path through each."""
    matrices = [np.zeros(size, np.float32) for size in matrix_shapes(shape)]
    density, geometry, first, second, colour = matrices
    density[0, 0], geometry[0, 0] = 1.0, log_density
    first[0, 0], second[0, 0] = 1.0 / SH0, 1.0
    colour[:, 0] = math.log(COLOUR / (1 - COLOUR))
    return np.concatenate([matrix.ravel() for matrix in matrices])


def _camera(
    position: tuple[float, float, float] = (0.0, 0.0, 0.0),
    rotation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
) -> Camera:
    """Return a camera of 9 x 7 px whose middle pixel looks along z exactly."""
    return Camera(Intrinsics(9, 7, 8.0, 8.0, 4.5, 3.5), Pose(position, rotation))


TURNED = (0.96, 0.0, 0.28, 0.0)


def _length_m(shape: NgpShape, axis_from_m: float) -> float:
    """Return the length of the steps of a ray along z whose middles lie in the box."""
    edges = shape.marching.edges_m.astype(np.float64)
    middle = axis_from_m + 0.5 * (edges[1:] + edges[:-1])
    inside = np.abs(middle - CENTRE_M[2]) <= HALF_M
    return float((edges[1:] - edges[:-1])[inside].sum())


def _slab(log_density: float) -> Finding:
    """The middle pixel, whose ray is the axis; the rest of the light falls to black."""
    field = _field(Make(log_density))
    view = NgpRenderer(field).render(_camera())
    want = -math.expm1(-math.exp(min(log_density, 15.0)) * _length_m(field.shape, 0.0))
    got = float(view.opacity[3, 4])
    slack = MIN_TRANSMITTANCE if want > 1 - MIN_TRANSMITTANCE else 0.0
    error = max(abs(got - want), float(np.abs(view.colour[3, 4] - want * COLOUR).max()))
    finite = all(bool(np.isfinite(p).all()) for p in (view.colour, view.depth, view.opacity))
    finding = within(error, LIMIT + slack, f"opacity {got:.7g}")
    return replace(finding, holds=finding.holds and finite)


def _sees_nothing(make: Make, camera: Camera) -> Finding:
    view = NgpRenderer(_field(make)).render(camera)
    dark = not (view.colour.any() or view.depth.any() or view.opacity.any())
    return statement(dark, "black, clear, depth 0", f"opacity {view.opacity.max():.3g}")


def _empty_sees_infinity() -> Finding:
    """Unbounded and empty: the one opaque sample at infinity has the colour, not the opacity."""
    view = NgpRenderer(_field(Make(-80.0, unbounded=True))).render(_camera())
    error = float(np.abs(view.colour - COLOUR).max())
    finding = within(
        error, LIMIT, f"colour {view.colour[3, 4, 0]:.6f}, opacity {view.opacity.max():g}"
    )
    return replace(finding, holds=finding.holds and float(view.opacity.max()) < 1e-30)


def _underflow() -> Finding:
    """Thousands of samples of thickness 0.05: exp(-200) never comes about, T stops under 1e-4."""
    field = _field(Make(5.0, steps_per_doubling=1300))
    view = NgpRenderer(field).render(_camera())
    error = max(abs(float(view.opacity.min()) - 1.0), abs(float(view.opacity.max()) - 1.0))
    return within(
        error, MIN_TRANSMITTANCE, f"opacity {view.opacity.min():.6f}..{view.opacity.max():.6f}"
    )


def _against_float64(make: Make, camera: Camera) -> Finding:
    """Largest difference of a colour or opacity."""
    import torch

    from rfcore.ngp import reference

    field = _field(make)
    view: View = NgpRenderer(field).render(camera)
    with torch.no_grad():
        colour, _, opacity = reference.render(reference.parameters(field), field, camera)
    error = max(
        np.abs(view.colour - colour.numpy()).max(), np.abs(view.opacity - opacity.numpy()).max()
    )
    return within(
        float(error), LIMIT, f"opacity {view.opacity.min():.3f}..{view.opacity.max():.3f}"
    )


def _batch(origins: NDArray[np.float64], directions: NDArray[np.float64]) -> RayBatch:
    rng = np.random.default_rng(4)
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    arrays = (origins, unit, rng.random(len(origins)), rng.random((len(origins), 3)))
    o, d, jitter, targets = (np.ascontiguousarray(a, dtype=np.float32) for a in arrays)
    return RayBatch(o, d, jitter, targets, rays_per_block=16, samples_per_ray=400)


def _into_the_box(count: int = 40) -> RayBatch:
    rng = np.random.default_rng(2)
    spread = rng.normal(size=(count, 3)) * [0.3, 0.3, 0.1] + [0.0, 0.0, 1.0]
    return _batch(0.1 * rng.normal(size=(count, 3)), spread)


def _gradients(
    field: NgpParameters, batch: RayBatch
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return native and float64 gradients of all parameters, flat."""
    import torch

    from rfcore.ngp import reference

    trainable = TrainableNgp(field, np.ones(CELLS**3, np.float32))
    trainable.accumulate(batch)
    table, matrices = trainable.gradients()
    params = reference.parameters(field, requires_grad=True)
    rays = reference.Rays(
        *(
            torch.tensor(a, dtype=torch.float64)
            for a in (batch.origins, batch.directions, batch.jitter)
        )
    )
    colour, _, _ = reference.render_rays(params, field, rays, most_samples=batch.samples_per_ray)
    ((colour - torch.tensor(batch.targets, dtype=torch.float64)) ** 2).mean().backward()
    wanted = [value.grad.numpy().ravel() for value in params.values() if value.grad is not None]
    return np.concatenate([table.ravel(), matrices]).astype(np.float64), np.concatenate(wanted)


def _gradient(make: Make, batch: RayBatch) -> Finding:
    got, want = _gradients(_field(make), batch)
    error = float(np.linalg.norm(got - want) / np.linalg.norm(want))
    return within(error, GRADIENT_LIMIT, "the gradients of float64")


def _no_gradient(make: Make, batch: RayBatch) -> Finding:
    """Rays that meet nothing teach nothing."""
    got, want = _gradients(_field(make), batch)
    zero = not got.any() and not want.any()
    return statement(zero, "exactly zero", f"up to {np.abs(got).max():.3g}")


def _steps(make: Make) -> Finding:
    """``parameters()`` raises on a number that is not finite."""
    trainable = TrainableNgp(_field(make), np.ones(CELLS**3, np.float32))
    losses = []
    for _ in range(30):
        losses.append(trainable.accumulate(_into_the_box()))
        trainable.update(NgpRates())
        trainable.parameters()
    good = bool(np.isfinite(losses).all())
    return statement(good, f"loss {losses[0]:.3g} to {losses[-1]:.3g}", "a loss is not finite")


def _not_finite() -> Finding:
    field = _field(Make())
    table = field.table.copy()
    table[5, 1] = np.nan
    return refusal(lambda: replace(field, table=table), InvalidInput, "ngp.table", "1 numbers")


def _case(name: str, expected: str, measure: Callable[[], Finding]) -> Case:
    return Case(GROUP, name, expected, measure)


ALONG_A_FACE = _camera((HALF_M, 0.0, 0.0))
BESIDE_A_FACE = _camera((np.nextafter(np.float32(HALF_M), np.float32(9)).item(), 0.0, 0.0))
ALONG_AN_EDGE = _camera((HALF_M, -HALF_M, 0.0))
BEHIND = _camera((0.0, 0.0, 8.0))
ASIDE = _batch(np.tile([0.0, 0.0, 7.0], (20, 1)), np.tile([0.0, 0.0, 1.0], (20, 1)))

CASES = (
    *(
        _case(
            f"log density {v:g}",
            "1 - exp(-density length), density at most e^15",
            partial(_slab, v),
        )
        for v in (80.0, 3e38, 15.0, 2.0, 0.0, -5.0, -80.0, -3e38)
    ),
    _case(
        "rays through an empty grid",
        "black, clear, depth 0",
        partial(_sees_nothing, Make(occupied=False), _camera()),
    ),
    _case(
        "rays away from the box", "black, clear, depth 0", partial(_sees_nothing, Make(3.0), BEHIND)
    ),
    _case(
        "rays away from the box, 1000 km off",
        "black, clear, depth 0",
        partial(_sees_nothing, Make(3.0), _camera((1e6, 0.0, 0.0))),
    ),
    _case("empty, unbounded", "the colour at infinity, opacity 0", _empty_sees_infinity),
    _case("thousands of samples, T underflow", "1, to 1e-4", _underflow),
    _case(
        "ray in a face of the box",
        "the float64 definition",
        partial(_against_float64, Make(), ALONG_A_FACE),
    ),
    _case(
        "ray a rounding beside a face",
        "the float64 definition",
        partial(_against_float64, Make(), BESIDE_A_FACE),
    ),
    _case(
        "ray in an edge of the box",
        "the float64 definition",
        partial(_against_float64, Make(), ALONG_AN_EDGE),
    ),
    _case(
        "camera in the middle of the box",
        "the float64 definition",
        partial(_against_float64, Make(), _camera(CENTRE_M, TURNED)),
    ),
    _case(
        "unbounded, camera at the contraction's seam",
        "the float64 definition",
        partial(_against_float64, Make(unbounded=True), _camera((HALF_M, 0.0, 4.0), TURNED)),
    ),
    _case(
        "unbounded, camera 100 m outside",
        "the float64 definition",
        partial(_against_float64, Make(unbounded=True), _camera((100.0, -50.0, 0.0), TURNED)),
    ),
    _case(
        "gradient: random field", "float64, relative", partial(_gradient, Make(), _into_the_box())
    ),
    _case(
        "gradient: random, unbounded",
        "float64, relative",
        partial(_gradient, Make(unbounded=True), _into_the_box()),
    ),
    _case(
        "gradient: log density 80",
        "float64, relative",
        partial(_gradient, Make(80.0), _into_the_box()),
    ),
    _case(
        "gradient: log density -20",
        "float64, relative",
        partial(_gradient, Make(-20.0), _into_the_box()),
    ),
    _case("gradient: rays past the box", "exactly zero", partial(_no_gradient, Make(3.0), ASIDE)),
    _case("30 steps: log density 80", "finite after every step", partial(_steps, Make(80.0))),
    _case("30 steps: log density -80", "finite after every step", partial(_steps, Make(-80.0))),
    _case(
        "30 steps: random, unbounded",
        "finite after every step",
        partial(_steps, Make(unbounded=True)),
    ),
    _case("NaN in the table", "refused, naming how many", _not_finite),
)
