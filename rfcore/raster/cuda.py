"""Splats on a CUDA device, by gsplat: for training and evaluation, never for what goes on the wire.

The function of ``rfcore.raster.reference`` in float32, held to it by the same tests as the native
kernels, where there is a device. Not bit-exact: order and contraction of sums are the device's own,
so a picture drawn here is never one end of a delta. Two further differences: gsplat's own ceiling
of an alpha (0.999 where the definition has 0.99) and its far plane at 1e10 m.

Needs the extra ``cuda`` (gsplat compiles its kernels when first used) and a CUDA build of torch.
Neither the vehicle nor the server imports this file.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rfcore.camera import Camera
from rfcore.errors import BackendUnavailable
from rfcore.raster import reference
from rfcore.raster.gaussians import F32, Gaussians
from rfcore.views import View

__all__ = ["CudaRasterizer", "render", "require_cuda"]

Pictures = tuple[Tensor, Tensor, Tensor]


def require_cuda() -> ModuleType:
    """Return gsplat; raise ``BackendUnavailable`` without a CUDA device or without gsplat."""
    if not torch.cuda.is_available():
        raise BackendUnavailable("no CUDA device; the native rasterizer needs none")
    try:
        import gsplat
    except ImportError as error:
        raise BackendUnavailable("gsplat is not installed: pip install 'rfedge[cuda]'") from error
    module: ModuleType = gsplat
    return module


def render(params: Mapping[str, Tensor], camera: Camera, *, antialiased: bool = False) -> Pictures:
    """Render colour [H, W, 3], depth [H, W] in metres and opacity [H, W], differentiable.

    ``params`` as for ``reference.render``, float32 tensors on a CUDA device.
    """
    gsplat, k = require_cuda(), camera.intrinsics
    like = params["means"]
    pictures, opacity, _ = gsplat.rasterization(
        means=like,
        quats=params["quaternions"],
        scales=params["log_scales"].exp(),
        opacities=torch.sigmoid(params["opacity_logits"]),
        colors=params["sh"],
        viewmats=_on_device_of(like, _cam_from_world(camera))[None],
        Ks=_on_device_of(like, _intrinsics(camera))[None],
        width=k.width_px,
        height=k.height_px,
        near_plane=reference.NEAR_M,
        eps2d=reference.DILATION_PX2,
        sh_degree=round(params["sh"].shape[1] ** 0.5) - 1,
        packed=False,
        render_mode="RGB+ED",
        rasterize_mode="antialiased" if antialiased else "classic",
    )
    hit = opacity[0, ..., 0]
    depth = torch.where(hit > 0, pictures[0, ..., 3], 0.0)
    return pictures[0, ..., :3], depth, hit


class CudaRasterizer:
    """A copy of one set of Gaussians on a CUDA device, called as the native ``Rasterizer`` is.

    Raises ``BackendUnavailable`` without a device or without gsplat.
    """

    def __init__(
        self, gaussians: Gaussians, *, antialiased: bool = False, device: str = "cuda"
    ) -> None:
        require_cuda()
        self.antialiased = antialiased
        self._params = reference.parameters(gaussians, torch.float32, device=device)

    def render(self, camera: Camera) -> View:
        """Render colour, depth and opacity from ``camera``."""
        with torch.no_grad():
            pictures = render(self._params, camera, antialiased=self.antialiased)
        return View(*(np.ascontiguousarray(picture.cpu().numpy()) for picture in pictures))

    def render_colour(self, camera: Camera) -> F32:
        """Render colour [H, W, 3] alone; costs what ``render`` does."""
        return self.render(camera).colour


def _cam_from_world(camera: Camera) -> Any:
    pose = camera.cam_from_world()
    rows = zip(pose.rotation_matrix(), pose.translation_m, strict=True)
    return [*([*row, t] for row, t in rows), [0.0, 0.0, 0.0, 1.0]]


def _intrinsics(camera: Camera) -> Any:
    k = camera.intrinsics
    return [[k.fx_px, 0.0, k.cx_px], [0.0, k.fy_px, k.cy_px], [0.0, 0.0, 1.0]]


def _on_device_of(like: Tensor, values: Any) -> Tensor:
    return torch.tensor(values, dtype=like.dtype, device=like.device)
