"""What vehicles are made of. Paints are common colours of European cars, as linear reflectances."""

from __future__ import annotations

from functools import lru_cache

from rfedge.street.geometry.lettering import Lettered, atlas
from rfedge.street.geometry.mesh import Material

__all__ = ["LIVERIES", "PAINTS", "PLATES", "vehicle_materials"]

PAINTS = {
    "paint white": (0.78, 0.78, 0.76),
    "paint silver": (0.46, 0.47, 0.48),
    "paint grey": (0.13, 0.135, 0.14),
    "paint black": (0.012, 0.012, 0.014),
    "paint blue": (0.012, 0.045, 0.20),
    "paint light blue": (0.12, 0.26, 0.42),
    "paint red": (0.42, 0.012, 0.012),
    "paint green": (0.02, 0.085, 0.045),
    "paint beige": (0.42, 0.35, 0.24),
    "paint orange": (0.62, 0.16, 0.01),
}
PLATES = ("RF 1274", "GS 3081", "KX 5526", "MV 907 H", "BD 2468", "QP 51 L", "TU 7713", "NW 6640")
LIVERIES = ("NORDWIND", "Backhaus Emmer", "FLINK LOGISTIK", "Blumen Rosa")
LIVERY_COLOURS = (
    ((250, 250, 250), (24, 70, 130)),
    ((96, 42, 20), (240, 226, 190)),
    ((210, 30, 30), (244, 244, 244)),
    ((30, 110, 60), (245, 240, 236)),
)


@lru_cache(maxsize=1)
def vehicle_materials() -> tuple[Material, ...]:
    """Return all materials of all vehicles; the same objects at each call."""
    plates = tuple(Lettered(text, (20, 20, 24), (236, 236, 230)) for text in PLATES)
    liveries = tuple(
        Lettered(text, ink, paper, font=i, border=False)
        for i, (text, (ink, paper)) in enumerate(zip(LIVERIES, LIVERY_COLOURS, strict=True))
    )
    return (
        *(Material(name, colour, gloss=True) for name, colour in PAINTS.items()),
        Material("car glass", (0.016, 0.019, 0.021), gloss=True),
        Material("car trim", (0.018, 0.018, 0.019), roughness=0.5),
        Material("car gap", (0.006, 0.006, 0.006)),
        Material("car grille", (0.010, 0.010, 0.011), roughness=0.35),
        Material("car chrome", (0.62, 0.63, 0.65), roughness=0.18, metallic=1.0),
        Material("car lamp", (0.16, 0.17, 0.18), gloss=True),
        Material("car lamp light", (0.85, 0.87, 0.9), gloss=True),
        Material("car tail lamp", (0.24, 0.003, 0.004), gloss=True),
        Material("tyre", (0.022, 0.022, 0.023)),
        Material("rim", (0.52, 0.53, 0.55), roughness=0.28, metallic=0.9),
        Material("brake disc", (0.24, 0.23, 0.22), roughness=0.4, metallic=0.8),
        Material("number plate", atlas(plates, (416, 88)), roughness=0.4),
        Material("livery", atlas(liveries, (1024, 512)), roughness=0.35),
    )
