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
from numpy.typing import NDArray

from rfcore.camera import Camera
from rfcore.errors import InvalidInput
from rfcore.native import _native
from rfcore.native.backend import check_backend
from rfcore.raster.gaussians import F32, MAX_GAUSSIANS, Gaussians, empty_arrays
from rfcore.raster.native import bands_to_use, native_camera, overlaps_limited
from rfcore.views import Mask, View

DEAD_LOGIT = -5.293305
"""An opacity of 0.005; less is invisible on an 8-bit display."""
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
    opacity_pull: float = 0.0
    """Regularisation: a visible Gaussian adds its opacity times this to the loss."""
    scale_pull: float = 0.0
    """Regularisation: each of its three scales in metres adds this times the scale."""

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


@dataclass(frozen=True)
class DensityStep:
    """One round of density control: the dead are replaced, ``added`` more join at the end.

    Every new Gaussian is split off one that is alive, drawn by its opacity (Kheradmand et al.
    2024, "MCMC") or, with ``by_gradient``, by the mean gradient of its centre in the picture since
    the last round (Kerbl et al. 2023, section 5.2). ``in_place`` leaves the parts where the
    original was, equal to it together (MCMC, eq. 9); otherwise they are halves, side by side
    along its longest axis. Moments of all that took part start anew.
    """

    added: int
    seed: int
    by_gradient: bool = False
    in_place: bool = True

    def __post_init__(self) -> None:
        if not 0 <= self.added <= MAX_GAUSSIANS:
            raise InvalidInput("density.added", f"{self.added} is outside 0..{MAX_GAUSSIANS}")
        if not 0 <= self.seed < 1 << 64:
            raise InvalidInput("density.seed", f"{self.seed} is outside 0..2^64")


@dataclass(frozen=True)
class Exposure:
    """An affine map of colours, float32 [3, 4], and the gradient of the loss by it, float64."""

    affine: F32
    gradient: NDArray[np.float64]

    def __post_init__(self) -> None:
        for name, dtype in (("affine", np.float32), ("gradient", np.float64)):
            array = getattr(self, name)
            if array.shape != (3, 4) or array.dtype != dtype or not array.flags.c_contiguous:
                raise InvalidInput(
                    f"exposure.{name}", f"must be contiguous {dtype.__name__} [3, 4]"
                )

    def mapped(self, colour: F32) -> F32:
        """Return the mapped picture [H, W, 3], to the bit as the kernel maps it."""
        a = self.affine
        red, green, blue = (colour[..., i, None] for i in range(3))
        return np.asarray(a[:, 0] * red + a[:, 1] * green + a[:, 2] * blue + a[:, 3])


@dataclass(frozen=True)
class TrainingState:
    """The complete state of a run: parameters, Adam's moments and powers, density scores.

    ``scores`` float32 [N, 2]: sum of the gradients of the centre, number of views.
    """

    gaussians: Gaussians
    first_moments: Gaussians
    second_moments: Gaussians
    scores: F32
    beta_powers: tuple[float, float]

    def __post_init__(self) -> None:
        n = len(self.gaussians)
        if not n == len(self.first_moments) == len(self.second_moments):
            raise InvalidInput("training state", "moments and parameters differ in number")
        if self.scores.shape != (n, 2) or self.scores.dtype != np.float32:
            raise InvalidInput("training state", f"scores {self.scores.shape} must be [{n}, 2]")
        if not all(0.0 <= power <= 1.0 for power in self.beta_powers):
            raise InvalidInput("training state", f"powers {self.beta_powers} are not in 0..1")


class TrainableRasterizer:
    """A set of Gaussians being optimised; the kernels hold parameters and Adam's moments.

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
        g = gaussians
        arrays = (g.means, g.quaternions, g.log_scales, g.opacity_logits, g.sh)
        self._native = _native.TrainableRasterizer(*arrays, threads, self.isa, antialiased)
        self._lock = Lock()
        self._colour: F32 | None = None
        self._has_colour_gradient = False
        self._has_gradients = False

    def __len__(self) -> int:
        return self._native.count

    def forward(self, camera: Camera, *, sh_degree: int | None = None) -> View:
        """Render ``camera`` with the bands up to ``sh_degree`` (default: all of them).

        The view's colour is read-only, because ``loss`` and ``backward`` use it.
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
        self,
        camera: Camera,
        target: F32,
        rates: LearningRates,
        *,
        sh_degree: int | None = None,
        exposure: Exposure | None = None,
        mask: Mask | None = None,
    ) -> float:
        """Run forward (colour only), loss, backward and one step of Adam; return the loss.

        With ``exposure`` the loss is that of the mapped picture, and its gradient is filled in.
        Outside ``mask`` bool [H, W] the target is what is rendered: nothing is learnt there.
        """
        colour = np.empty((camera.intrinsics.height_px, camera.intrinsics.width_px, 3), np.float32)
        _check_picture("target", target, colour)
        seen_from, degree = native_camera(camera), bands_to_use(sh_degree, self.sh_degree)
        with self._lock, overlaps_limited():
            self._forget()
            self._native.forward_colour(seen_from, degree, colour)
            if mask is not None:
                shown = colour if exposure is None else exposure.mapped(colour)
                target = np.where(mask[..., None], target, shown)
            if exposure is None:
                value = self._native.loss(colour, target, DSSIM_WEIGHT)
            else:
                value = self._native.exposed_loss(
                    colour, target, DSSIM_WEIGHT, exposure.affine, exposure.gradient
                )
            self._native.backward(colour)
            self._native.adam_step(astuple(rates))
        return value

    def gaussians(self) -> Gaussians:
        """Return the parameters as they are now, in the order of the kernels."""
        arrays = self._empty_arrays()
        with self._lock:
            self._native.parameters(*arrays.values())
        return Gaussians(**arrays)

    def keep_scores(self, keep: bool) -> None:
        """Choose whether steps record the scores that ``DensityStep.by_gradient`` needs."""
        self._native.keep_scores(keep)

    def control_density(self, step: DensityStep) -> int:
        """Replace the dead and add Gaussians; return how many were dead."""
        with self._lock:
            self._forget()
            return self._native.control_density(
                DEAD_LOGIT, step.added, step.by_gradient, step.in_place, step.seed
            )

    def perturb(self, strength: float, seed: int) -> None:
        """Move faint Gaussians at random, by up to ``strength`` of their deviations (MCMC, eq. 8).

        Opaque ones stay: the noise falls from a half at an opacity of 0.005 to 0.01 at 0.05.
        """
        if not 0 <= strength <= 100:
            raise InvalidInput("perturb.strength", f"{strength} is outside 0..100")
        with self._lock:
            self._native.perturb(strength, seed)

    def remove_dead(self) -> None:
        """Leave out the Gaussians that show nothing; the others keep their order."""
        with self._lock:
            self._forget()
            self._native.remove_dead(DEAD_LOGIT)

    def order_along_curve(self) -> None:
        """Sort the Gaussians along a Morton curve through space, with moments and scores.

        Most blocks of 16 are then wholly in view or wholly out; what is out costs nothing.
        """
        with self._lock:
            self._forget()
            self._native.order_along_curve()

    def state(self) -> TrainingState:
        """Return a copy of the complete state of the run."""
        first, second = self._empty_arrays(), self._empty_arrays()
        powers, scores = np.empty(2), np.empty((len(self), 2), np.float32)
        with self._lock:
            self._native.moments([*first.values()], [*second.values()], powers)
            self._native.scores(scores)
        moments = Gaussians(**first), Gaussians(**second)
        return TrainingState(
            self.gaussians(), *moments, scores, (float(powers[0]), float(powers[1]))
        )

    def set_optimiser(self, state: TrainingState) -> None:
        """Go on from the moments and scores of ``state``, which has as many Gaussians."""
        if len(state.gaussians) != len(self):
            raise InvalidInput(
                "training state", f"of {len(state.gaussians)} Gaussians, these are {len(self)}"
            )
        first, second = (
            [getattr(moments, f.name) for f in fields(Gaussians)]
            for moments in (state.first_moments, state.second_moments)
        )
        with self._lock:
            self._forget()
            self._native.set_moments(first, second, state.beta_powers)
            self._native.set_scores(state.scores)

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
        return empty_arrays(len(self), self.sh_degree)


def _check_picture(name: str, picture: F32, like: F32) -> None:
    if picture.shape != like.shape or picture.dtype != np.float32:
        raise InvalidInput(
            name, f"{picture.dtype} {picture.shape} must be float32 {like.shape} as the picture"
        )
    if not picture.flags.c_contiguous:
        raise InvalidInput(name, "must be C-contiguous; use numpy.ascontiguousarray")
    if not np.isfinite(picture).all():
        raise InvalidInput(name, "must be finite; find the NaN or infinity in the data")
