"""The definition of the rasterizer, in torch: obvious, differentiable, slow.

3D Gaussian Splatting as in Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field
Rendering", ACM TOG 42(4), 2023 (below: 3DGS), whose projection is that of Zwicker et al.,
"EWA Splatting", IEEE TVCG 8(3), 2002 (below: EWA). The native kernels compute the same function
and are tested against this file in float64.

Conventions as in ``rfcore.camera``; ``N`` Gaussians, ``V`` of them in front of the near plane and
sorted by depth, ``P`` pixels. Every tensor has the dtype and device of ``params["means"]``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields

import numpy as np

from rfcore.camera import Camera
from rfcore.extras import needs
from rfcore.harmonics import SH_DC, higher_harmonics
from rfcore.raster.gaussians import SKY_M, Gaussians

with needs("reference"):
    import torch
    from torch import Tensor
    from torch.nn import functional

NEAR_M = 0.01
"""Gaussians whose centre is not beyond this depth are not drawn."""
DILATION_PX2 = 0.3
"""Added to the diagonal of every projected covariance: the pixel's low-pass filter (EWA eq. 30)."""
FRUSTUM_MARGIN = 0.3
"""Share of the half field of view by which the point of linearisation may leave the picture."""
MAX_ALPHA = 0.99
MIN_ALPHA = 1.0 / 255.0
MIN_TRANSMITTANCE = 1e-4
MIN_QUATERNION_NORM = 1e-12
"""A shorter quaternion counts as no rotation."""
MIN_DET_RATIO = 1e-6
"""Least ratio of determinants in the antialiased mode. It is below MIN_ALPHA^2, so what it clamps
is never drawn."""
EXTENT_SIGMAS = 3.33
"""No alpha reaches 1/255 beyond sqrt(2 ln 255) = 3.3290 standard deviations."""
TILE_PX = 16


@dataclass(frozen=True)
class _Splats:
    """Gaussians projected into a picture, front to back; ties in depth keep their index order."""

    centre_px: Tensor  # [V, 2]
    conic: Tensor  # [V, 3]: xx, xy, yy of the inverse 2D covariance
    extent_px: Tensor  # [V, 2]: half sides of the box outside which alpha < 1/255
    colour: Tensor  # [V, 3]
    opacity: Tensor  # [V]
    depth_m: Tensor  # [V]

    def at(self, index: Tensor) -> _Splats:
        """Return the splats that ``index`` selects, in its order."""
        return _Splats(*(getattr(self, field.name)[index] for field in fields(self)))


def parameters(
    gaussians: Gaussians,
    dtype: torch.dtype = torch.float64,
    *,
    requires_grad: bool = False,
    device: str = "cpu",
) -> dict[str, Tensor]:
    """Return the arrays of ``gaussians`` as leaf tensors, keyed as ``render`` takes them."""
    arrays = {field.name: getattr(gaussians, field.name) for field in fields(gaussians)}
    return {
        name: torch.tensor(array, dtype=dtype, device=device).requires_grad_(requires_grad)
        for name, array in arrays.items()
    }


def render(
    params: Mapping[str, Tensor],
    camera: Camera,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    *,
    antialiased: bool = False,
) -> tuple[Tensor, Tensor, Tensor]:
    """Render colour [H, W, 3], depth [H, W] in metres and opacity [H, W].

    ``params`` has the fields of ``Gaussians`` as tensors of one floating dtype; finiteness is not
    checked. Colour is not clamped from above. Depth and opacity are those of surfaces: the mean z
    weighted by each Gaussian's share of the pixel, and the sum of those shares, what lies beyond
    10 km (``SKY_M``) left out. Where that is more of what is shown they are ``SKY_M`` and its
    share, where nothing is shown 0.

    With ``antialiased`` a Gaussian that the dilation widens is made fainter by as much: its
    opacity is multiplied by sqrt(det C / det (C + 0.3 I)), C its projected covariance
    (Yu et al., "Mip-Splatting", CVPR 2024, eq. 9; ``antialiased`` in gsplat).
    """
    splats = _project(params, camera, antialiased)
    k = camera.intrinsics
    rows = []
    for top in range(0, k.height_px, TILE_PX):
        height = min(TILE_PX, k.height_px - top)
        band = splats.at(_touching(splats, axis=1, start=top, length=height))
        row = []
        for left in range(0, k.width_px, TILE_PX):
            width = min(TILE_PX, k.width_px - left)
            tile = band.at(_touching(band, axis=0, start=left, length=width))
            pixels = _pixel_centres(left, top, width, height, like=splats.centre_px)
            row.append(_composite(tile, pixels).reshape(height, width, 6))
        rows.append(torch.cat(row, dim=1))
    picture = torch.cat(rows, dim=0)
    surfaces, shown = picture[..., 4], picture[..., 5]
    colour = picture[..., :3] + (1.0 - shown)[..., None] * _like(picture, background)
    sky = shown - surfaces
    is_sky = sky > surfaces
    depth = torch.where(is_sky, SKY_M, _mean_depth(picture[..., 3], surfaces))
    return colour, depth, torch.where(is_sky, sky, surfaces)


def loss_l1_dssim(colour: Tensor, target: Tensor, dssim_weight: float = 0.2) -> Tensor:
    """Return (1 - w) L1 + w (1 - SSIM) of two [H, W, 3] pictures with peak 1 (3DGS eq. 7).

    SSIM after Wang et al. 2004 per channel: 11x11 Gaussian window of sigma 1.5, zero padding,
    C1 = 0.01^2, C2 = 0.03^2, mean over every pixel and channel.
    """
    l1 = (colour - target).abs().mean()
    return (1.0 - dssim_weight) * l1 + dssim_weight * (1.0 - _ssim_map(colour, target).mean())


def spherical_harmonics(directions: Tensor, degree: int) -> Tensor:
    """Evaluate the real basis [..., (degree + 1)^2] at unit vectors [..., 3], degree 0..3.

    Signs and order of the INRIA implementation: Y_lm with m = -l..l, Condon-Shortley phase in.
    """
    x, y, z = directions.unbind(-1)
    basis = [torch.full_like(x, SH_DC), *higher_harmonics(x, y, z)]
    return torch.stack(basis[: (degree + 1) ** 2], dim=-1)


def _project(params: Mapping[str, Tensor], camera: Camera, antialiased: bool) -> _Splats:
    """Project every Gaussian beyond the near plane and sort them front to back."""
    means = params["means"]
    pose = camera.cam_from_world()
    rotation, translation = _like(means, pose.rotation_matrix()), _like(means, pose.translation_m)
    in_camera = means @ rotation.T + translation
    with torch.no_grad():
        depth = in_camera[:, 2]
        kept = torch.nonzero(depth > NEAR_M).squeeze(1)
        order = kept[torch.argsort(depth[kept], stable=True)]
    root = rotation @ _covariance_root(params["quaternions"][order], params["log_scales"][order])
    root_px = _jacobian(in_camera[order], camera) @ root
    conic, extent_px, det_ratio = _conic_and_extent(root_px)
    opacity = torch.sigmoid(params["opacity_logits"][order])
    return _Splats(
        centre_px=_pinhole(in_camera[order], camera),
        conic=conic,
        extent_px=extent_px,
        colour=_colour(params["sh"][order], means[order], camera),
        opacity=opacity * det_ratio.clamp(min=MIN_DET_RATIO).sqrt() if antialiased else opacity,
        depth_m=in_camera[order, 2],
    )


def _like(tensor: Tensor, values: object) -> Tensor:
    return torch.tensor(values, dtype=tensor.dtype, device=tensor.device)


def _rotation_matrices(quaternions: Tensor) -> Tensor:
    """Return [V, 3, 3] from quaternions [V, 4] w, x, y, z; one too short gives the identity."""
    norm = torch.linalg.vector_norm(quaternions, dim=-1, keepdim=True)
    identity = _like(quaternions, (1.0, 0.0, 0.0, 0.0))
    is_rotation = norm > MIN_QUATERNION_NORM
    unit = quaternions / torch.where(is_rotation, norm, 1.0)
    w, x, y, z = torch.where(is_rotation, unit, identity).unbind(-1)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(rows, dim=-1).reshape(-1, 3, 3)


def _covariance_root(quaternions: Tensor, log_scales: Tensor) -> Tensor:
    """Return R S [V, 3, 3], a square root of the covariance R S S^T R^T (3DGS eq. 6)."""
    return _rotation_matrices(quaternions) * log_scales.exp()[:, None, :]


def _pinhole(in_camera: Tensor, camera: Camera) -> Tensor:
    k = camera.intrinsics
    x, y, z = in_camera.unbind(-1)
    return torch.stack([k.fx_px * x / z + k.cx_px, k.fy_px * y / z + k.cy_px], dim=-1)


def _jacobian(in_camera: Tensor, camera: Camera) -> Tensor:
    """Return [V, 2, 3]: the pinhole linearised at the centre of each Gaussian (EWA eq. 29).

    The point of linearisation is pulled to within 1.3 half fields of view: beyond, the affine
    approximation would smear a Gaussian that is out of sight across the picture.
    """
    k = camera.intrinsics
    x, y, z = in_camera.unbind(-1)
    slope_x = _clamped_slope(x / z, k.fx_px, k.cx_px, k.width_px)
    slope_y = _clamped_slope(y / z, k.fy_px, k.cy_px, k.height_px)
    zero = torch.zeros_like(z)
    rows = [k.fx_px / z, zero, -k.fx_px * slope_x / z, zero, k.fy_px / z, -k.fy_px * slope_y / z]
    return torch.stack(rows, dim=-1).reshape(-1, 2, 3)


def _clamped_slope(slope: Tensor, focal_px: float, centre_px: float, side_px: int) -> Tensor:
    margin = FRUSTUM_MARGIN * 0.5 * side_px / focal_px
    return slope.clamp(-centre_px / focal_px - margin, (side_px - centre_px) / focal_px + margin)


def _conic_and_extent(root_px: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the inverse of C = A A^T + 0.3 I as [V, 3], the half box [V, 2] and det A A^T / det C.

    A is ``root_px``. Determinants are summed from the squared 2x2 minors of A (Cauchy-Binet), none
    negative, because c_xx c_yy - c_xy^2 of a needle loses every digit.
    """
    a, b = root_px.unbind(1)
    c_xx = (a * a).sum(-1) + DILATION_PX2
    c_yy = (b * b).sum(-1) + DILATION_PX2
    c_xy = (a * b).sum(-1)
    minors = torch.linalg.cross(a, b)
    sharp_det = (minors * minors).sum(-1)
    det = sharp_det + DILATION_PX2 * (c_xx + c_yy - DILATION_PX2)
    extent_px = EXTENT_SIGMAS * torch.stack([c_xx, c_yy], dim=-1).detach().sqrt()
    conic = torch.stack([c_yy / det, -c_xy / det, c_xx / det], dim=-1)
    return conic, extent_px, sharp_det / det


def _colour(sh: Tensor, means: Tensor, camera: Camera) -> Tensor:
    """Return max(0, SH(direction) + 0.5) [V, 3]; the direction goes from the camera to the mean."""
    from_camera = means - _like(means, camera.world_from_cam.translation_m)
    directions = functional.normalize(from_camera, dim=-1)
    basis = spherical_harmonics(directions, degree=round(sh.shape[1] ** 0.5) - 1)
    return ((basis[..., None] * sh).sum(1) + 0.5).clamp(min=0.0)


def _touching(splats: _Splats, axis: int, start: int, length: int) -> Tensor:
    """Return the indices, in order, of the splats whose box meets ``start``..``start + length``."""
    centre, extent = splats.centre_px[:, axis].detach(), splats.extent_px[:, axis]
    return torch.nonzero((centre + extent > start) & (centre - extent < start + length)).squeeze(1)


def _pixel_centres(left: int, top: int, width: int, height: int, like: Tensor) -> Tensor:
    """Return [width * height, 2], row by row."""
    y = torch.arange(top, top + height, dtype=like.dtype, device=like.device) + 0.5
    x = torch.arange(left, left + width, dtype=like.dtype, device=like.device) + 0.5
    return torch.cartesian_prod(y, x).flip(-1)


def _composite(splats: _Splats, pixels: Tensor) -> Tensor:
    """Blend front to back (3DGS eq. 3): [P, 6] = colour; sums of w z and w of surfaces; sum of w.

    The weights w = alpha T telescope: the last sum is 1 - final transmittance. A Gaussian whose
    alpha is under 1/255 is skipped; the first one that would leave 1e-4 of the light or less ends
    the pixel without being drawn.
    """
    d = pixels[:, None, :] - splats.centre_px[None]
    xx, xy, yy = splats.conic.unbind(-1)
    power = 0.5 * (xx * d[..., 0] ** 2 + yy * d[..., 1] ** 2) + xy * d[..., 0] * d[..., 1]
    alpha = (splats.opacity * torch.exp(-power)).clamp(max=MAX_ALPHA)
    alpha = torch.where((alpha >= MIN_ALPHA) & (power >= 0), alpha, 0.0)
    after = torch.cumprod(1.0 - alpha, dim=1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], dim=1)
    drawn = after > MIN_TRANSMITTANCE
    weight = torch.where(drawn, alpha * before, 0.0)
    surface = (splats.depth_m <= SKY_M).to(weight.dtype)
    of_surfaces = torch.stack([surface * splats.depth_m, surface, torch.ones_like(surface)], dim=1)
    return weight @ torch.cat([splats.colour, of_surfaces], dim=1)


def _mean_depth(weighted_m: Tensor, opacity: Tensor) -> Tensor:
    """Divide the sum of w z by the sum of w; 0 where nothing was hit."""
    hit = opacity > 0
    return torch.where(hit, weighted_m / torch.where(hit, opacity, 1.0), 0.0)


def _ssim_map(a: Tensor, b: Tensor) -> Tensor:
    """Return SSIM [3, H, W] of two [H, W, 3] pictures (Wang et al. 2004, eq. 13), zero padded."""
    a, b = a.permute(2, 0, 1), b.permute(2, 0, 1)
    mean_a, mean_b, aa, bb, ab = _blur(torch.stack([a, b, a * a, b * b, a * b]))
    var_a, var_b, cov = aa - mean_a**2, bb - mean_b**2, ab - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2 * mean_a * mean_b + c1) / (mean_a**2 + mean_b**2 + c1)
    return luminance * (2 * cov + c2) / (var_a + var_b + c2)


def _blur(stack: Tensor) -> Iterator[Tensor]:
    """Filter [5, 3, H, W] with the 11-tap Gaussian of sigma 1.5 along both axes."""
    taps = np.exp(-(np.arange(-5.0, 6.0) ** 2) / (2 * 1.5**2))
    kernel = _like(stack, taps / taps.sum())
    planes = stack.flatten(0, 1)[:, None]
    planes = functional.conv2d(planes, kernel[None, None, None, :], padding=(0, 5))
    planes = functional.conv2d(planes, kernel[None, None, :, None], padding=(5, 0))
    return iter(planes.reshape(stack.shape))
