"""The definition of the hash grid renderer, in torch: obvious, differentiable, slow.

Instant-NGP as in Mueller et al. 2022 (NGP in ``rfcore.ngp.shape``), volume rendering as in NeRF
(Mildenhall et al. 2020, eq. 3), contraction as in Mip-NeRF 360 (see ``Space``). The native kernels
compute the same function and are tested against this file in float64.

``R`` rays, ``K`` steps along each, ``M`` samples at most, ``S`` points. Which steps are occupied is
not differentiated. Every tensor has the dtype and device of ``params["table"]``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rfcore.camera import Camera
from rfcore.extras import needs
from rfcore.harmonics import SH_DC, higher_harmonics
from rfcore.ngp.shape import HashGrid, NgpParameters, NgpShape, Space

with needs("reference"):
    import torch
    from torch import Tensor

PRIMES = (1, 2654435761, 805459861)
"""NGP, eq. 4."""
MIN_TRANSMITTANCE = 1e-4
MAX_LOG_DENSITY = 15.0
"""exp(15) = 3.3e6 per metre is opaque within a micrometre; beyond, the gradient is 0."""
GROUP_STEPS = 16
"""Steps merged into one sample do not reach across a multiple of this."""
MATRICES = tuple(f"W{i}" for i in range(5))


@dataclass(frozen=True)
class Rays:
    """``origins`` [R, 3] m, unit ``directions`` [R, 3], ``jitter`` [R]: where in its step a sample
    lies, 0.5 when rendering."""

    origins: Tensor
    directions: Tensor
    jitter: Tensor


def parameters(
    numbers: NgpParameters,
    dtype: torch.dtype = torch.float64,
    *,
    requires_grad: bool = False,
    device: str = "cpu",
) -> dict[str, Tensor]:
    """Return the table and the five matrices as leaf tensors, keyed as ``render`` takes them."""
    arrays = {"table": numbers.table, **dict(zip(MATRICES, numbers.split_matrices(), strict=True))}
    return {
        name: torch.tensor(array, dtype=dtype, device=device).requires_grad_(requires_grad)
        for name, array in arrays.items()
    }


def contract(space: Space, points_m: Tensor) -> tuple[Tensor, Tensor]:
    """Return positions [..., 3] in 0..1, and which of the points belong to the field."""
    x = (points_m - _like(points_m, space.centre_m)) / _like(points_m, space.half_m)
    norm = x.abs().amax(dim=-1, keepdim=True)
    if not space.unbounded:
        return (0.5 + 0.5 * x).clamp(0, 1), norm[..., 0] <= 1
    outside = norm.clamp(min=1.0)
    contracted = (2.0 - 1.0 / outside) * x / outside
    return (0.5 + 0.25 * contracted).clamp(0, 1), torch.ones_like(norm[..., 0], dtype=torch.bool)


def at_infinity(space: Space, directions: Tensor) -> Tensor:
    """Return where ``contract`` puts the ends of the rays."""
    x = directions / _like(directions, space.half_m)
    return 0.5 + 0.5 * x / x.abs().amax(dim=-1, keepdim=True)


def encode(grid: HashGrid, table: Tensor, positions: Tensor) -> Tensor:
    """Return the features [S, 2 L] of positions [S, 3] in 0..1: NGP, section 3."""
    features, first = [], 0
    for cells in grid.level_cells:
        dense = (cells[0] + 1) * (cells[1] + 1) * (cells[2] + 1) <= grid.T
        features.append(_encode_level(cells, grid.T, dense, table[first:], positions))
        first += _entries(cells, grid.T, dense)
    return torch.cat(features, dim=1)


def _entries(cells: tuple[int, int, int], T: int, dense: bool) -> int:
    vertices = (cells[0] + 1) * (cells[1] + 1) * (cells[2] + 1)
    return -(-vertices // 16) * 16 if dense else T


def _encode_level(
    cells: tuple[int, int, int], T: int, dense: bool, table: Tensor, positions: Tensor
) -> Tensor:
    size = torch.tensor(cells, device=positions.device)
    scaled = positions * size
    low = torch.minimum(scaled.detach().floor().long(), size - 1)
    above = scaled - low
    total = torch.zeros_like(positions[:, :2])
    for corner in range(8):
        step = torch.tensor([corner >> axis & 1 for axis in range(3)], device=size.device)
        weight = torch.where(step == 1, above, 1 - above).prod(dim=1)
        index = _dense_index(low + step, cells) if dense else _hash(low + step) % T
        total = total + weight[:, None] * table[index]
    return total


def _dense_index(vertex: Tensor, cells: tuple[int, int, int]) -> Tensor:
    return vertex[:, 0] + (cells[0] + 1) * (vertex[:, 1] + (cells[1] + 1) * vertex[:, 2])


def _hash(vertex: Tensor) -> Tensor:
    x, y, z = (vertex[:, axis] * prime % (1 << 32) for axis, prime in enumerate(PRIMES))
    return x ^ y ^ z


def radiance(
    params: Mapping[str, Tensor], grid: HashGrid, positions: Tensor, directions: Tensor
) -> tuple[Tensor, Tensor]:
    """Return density [S] in 1/m and colour [S, 3] of positions in 0..1 seen along directions."""
    features = encode(grid, params["table"], positions)
    padding = params["W0"].shape[1] - features.shape[1]
    features = torch.nn.functional.pad(features, (0, padding))
    geometry = torch.relu(features @ params["W0"].T) @ params["W1"].T
    density = torch.exp(geometry[:, 0].clamp(max=MAX_LOG_DENSITY))
    hidden = torch.cat([harmonics(directions), geometry], dim=1)
    for name in ("W2", "W3"):
        hidden = torch.relu(hidden @ params[name].T)
    return density, torch.sigmoid(hidden @ params["W4"].T)


def harmonics(directions: Tensor) -> Tensor:
    """Return the 16 real spherical harmonics of degree 0..3 [S, 16], in the INRIA order."""
    x, y, z = directions.unbind(dim=1)
    basis = (SH_DC * torch.ones_like(x), *higher_harmonics(x, y, z))
    return torch.stack(basis, dim=1)


def render_rays(
    params: Mapping[str, Tensor],
    numbers: NgpParameters,
    rays: Rays,
    *,
    most_samples: int | None = None,
    samples_per_ray: int | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return colour [R, 3], mean distance [R] in metres (0: nothing hit) and opacity [R].

    A step counts if its sample lies in an occupied cell. ``most_samples`` ends a ray after so many
    (training). ``samples_per_ray`` merges neighbouring occupied steps: with c occupied steps on a
    ray, up to ceil(c / samples_per_ray) in a row become one sample (rendering in a hurry).
    A sample behind a transmittance below 1e-4 adds nothing. In an unbounded field what is left
    then meets one opaque sample at infinity; it adds no opacity.
    """
    shape = numbers.shape
    occupied = _occupied_steps(numbers, rays)
    limit = most_samples if most_samples is not None else shape.marching.steps + 1
    *edges, valid = _samples(shape, occupied, limit, samples_per_ray)
    low, high = (torch.as_tensor(edge).to(rays.origins) for edge in edges)
    distance = low + rays.jitter[:, None] * (high - low)
    there = torch.as_tensor(valid, device=distance.device)
    density, colour = _evaluate(params, shape, rays, distance, there)
    survival = torch.exp(-density * (high - low))
    before = torch.cumprod(torch.cat([torch.ones_like(survival[:, :1]), survival], dim=1), dim=1)
    counts = before[:, :-1] >= MIN_TRANSMITTANCE
    weight = torch.where(counts, before[:, :-1] * (1 - survival), 0.0)
    total = (weight[..., None] * colour).sum(dim=1)
    opacity = weight.sum(dim=1)
    mean = (weight * distance).sum(dim=1) / opacity.clamp(min=1e-300)
    if shape.space.unbounded:
        room = there.sum(dim=1) < limit
        left = torch.where(room & (1 - opacity >= MIN_TRANSMITTANCE), 1 - opacity, 0.0)
        position = at_infinity(shape.space, rays.directions)
        _, far = radiance(params, shape.grid, position, rays.directions)
        total = total + left[:, None] * far
    return total, mean, opacity


def _occupied_steps(numbers: NgpParameters, rays: Rays) -> np.ndarray:
    """Return [R, K]: whether a step's sample lies in an occupied cell of the field."""
    shape = numbers.shape
    edges = torch.as_tensor(shape.marching.edges_m).to(rays.origins)
    distance = edges[:-1] + rays.jitter[:, None] * (edges[1:] - edges[:-1])
    points = rays.origins[:, None] + distance[..., None] * rays.directions[:, None]
    u, inside = contract(shape.space, points)
    cells = torch.tensor(shape.occupancy_cells, device=u.device)
    x, y, z = torch.minimum((u * cells).long(), cells - 1).unbind(dim=-1)
    bits = np.unpackbits(numbers.occupancy.view(np.uint8), bitorder="little")
    index = x + cells[0] * (y + cells[1] * z)
    occupied: np.ndarray = inside.cpu().numpy() & (bits[index.cpu().numpy()] == 1)
    return occupied


def _samples(
    shape: NgpShape, occupied: np.ndarray, limit: int, samples_per_ray: int | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return near and far edges [R, M] of the samples, and which of them are there."""
    edges = shape.marching.edges_m
    rows = []
    for row in occupied:
        merged = 1 if samples_per_ray is None else -(-int(row.sum()) // samples_per_ray)
        rows.append(_runs(row, max(merged, 1))[:limit])
    width = max([1, *map(len, rows)])
    low, high = np.zeros((len(rows), width), np.float32), np.zeros((len(rows), width), np.float32)
    valid = np.zeros((len(rows), width), bool)
    for r, runs in enumerate(rows):
        for m, (first, end) in enumerate(runs):
            low[r, m], high[r, m], valid[r, m] = edges[first], edges[end], True
    return low, high, valid


def _runs(occupied: np.ndarray, most: int) -> list[tuple[int, int]]:
    """Return first and end of runs of occupied steps, at most ``most`` long."""
    runs: list[tuple[int, int]] = []
    for k in np.flatnonzero(occupied).tolist():
        follows = runs and runs[-1][1] == k and k % GROUP_STEPS != 0
        if follows and k - runs[-1][0] < most:
            runs[-1] = (runs[-1][0], k + 1)
        else:
            runs.append((k, k + 1))
    return runs


def _evaluate(
    params: Mapping[str, Tensor], shape: NgpShape, rays: Rays, distance: Tensor, valid: Tensor
) -> tuple[Tensor, Tensor]:
    """Return density [R, M] and colour [R, M, 3], zero where there is no sample."""
    points = rays.origins[:, None] + distance[..., None] * rays.directions[:, None]
    u, _ = contract(shape.space, points)
    directions = rays.directions[:, None].expand_as(points)
    some_density, some_colour = radiance(params, shape.grid, u[valid], directions[valid])
    density = torch.zeros_like(distance)
    colour = torch.zeros_like(points)
    return density.masked_scatter(valid, some_density), colour.masked_scatter(
        valid[..., None], some_colour
    )


def camera_rays(
    camera: Camera, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu"
) -> tuple[Rays, Tensor]:
    """Return the rays through the pixel centres, row by row, and the depth z of one metre [R]."""
    k, pose = camera.intrinsics, camera.world_from_cam
    y, x = torch.meshgrid(
        torch.arange(k.height_px, dtype=dtype, device=device) + 0.5,
        torch.arange(k.width_px, dtype=dtype, device=device) + 0.5,
        indexing="ij",
    )
    seen = torch.stack(
        [(x - k.cx_px) / k.fx_px, (y - k.cy_px) / k.fy_px, torch.ones_like(x)], dim=-1
    ).reshape(-1, 3)
    length = seen.norm(dim=1, keepdim=True)
    rotation = torch.tensor(pose.rotation_matrix(), dtype=dtype, device=device)
    directions = (seen / length) @ rotation.T
    origins = torch.tensor(pose.translation_m, dtype=dtype, device=device).expand_as(directions)
    return Rays(origins, directions, torch.full_like(length[:, 0], 0.5)), 1 / length[:, 0]


def render(
    params: Mapping[str, Tensor],
    numbers: NgpParameters,
    camera: Camera,
    samples_per_ray: int | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Render colour [H, W, 3], depth [H, W] in metres (mean z, 0: nothing hit), opacity [H, W]."""
    rays, z_of_metre = camera_rays(camera, params["table"].dtype, params["table"].device)
    colour, distance, opacity = render_rays(params, numbers, rays, samples_per_ray=samples_per_ray)
    size = (camera.intrinsics.height_px, camera.intrinsics.width_px)
    depth = (distance * z_of_metre).reshape(size)
    return colour.reshape(*size, 3), depth, opacity.reshape(size)


def _like(reference: Tensor, values: tuple[float, ...]) -> Tensor:
    """Return ``values`` as the kernels hold them: rounded to float32."""
    return torch.tensor(np.array(values, np.float32)).to(reference)
