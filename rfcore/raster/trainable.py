"""Training on the native kernels: forward, loss, backward and Adam without leaving C++.

One iteration is ``forward``, ``loss``, ``backward``, ``adam_step``, in that order, or ``iterate``,
which does the four at once. Gradients are those of ``rfcore.raster.reference`` in float64 to
within rounding; like the pictures, they do not depend on instruction set or number of threads.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, fields
from threading import Lock

import numpy as np

from rfcore.camera import Camera
from rfcore.errors import InvalidInput
from rfcore.native.raster import (
    NativeTrainable,
    bands_to_use,
    check_backend,
    native_camera,
    overlaps_limited,
)
from rfcore.raster.gaussians import F32, Gaussians
from rfcore.views import View

__all__ = ["LearningRates", "TrainableRasterizer"]

DSSIM_WEIGHT = 0.2
"""Share of D-SSIM in the loss (Kerbl et al. 2023, eq. 7)."""


@dataclass(frozen=True)
class LearningRates:
    """Adam's rates per group of parameters (Kingma and Ba 2015), and its constants.

    Raises ``InvalidInput`` for a rate that is negative or not finite, a beta outside 0..1
    (1 excluded) or an epsilon that is not positive.
    """

    means: float
    """Metres per step."""
    log_scales: float = 5e-3
    quaternions: float = 1e-3
    opacity: float = 5e-2
    sh_dc: float = 2.5e-3
    sh_rest: float = 1.25e-4
    beta1: float = 0.9
    beta2: float = 0.999
    epsilon: float = 1e-15

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (math.isfinite(value) and value >= 0):
                raise InvalidInput(f"rates.{field.name}", f"{value} must be finite and at least 0")
        for name in ("beta1", "beta2"):
            if getattr(self, name) >= 1:
                raise InvalidInput(f"rates.{name}", f"{getattr(self, name)} must be below 1")
        if self.epsilon < 1e-30:
            raise InvalidInput("rates.epsilon", f"{self.epsilon} must be at least 1e-30")


class TrainableRasterizer:
    """A set of Gaussians being optimised; parameters and Adam's moments live in the kernels.

    Adam is sparse: a step moves the Gaussians that were visible in the last ``forward``, and only
    their moments decay. Gradients that are not finite or beyond 1e15 count as zero. One thread at
    a time drives it; a lock guards single calls, not the order of calls. ``isa``, ``threads`` and
    ``antialiased`` as in ``Rasterizer``.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        *,
        threads: int = 1,
        isa: str | None = None,
        antialiased: bool = False,
    ) -> None:
        self.isa = check_backend(threads, isa)
        self.threads = threads
        self.antialiased = antialiased
        self.sh_degree = gaussians.sh_degree
        self._count = len(gaussians)
        g = gaussians
        arrays = (g.means, g.quaternions, g.log_scales, g.opacity_logits, g.sh)
        self._native = NativeTrainable(*arrays, threads, self.isa, antialiased)
        self._lock = Lock()
        self._colour: F32 | None = None
        self._has_colour_gradient = False
        self._has_gradients = False

    def __len__(self) -> int:
        return self._count

    def forward(self, camera: Camera, *, sh_degree: int | None = None) -> View:
        """Render ``camera`` with the bands up to ``sh_degree`` (default: all of them).

        The view's colour is read-only: ``loss`` and ``backward`` go back to it.
        """
        shape = (camera.intrinsics.height_px, camera.intrinsics.width_px)
        view = View(*(np.empty(s, np.float32) for s in ((*shape, 3), shape, shape)))
        seen_from, degree = native_camera(camera), bands_to_use(sh_degree, self.sh_degree)
        with self._lock, overlaps_limited():
            self._forget()
            self._native.forward(seen_from, degree, view.colour, view.depth, view.opacity)
            view.colour.flags.writeable = False
            self._colour = view.colour
        return view

    def loss(self, target: F32, *, dssim_weight: float = DSSIM_WEIGHT) -> float:
        """Return (1 - w) L1 + w (1 - SSIM) of the last forward; keep its gradient for ``backward``.

        ``target`` float32 [H, W, 3]. Equal pictures give exactly 0.
        """
        colour = self._rendered()
        if not 0 <= dssim_weight <= 1:
            raise InvalidInput("dssim_weight", f"{dssim_weight} is outside 0..1")
        _check_picture("target", target, colour)
        with self._lock:
            value = self._native.loss(colour, target, dssim_weight)
            self._has_colour_gradient = True
        return value

    def backward(self, d_colour: F32 | None = None) -> None:
        """Carry the gradient of the loss, or ``d_colour`` [H, W, 3], back to the splats."""
        colour = self._rendered()
        with self._lock:
            if d_colour is not None:
                _check_picture("d_colour", d_colour, colour)
                self._native.set_colour_gradient(d_colour)
            elif not self._has_colour_gradient:
                raise InvalidInput("backward", "no gradient of the colour: call loss() first")
            self._native.backward(colour)
            self._has_gradients = True

    def gradients(self) -> dict[str, F32]:
        """Return the gradients after ``backward``, named and shaped as the fields of Gaussians."""
        self._check_gradients("gradients")
        arrays = self._empty_arrays()
        with self._lock:
            self._native.gradients(*arrays.values())
        return arrays

    def adam_step(self, rates: LearningRates) -> None:
        """Move the Gaussians that were visible by one step of Adam; consumes the gradients."""
        self._check_gradients("adam_step")
        with self._lock:
            self._native.adam_step(astuple(rates))
            self._forget()

    def iterate(
        self, camera: Camera, target: F32, rates: LearningRates, *, sh_degree: int | None = None
    ) -> float:
        """Run forward (colour only), loss, backward and one step of Adam; return the loss."""
        colour = np.empty((camera.intrinsics.height_px, camera.intrinsics.width_px, 3), np.float32)
        _check_picture("target", target, colour)
        seen_from, degree = native_camera(camera), bands_to_use(sh_degree, self.sh_degree)
        with self._lock, overlaps_limited():
            self._forget()
            self._native.forward_colour(seen_from, degree, colour)
            value = self._native.loss(colour, target, DSSIM_WEIGHT)
            self._native.backward(colour)
            self._native.adam_step(astuple(rates))
        return value

    def gaussians(self) -> Gaussians:
        """Return the parameters as they are now, in the order they came in."""
        arrays = self._empty_arrays()
        with self._lock:
            self._native.parameters(*arrays.values())
        return Gaussians(**arrays)

    def _forget(self) -> None:
        self._colour = None
        self._has_colour_gradient = self._has_gradients = False

    def _rendered(self) -> F32:
        if self._colour is None:
            raise InvalidInput("training", "no picture to go back from: call forward() first")
        return self._colour

    def _check_gradients(self, caller: str) -> None:
        if not self._has_gradients:
            raise InvalidInput(caller, "no gradients: call backward() first")

    def _empty_arrays(self) -> dict[str, F32]:
        n, coefficients = self._count, (self.sh_degree + 1) ** 2
        shapes = {
            "means": (n, 3),
            "quaternions": (n, 4),
            "log_scales": (n, 3),
            "opacity_logits": (n,),
            "sh": (n, coefficients, 3),
        }
        return {name: np.empty(shape, np.float32) for name, shape in shapes.items()}


def _check_picture(name: str, picture: F32, like: F32) -> None:
    if picture.shape != like.shape or picture.dtype != np.float32:
        raise InvalidInput(
            name, f"{picture.dtype} {picture.shape} must be float32 {like.shape} as the picture"
        )
    if not picture.flags.c_contiguous:
        raise InvalidInput(name, "must be C-contiguous; use numpy.ascontiguousarray")
    if not np.isfinite(picture).all():
        raise InvalidInput(name, "must be finite; find the NaN or infinity in the data")
