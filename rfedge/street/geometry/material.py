"""What surfaces are made of, without saying by which renderer.

Colours are linear reflectances; textures are 8-bit with the sRGB curve, as painted. ``gloss`` is a
clear, perfectly smooth layer over the colour: panes, car paint, enamel. It is what mirrors the
street without noise, where a rough surface of low roughness would need many samples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput

__all__ = ["Colour", "Material", "Texture"]

Colour = tuple[float, float, float]
Texture = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Material:
    """A surface seen from both sides.

    ``colour``: linear reflectance 0..1, or a texture uint8 [H, W, 3]. ``roughness`` 0.02..1, or a
    map float32 [H, W] of it on the same uv; at 0.85 and more a dielectric is simply matt.
    ``metallic`` 0..1. ``gloss``: whether a clear layer lies over the colour; ``roughness`` is then
    not used. ``transmission`` 0..1: the share of light that passes unbent.
    """

    name: str
    colour: Colour | Texture
    roughness: float | NDArray[np.float32] = 0.9
    metallic: float = 0.0
    gloss: bool = False
    transmission: float = 0.0

    def __post_init__(self) -> None:
        if isinstance(self.colour, np.ndarray):
            self._require_texture(self.colour)
        else:
            self._require_share("colour", np.array(self.colour))
        rough = np.asarray(self.roughness)
        self._require_share("roughness", rough)
        if rough.ndim not in (0, 2) or (rough.ndim == 2 and rough.dtype != np.float32):
            raise InvalidInput(
                f"material.{self.name}.roughness",
                f"is {rough.dtype} {rough.shape}, neither a number nor float32 [H, W]",
            )
        self._require_share("metallic", np.array(self.metallic))
        self._require_share("transmission", np.array(self.transmission))

    def _require_texture(self, texture: Texture) -> None:
        if texture.dtype != np.uint8 or texture.ndim != 3 or texture.shape[2] != 3:
            raise InvalidInput(
                f"material.{self.name}.colour",
                f"is {texture.dtype} {texture.shape}, not uint8 [H, W, 3]",
            )

    def _require_share(self, name: str, values: NDArray[np.generic]) -> None:
        numbers = values.astype(np.float64)
        if not ((numbers >= 0) & (numbers <= 1)).all():
            raise InvalidInput(f"material.{self.name}.{name}", f"is {values}, outside 0..1")
