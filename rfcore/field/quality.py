"""How much of a field is drawn: settings that trade accuracy for time, on both ends alike.

A ``Quality`` is a value that both ends of a session can name; the same field, camera and quality
give the same bytes everywhere. Each kind of field reads the settings it has and ignores the others.

Rung ``detail`` of N splats is the first ``ceil(detail * N)`` of them in the archive's order, so
that every rung is a prefix of the next; the product is taken in whole numbers. Where the archive
has scales and opacities of that rung's own, they stand in place of the field's: fewer splats have
to be wider and denser to leave no gaps (``rfcore.train.rungs`` fits them; what that is worth is
measured there). Nothing is computed: the same splats on every machine.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from rfcore.errors import InvalidInput
from rfcore.raster.gaussians import F32, Gaussians

__all__ = [
    "DETAILS",
    "FULL",
    "MAX_SAMPLES_PER_RAY",
    "MAX_SH_DEGREE",
    "SCALES",
    "Quality",
    "Rung",
    "Rungs",
    "check_rungs",
    "kept_of",
    "splats_of_rung",
]


DETAILS = (1.0, 0.5, 0.25, 0.1)
"""The shares of a field's splats that can be drawn. A fixed list, so that every rung has one
definition and a field keeps at most four sets."""
SCALES = (1.0, 0.5)
"""The sides a picture can be rendered at, of its own (``rfcore.field.scale``)."""
MAX_SH_DEGREE = 3
MAX_SAMPLES_PER_RAY = 4096


@dataclass(frozen=True)
class Quality:
    """One setting of the accuracy/time ladder; raises ``InvalidInput`` for one that is not."""

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
class Rung:
    """What the K splats of a rung have in place of the field's own.

    ``log_scales`` [K, 3] and ``opacity_logits`` [K] as in ``Gaussians``, float32.
    """

    log_scales: F32
    opacity_logits: F32


Rungs = Mapping[float, Rung]
"""By detail; full detail has none, and neither need the others."""


def kept_of(count: int, detail: float) -> int:
    """Return how many of ``count`` splats rung ``detail`` draws."""
    return -(-count * round(detail * 100) // 100)


def splats_of_rung(gaussians: Gaussians, rungs: Rungs, detail: float) -> Gaussians:
    """Return the splats of one rung; for full detail, ``gaussians`` itself."""
    if detail == 1:
        return gaussians
    kept = kept_of(len(gaussians), detail)
    prefix = Gaussians(
        means=gaussians.means[:kept],
        quaternions=gaussians.quaternions[:kept],
        log_scales=gaussians.log_scales[:kept],
        opacity_logits=gaussians.opacity_logits[:kept],
        sh=gaussians.sh[:kept],
    )
    own = rungs.get(detail)
    if own is None:
        return prefix
    return replace(prefix, log_scales=own.log_scales, opacity_logits=own.opacity_logits)


def check_rungs(gaussians: Gaussians, rungs: Rungs) -> None:
    """Raise ``InvalidInput`` unless every rung has finite float32 values for its splats."""
    for detail, own in rungs.items():
        if detail not in DETAILS[1:]:
            raise InvalidInput("field.detail", f"{detail} is none of {DETAILS[1:]}")
        try:
            splats_of_rung(gaussians, {detail: own}, detail)
        except InvalidInput as error:
            raise InvalidInput(f"field.detail {detail:g}", str(error)) from error
