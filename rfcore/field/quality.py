"""How much of a field is drawn: the knobs that trade accuracy for time, on both ends alike.

A quality is a value that both ends of a session can name; the same field, camera and quality give
the same bytes everywhere. Each kind of field reads the knobs it has and ignores the others.
"""

from __future__ import annotations

from dataclasses import dataclass

from rfcore.errors import InvalidInput

__all__ = ["DETAILS", "FULL", "MAX_SAMPLES_PER_RAY", "MAX_SH_DEGREE", "SCALES", "Quality"]

DETAILS = (1.0, 0.5, 0.25, 0.1)
"""The shares of a field's splats that can be drawn. A fixed list, so that every rung has one
definition (``rfcore.field.detail``) and a field keeps at most four sets."""

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
