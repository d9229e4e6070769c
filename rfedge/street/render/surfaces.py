"""Materials as Mitsuba's reflectance models, each seen from both sides.

``plastic`` is what makes glossy surfaces cheap: a mirror over paint needs no more samples than
paint does, where ``principled`` at a low roughness flickers and looks like clay.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rfedge.street.geometry.material import Material

__all__ = ["surface"]

MATT = 0.85
"""From this roughness on a dielectric's highlight is not worth its samples."""
GLASS_INDEX = 1.5


def surface(mi: Any, material: Material) -> dict[str, Any]:
    """Return the description that ``mi.load_dict`` takes."""
    both_sides = {"type": "twosided", "inner": _model(mi, material)}
    if material.transmission == 0:
        return both_sides
    return {"type": "mask", "opacity": 1.0 - material.transmission, "inner": both_sides}


def _model(mi: Any, material: Material) -> dict[str, Any]:
    colour = _colour(mi, material)
    if material.gloss:
        return {"type": "plastic", "diffuse_reflectance": colour, "int_ior": GLASS_INDEX}
    if material.metallic == 0 and np.min(material.roughness) >= MATT:
        return {"type": "diffuse", "reflectance": colour}
    return {
        "type": "principled",
        "base_color": colour,
        "roughness": _roughness(mi, material),
        "metallic": material.metallic,
        "specular": 0.5,
    }


def _colour(mi: Any, material: Material) -> dict[str, Any]:
    if not isinstance(material.colour, np.ndarray):
        return {"type": "rgb", "value": list(material.colour)}
    bitmap = mi.Bitmap(np.ascontiguousarray(material.colour))
    return {"type": "bitmap", "bitmap": bitmap, "raw": False, "filter_type": "bilinear"}


def _roughness(mi: Any, material: Material) -> Any:
    if not isinstance(material.roughness, np.ndarray):
        return float(material.roughness)
    bitmap = mi.Bitmap(np.ascontiguousarray(material.roughness[..., None]))
    return {"type": "bitmap", "bitmap": bitmap, "raw": True}
