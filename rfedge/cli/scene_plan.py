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

    render: bool = False
    """Render the street small, with and without each effect, and say what share of a frame each
    takes; needs rfedge[scene] and up to a minute for each effect."""

    def run(self) -> None:
        """Print the plan."""
        from time import process_time

        from rfedge.street import load_scene
        from rfedge.street.plan import planned_effects
        from rfedge.street.plan_text import effect_lines, scene_lines

        scene = load_scene(self.scene)
        print(*scene_lines(scene), sep="\n")
        planned = planned_effects(scene, process_time)
        cost = None
        if self.render:
            from rfedge.street.plan_render import measured_render, small_render_ms
            from rfedge.street.render.backend import require_renderer

            require_renderer()
            cost = measured_render(scene, small_render_ms(scene, process_time))
        print(*effect_lines(planned, cost), sep="\n")
