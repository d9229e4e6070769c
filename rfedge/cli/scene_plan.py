"""``rfedge scene plan``: what a scene declares, and what its effects cost."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import Positional

__all__ = ["ScenePlan"]


@dataclass(frozen=True)
class ScenePlan:
    """Check a scene file; print its pictures and the effects that will run, with measured cost."""

    scene: Annotated[str, Positional]
    """A ready-made scene by name (samples/scenes), or a scene file (.toml)."""

    def run(self) -> None:
        """Print the plan."""
        from time import process_time

        from rfedge.street import load_scene
        from rfedge.street.plan import planned_effects

        scene = load_scene(self.scene)
        size_px = "{}x{}".format(*scene.drive.size_px)
        evaluated = scene.evaluation.stations * scene.rig.cameras
        print(f"{scene.name}: field of {scene.field}")
        print(
            f"  train       {scene.train.views} views of {'{}x{}'.format(*scene.train.size_px)} px"
        )
        print(
            f"  evaluation  {evaluated} views of {'{}x{}'.format(*scene.evaluation.size_px)} px "
            f"({scene.rig.cameras} cameras, {scene.evaluation.stations} stations)"
        )
        print(
            f"  drive       {scene.drive.frames} frames of {size_px} px, {scene.drive.rate_hz:g} Hz"
        )
        planned = planned_effects(scene, process_time)
        if not planned:
            print("  effects     none: pictures are as rendered")
        total_ms = sum(effect.cost_ms for effect in planned if effect.each_frame)
        for effect in planned:
            share = 100 * effect.cost_ms / total_ms if total_ms else 0.0
            cost = f"{effect.cost_ms:.1f} ms a frame, {share:.0f} % of all effects"
            if not effect.each_frame:
                cost = f"{effect.cost_ms:.0f} ms once, before the first frame"
            print(f"  {effect.stage:<11} {effect.name}: {effect.why}; {cost}")
