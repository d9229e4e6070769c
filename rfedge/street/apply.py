"""Running a scene's effects on a rendered frame, in the registry's order."""

from __future__ import annotations

from rfedge.street.effects import EFFECTS, rng_of
from rfedge.street.frame import LinearFrame
from rfedge.street.scene_file import Scene

__all__ = ["apply_effects"]


def apply_effects(scene: Scene, frame: LinearFrame, index: int) -> LinearFrame:
    """Return frame ``index`` as the scene's air and sensor make it; without effects, unchanged."""
    for effect in EFFECTS:
        if effect.on_frames and effect.name in scene.effects:
            rng = rng_of(effect, scene.geometry.seed, index)
            frame = scene.effects[effect.name].apply(frame, rng)
    return frame
