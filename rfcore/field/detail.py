"""Which splats a quality draws.

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
from rfcore.field.quality import DETAILS
from rfcore.raster.gaussians import F32, Gaussians

__all__ = ["Rung", "Rungs", "check_rungs", "kept_of", "splats_of_rung"]


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
