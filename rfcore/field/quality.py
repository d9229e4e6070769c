"""Settings of rendering that trade accuracy for time, in the same way on both ends.

A ``Quality`` is sent with each frame; the same field, camera and quality give the same bytes
everywhere. Each kind of field uses the settings that apply to it and ignores the others.

Of N splats, the level ``detail`` draws the first ``ceil(detail * N)`` in the archive's order, so
that every level of detail is a prefix of the next; the product is taken in whole numbers. An
archive may have scales and opacities for a level, which replace the field's: fewer splats have to
be wider and denser to leave no gaps (``rfcore.train.levels`` fits them and has measurements).
Nothing is computed: the same splats on every machine.

At a scale of a half a picture is rendered at half its width and height and enlarged, for a quarter
of the pixels. Pixel centres are at +0.5, so a half-size pixel k covers pixels 2k and 2k + 1, and
pixel i lies at (i + 0.5) / 2 in half-size coordinates: a quarter from one half-size centre and
three quarters from the next. Colour and opacity are interpolated so, in float32, first down the
columns and then along the rows, ``0.75 near + 0.25 far`` without fused operations: the same bytes
on every machine. The edge is repeated. Depth is not interpolated, since a mean of two surfaces is
no surface; a pixel has that of the half-size pixel it lies in. Of odd sides the half-size camera
sees half a pixel more.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace

import numpy as np

from rfcore.camera import Camera, Intrinsics
from rfcore.errors import InvalidInput
from rfcore.raster.gaussians import F32, Gaussians
from rfcore.views import View

DETAILS = (1.0, 0.5, 0.25, 0.1)
"""The shares of a field's splats that can be drawn. A fixed list, so that every level has one
definition and a field keeps at most four sets."""
SCALES = (1.0, 0.5)
"""Scales that a picture can be rendered at (``rfcore.field.quality``)."""
MAX_SH_DEGREE = 3
MAX_SAMPLES_PER_RAY = 4096


@dataclass(frozen=True)
class Quality:
    """Quality at which a field is drawn; raises ``InvalidInput`` for values out of range."""

    detail: float = 1.0
    """Share of the splats: 1, 0.5, 0.25 or 0.1, the most important ones first."""
    sh_degree: int | None = None
    """Highest degree of spherical harmonics evaluated, 0..3; a field of a lower degree is drawn
    with all it has. ``None``: all it has."""
    samples_per_ray: int | None = None
    """Samples along a ray (hash grid fields only), 1..4096; ``None``: the field's own."""
    scale: float = 1.0
    """1, or 0.5: rendered at half the width and height, and enlarged."""

    def __post_init__(self) -> None:
        if self.detail not in DETAILS:
            raise InvalidInput(
                "quality.detail",
                f"{self.detail} is none of {', '.join(f'{share:g}' for share in DETAILS)}",
            )
        if self.scale not in SCALES:
            raise InvalidInput("quality.scale", f"{self.scale} is neither 1 nor 0.5")
        if self.sh_degree is not None and not 0 <= self.sh_degree <= MAX_SH_DEGREE:
            raise InvalidInput(
                "quality.sh_degree", f"{self.sh_degree} is outside 0..{MAX_SH_DEGREE}"
            )
        samples = self.samples_per_ray
        if samples is not None and not 1 <= samples <= MAX_SAMPLES_PER_RAY:
            raise InvalidInput(
                "quality.samples_per_ray", f"{samples} is outside 1..{MAX_SAMPLES_PER_RAY}"
            )


FULL = Quality()
"""Everything the field has."""


@dataclass(frozen=True)
class LevelOfDetail:
    """Scales and opacities of the K splats of one level of detail, in place of the field's.

    ``log_scales`` [K, 3] and ``opacity_logits`` [K] are float32, as in ``Gaussians``.
    """

    log_scales: F32
    opacity_logits: F32


@dataclass(frozen=True)
class Beginning:
    """A part of a field: its first splats, of ``count`` in all, which draw levels up to
    ``detail``."""

    count: int
    detail: float


LevelsOfDetail = Mapping[float, LevelOfDetail]
"""Levels by ``Quality.detail``; full detail has none, and others may be missing."""


def kept_of(count: int, detail: float) -> int:
    """Return how many of ``count`` splats the level ``detail`` draws."""
    return -(-count * round(detail * 100) // 100)


def splats_in(gaussians: Gaussians, part: slice) -> Gaussians:
    """Return a part of the splats without copying."""
    return Gaussians(**{f.name: getattr(gaussians, f.name)[part] for f in fields(Gaussians)})


def splats_at_detail(
    gaussians: Gaussians, levels: LevelsOfDetail, detail: float, count: int | None = None
) -> Gaussians:
    """Return the splats of one level of detail; for full detail, ``gaussians`` itself.

    ``count``: how many the whole field has, where ``gaussians`` are the first of them.
    """
    if detail == 1:
        return gaussians
    kept = kept_of(len(gaussians) if count is None else count, detail)
    prefix = splats_in(gaussians, slice(0, kept))
    own = levels.get(detail)
    if own is None:
        return prefix
    return replace(prefix, log_scales=own.log_scales, opacity_logits=own.opacity_logits)


def check_levels(gaussians: Gaussians, levels: LevelsOfDetail, count: int | None = None) -> None:
    """Raise ``InvalidInput`` unless every level has finite float32 values for its splats."""
    for detail, own in levels.items():
        if detail not in DETAILS[1:]:
            raise InvalidInput("field.detail", f"{detail} is none of {DETAILS[1:]}")
        try:
            splats_at_detail(gaussians, {detail: own}, detail, count)
        except InvalidInput as error:
            raise InvalidInput(f"field.detail {detail:g}", str(error)) from error


def view_at_scale(
    render: Callable[[Camera, Quality], View], camera: Camera, quality: Quality
) -> View:
    """Render at ``quality.scale``, and return the view in the size of ``camera``."""
    if quality.scale == 1:
        return render(camera, quality)
    small = render(_half(camera), replace(quality, scale=1.0))
    height, width = camera.intrinsics.height_px, camera.intrinsics.width_px
    depth = small.depth.repeat(2, axis=0).repeat(2, axis=1)[:height, :width]
    return View(
        _doubled(small.colour, height, width),
        np.ascontiguousarray(depth),
        _doubled(small.opacity, height, width),
    )


def colour_at_scale(
    render: Callable[[Camera, Quality], F32], camera: Camera, quality: Quality
) -> F32:
    """Return the colour of ``view_at_scale`` where ``render`` makes only colour."""
    if quality.scale == 1:
        return render(camera, quality)
    small = render(_half(camera), replace(quality, scale=1.0))
    return _doubled(small, camera.intrinsics.height_px, camera.intrinsics.width_px)


def _half(camera: Camera) -> Camera:
    k = camera.intrinsics
    half = Intrinsics(
        (k.width_px + 1) // 2,
        (k.height_px + 1) // 2,
        k.fx_px / 2,
        k.fy_px / 2,
        k.cx_px / 2,
        k.cy_px / 2,
    )
    return Camera(half, camera.world_from_cam)


def _doubled(picture: F32, height: int, width: int) -> F32:
    tall = _doubled_rows(picture, height)
    wide = _doubled_rows(tall.swapaxes(0, 1), width).swapaxes(0, 1)
    return np.ascontiguousarray(wide)


def _doubled_rows(picture: F32, count: int) -> F32:
    """Return twice the rows of ``picture``, the first ``count`` of them."""
    near = picture * np.float32(0.75)
    far = picture * np.float32(0.25)
    out = np.empty((2 * len(picture), *picture.shape[1:]), np.float32)
    out[0::2] = near
    out[1::2] = near
    out[2::2] += far[:-1]
    out[0] += far[0]
    out[1:-1:2] += far[1:]
    out[-1] += far[-1]
    return out[:count]
