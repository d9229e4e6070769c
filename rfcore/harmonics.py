"""Real spherical harmonics of degree 0 to 3, in the order and signs of the INRIA implementation.

Y_lm with m = -l..l, Condon-Shortley phase in (Kerbl et al. 2023; Sloan, JCGT 2(2), 2013). Works on
the arrays of any library that has arithmetic: numpy's, torch's.
"""

from __future__ import annotations

from typing import Any

SH_DC = 0.28209479177387814
"""The constant harmonic of degree 0, sqrt(1 / (4 pi)): colour = 0.5 + SH_DC * coefficient."""


def higher_harmonics(x: Any, y: Any, z: Any) -> list[Any]:
    """Return the 15 harmonics of degree 1 to 3 of unit vectors given by their components."""
    xx, yy, zz = x * x, y * y, z * z
    return [
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * zz - xx - yy),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3 * xx - yy),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * zz - xx - yy),
        0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
        -0.4570457994644658 * x * (4 * zz - xx - yy),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3 * yy),
    ]
