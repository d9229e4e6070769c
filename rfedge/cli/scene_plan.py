"""``rfedge scene plan``: what a scene declares, and what its effects cost."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional

if TYPE_CHECKING:
    from rfedge.street.scene_file import Scene

__all__ = ["ScenePlan"]


@dataclass(frozen=True)
class ScenePlan:
    """Check scene files; print their pictures and the effects that will run, with measured cost."""

    scenes: Annotated[tuple[str, ...], Positional]
    """Ready-made scenes by name (samples/scenes), or scene files (.toml)."""

    render: bool = False
    """Render the street small, with and without each effect, and say what share of a frame each
    takes; needs rfedge[scene] and up to a minute for each effect."""
    json: Path | None = None
    """With --render: also write what was measured into this file."""
    page: Path | None = None
    """With --render: also put it as a table into this page, between its marks."""

    def run(self) -> None:
        """Print the plans."""
        from rfcore.errors import InvalidInput
        from rfedge.street import load_scene

        if not self.scenes:
            raise InvalidInput("scenes", "none is named; street-empty is one")
        if not self.render and (self.json or self.page):
            raise InvalidInput("json", "and page take what was rendered; add --render")
        scenes = [load_scene(name) for name in self.scenes]
        if self.render:
            self._measure(scenes)
        else:
            _print_plans(scenes)

    def _measure(self, scenes: list[Scene]) -> None:
        from time import process_time

        from rfedge.street.plan_table import measured_plans, write_page, write_rows
        from rfedge.street.plan_text import effect_lines, scene_lines
        from rfedge.street.render.backend import require_renderer

        require_renderer()
        rows = []
        for plan in measured_plans(scenes, process_time):
            print(*scene_lines(plan.scene), sep="\n")
            print(*effect_lines(plan.effects, plan.cost), sep="\n", flush=True)
            rows += plan.rows()
        if self.json is not None:
            write_rows(self.json, rows)
        if self.page is not None:
            write_page(self.page, rows)


def _print_plans(scenes: list[Scene]) -> None:
    from time import process_time

    from rfedge.street.plan import planned_effects
    from rfedge.street.plan_text import effect_lines, scene_lines

    for scene in scenes:
        print(*scene_lines(scene), sep="\n")
        print(*effect_lines(planned_effects(scene, process_time), None), sep="\n")
