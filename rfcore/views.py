"""Rendered views of a radiance field, posed pictures, and points of the scene.

Readers of datasets produce posed pictures, trainers consume them. Renderers produce a ``View``;
both ends of the codec use it in the form of a ``FieldView``.

Confidence says how far a rendered pixel can be trusted. It follows from depth and opacity alone:
``confidence = opacity * (1 - min(bend / BEND_LIMIT, 1))``. ``opacity`` is clipped to 0..1: where
rays pass through, the field has no surface. ``bend`` is how far inverse depth w = 1 / z departs
from a plane,

    bend = max over both image axes of |w(i-1) - 2 w(i) + w(i+1)| / max(w(i-1), w(i), w(i+1)),

0 on any plane, however oblique (inverse depth is affine in the picture there), and near 1 where a
close object borders on a distant one. A pixel at the border takes the bend of its neighbour inside;
along an axis of one or two pixels nothing bends.

Only float32 subtraction, multiplication, division, minimum and maximum, each rounded once as
IEEE 754 prescribes: the same bytes on every machine.

A device that rendered a view may keep its depth and opacity. A ``HeldFieldView`` copies them to the
CPU at the first request, and until then refers to the device's memory.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfcore.image import I420

BEND_LIMIT = np.float32(0.1)
"""A break of a tenth of the nearer side's inverse depth leaves no confidence.

Measured on the held-out drive of the first sample (27.1 dB): the error of pixels with confidence
below 0.001 / 0.25 / 0.5 / 0.75 / 0.9 / above is 0.082 / 0.065 / 0.062 / 0.061 / 0.048 / 0.032 RMS.
"""
NOTHING_M = np.float32(1e-6)
"""Depths up to this mean that nothing was hit; no renderer draws so near."""
F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]


def confidence(depth_m: F32, opacity: F32) -> F32:
    """Return the confidence float32 [H, W], 0..1, of depth (0: nothing hit) and opacity [H, W]."""
    inverse = np.zeros_like(depth_m)
    np.divide(np.float32(1), depth_m, out=inverse, where=depth_m > NOTHING_M)
    bend = np.maximum(_bend(inverse), _bend(inverse.T).T)
    kept = np.float32(1) - np.minimum(bend / BEND_LIMIT, np.float32(1))
    return np.ascontiguousarray(np.clip(opacity, np.float32(0), np.float32(1)) * kept)


def _bend(inverse: F32) -> F32:
    """Return the relative second difference along the last axis."""
    bend = np.zeros_like(inverse)
    if inverse.shape[1] < 3:
        return bend
    before, here, after = inverse[:, :-2], inverse[:, 1:-1], inverse[:, 2:]
    second = np.abs((before - here) + (after - here))
    nearest = np.maximum(np.maximum(before, here), after)
    np.divide(second, nearest, out=bend[:, 1:-1], where=nearest > 0)
    bend[:, 0], bend[:, -1] = bend[:, 1], bend[:, -2]
    return bend


@dataclass(frozen=True)
class View:
    """A rendered view of a radiance field.

    ``colour`` float32 [H, W, 3], display-referred RGB, nominally 0..1 (not clamped);
    ``depth`` float32 [H, W], alpha-weighted mean z of surfaces in metres, 0 where nothing was hit,
    10 km where more is sky; ``opacity`` float32 [H, W], 0..1, the share of what has that depth;
    ``confidence`` float32 [H, W], 0..1, how far a pixel can be trusted (see the module), computed
    at the first request.
    """

    colour: NDArray[np.float32]
    depth: NDArray[np.float32]
    opacity: NDArray[np.float32]

    @cached_property
    def confidence(self) -> NDArray[np.float32]:
        """Opacity, reduced where depth is discontinuous."""
        return confidence(self.depth, self.opacity)


@dataclass(frozen=True, eq=False)
class FieldView:
    """A radiance field's view at a camera, in the form that both ends of the codec use.

    ``render``: the colours as a codec picture. ``depth``: float32 [H, W], z in metres, 0 where
    nothing was hit. ``opacity``: float32 [H, W], or ``None`` if it was dropped because it is not
    needed any more. Raises ``InvalidInput`` for a render, depth or opacity that is not
    of the camera's size, an array that is not float32, or a depth that is not finite.
    """

    camera: Camera
    render: I420
    depth: F32
    opacity: F32 | None = None

    def __post_init__(self) -> None:
        k = self.camera.intrinsics
        size_px = (k.width_px, k.height_px)
        if self.render.size_px != size_px:
            raise InvalidInput("render", f"{self.render.size_px} px of a camera of {size_px} px")
        for name, array in (("depth", self.depth), ("opacity", self.opacity)):
            if array is not None and (array.shape != size_px[::-1] or array.dtype != np.float32):
                raise InvalidInput(
                    name, f"{array.dtype} {array.shape} must be float32 {size_px[::-1]}"
                )
        if not np.isfinite(self.depth).all():
            bad = int((~np.isfinite(self.depth)).sum())
            raise InvalidInput("depth", f"{bad} of {self.depth.size} values are NaN or infinite")

    @staticmethod
    def nothing(intrinsics: Intrinsics) -> FieldView:
        """Return the view of a camera whose pose is unknown: grey, without depth and opacity."""
        shape = (intrinsics.height_px, intrinsics.width_px)
        nowhere = np.zeros(shape, np.float32)
        grey = I420.filled(shape[::-1])
        return FieldView(Camera(intrinsics, Pose.identity()), grey, nowhere, nowhere)

    @property
    def held_depth(self) -> HeldPlane | None:
        """The device's plane of depth, if a device holds it."""
        return None

    def under(self, render: I420) -> FieldView:
        """Return the view with ``render``, its own render under another light."""
        return replace(self, render=render)

    def without_opacity(self) -> FieldView:
        """Return the view without opacity, for users that do not need it."""
        return replace(self, opacity=None)

    @property
    def confidence(self) -> F32:
        """Opacity, reduced where depth is discontinuous; raises as ``kept_opacity``."""
        return confidence(self.depth, self.kept_opacity)

    def covers(self, least_opacity: float) -> NDArray[np.bool_]:
        """Return where opacity is above ``least_opacity``; raises as ``kept_opacity``."""
        return self.kept_opacity > least_opacity

    @property
    def kept_opacity(self) -> F32:
        """Opacity; raises ``InvalidInput`` if it was dropped."""
        if self.opacity is None:
            raise InvalidInput("opacity", "was dropped from this view; render it again")
        return self.opacity


class HeldPlane(Protocol):
    """Depth or opacity of a view, float32 [H, W], in a device's memory. Depth is finite."""

    def array(self) -> F32:
        """Return the plane on the CPU; any thread may call this."""

    def carry(
        self, previous: I420, minus: I420 | None, before: FieldView, now: FieldView
    ) -> I420 | None:
        """Return the result of ``warp_i420`` or, with ``minus``, of ``correct_i420``
        (``rfcore.native.warp``), with this plane as the depth of ``now``; ``None`` if the CPU has
        to compute it."""


class HeldFieldView(FieldView):
    """A view whose depth and opacity are in a device's memory until the first request.

    It is made by ``of``. ``dataclasses.replace`` turns it into an ordinary ``FieldView``.
    """

    _depth: HeldPlane | None = None
    _opacity: HeldPlane | None = None

    @staticmethod
    def of(
        camera: Camera, render: I420, depth: HeldPlane, opacity: HeldPlane | None
    ) -> HeldFieldView:
        """Return a view of planes that are of the camera's size, as ``render`` is."""
        view = object.__new__(HeldFieldView)
        vars(view).update(camera=camera, render=render, _depth=depth, _opacity=opacity)
        return view

    @cached_property
    def depth(self) -> F32:
        """z in metres [H, W], 0 where nothing was hit."""
        assert self._depth is not None
        return self._depth.array()

    @cached_property
    def opacity(self) -> F32 | None:
        """Opacity [H, W], ``None`` where it was dropped."""
        return None if self._opacity is None else self._opacity.array()

    @property
    def held_depth(self) -> HeldPlane | None:
        """The device's plane of depth."""
        return self._depth

    def under(self, render: I420) -> FieldView:
        """Return the view with ``render``, its own render under another light."""
        if self._depth is None:
            return super().under(render)
        return HeldFieldView.of(self.camera, render, self._depth, self._opacity)

    def without_opacity(self) -> FieldView:
        """Return the view without opacity, for users that do not need it."""
        if self._depth is None:
            return super().without_opacity()
        return HeldFieldView.of(self.camera, self.render, self._depth, None)


@dataclass(frozen=True)
class PosedPicture:
    """A picture with the camera that took it; its pixels are read on request.

    ``read`` returns uint8 [H, W, 3] RGB of exactly the camera's size, ``mask`` bool [H, W]: which
    pixels are learnt and measured; ``None`` stands for all of them.
    """

    name: str
    camera: Camera
    read: Callable[[], NDArray[np.uint8]]
    time_ns: int = 0
    mask: Callable[[], Mask] | None = None

    def read_mask(self) -> Mask | None:
        """Return which pixels count, ``None`` for all of them."""
        return None if self.mask is None else self.mask()


def spread(pictures: Sequence[PosedPicture], most: int) -> list[PosedPicture]:
    """Return at most ``most`` of the pictures, evenly over all of them."""
    if len(pictures) <= most:
        return list(pictures)
    return [pictures[i] for i in np.linspace(0, len(pictures) - 1, most).round().astype(int)]


@dataclass(frozen=True)
class PointCloud:
    """Surface points with colour: ``xyz_m`` float32 [N, 3] tile-relative, ``rgb`` uint8 [N, 3]."""

    xyz_m: NDArray[np.float32]
    rgb: NDArray[np.uint8]

    def __post_init__(self) -> None:
        n = len(self.xyz_m)
        if self.xyz_m.shape != (n, 3) or self.rgb.shape != (n, 3):
            raise InvalidInput(
                "points",
                f"shapes {self.xyz_m.shape} and {self.rgb.shape} must both be [N, 3]",
            )
        if not np.isfinite(self.xyz_m).all():
            bad = int((~np.isfinite(self.xyz_m)).any(axis=1).sum())
            raise InvalidInput("points.xyz_m", f"{bad} of {n} points are not finite")
