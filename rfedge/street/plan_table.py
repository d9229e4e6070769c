"""Measured plans of several scenes: rows of a result file, and a table in a page.

The table stands between two marks, so that its figures are generated, never typed.
"""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rfcore.errors import InvalidInput
from rfcore.files import write_whole
from rfedge.provenance import host, revision
from rfedge.street.plan import PlannedEffect, RenderCost, planned_effects
from rfedge.street.plan_render import PlainStreets, measured_render, small_render_ms
from rfedge.street.scene_file import Scene

__all__ = ["MeasuredPlan", "measured_plans", "plan_table", "write_page", "write_rows"]

BEGIN, END = "<!-- scene plan: generated -->", "<!-- end of scene plan -->"
HEAD = (
    "| scene | effect | once, ms | a frame, ms | share of a frame |",
    "|---|---|---:|---:|---:|",
)

Row = Mapping[str, Any]


@dataclass(frozen=True)
class MeasuredPlan:
    """A scene, its effects, and what rendering takes."""

    scene: Scene
    effects: tuple[PlannedEffect, ...]
    cost: RenderCost

    def rows(self) -> list[dict[str, Any]]:
        """Return the plain render, then each effect: its share is of a frame with all of them."""
        rows = [self._row("", 0.0, self.cost.plain_ms)]
        for effect in self.effects:
            if effect.each_frame:
                rows.append(self._row(effect.name, 0.0, effect.cost_ms))
            else:
                added_ms = self.cost.added_ms[effect.name]
                rows.append(self._row(effect.name, effect.cost_ms, added_ms))
        return rows

    def _row(self, effect: str, once_ms: float, frame_ms: float) -> dict[str, Any]:
        on_frames_ms = sum(effect.cost_ms for effect in self.effects if effect.each_frame)
        return {
            "scene": self.scene.name,
            "effect": effect,
            "once_ms": round(once_ms, 1),
            "frame_ms": round(frame_ms, 1),
            "share_percent": round(self.cost.share_percent(frame_ms, on_frames_ms), 2),
        }


def measured_plans(scenes: Sequence[Scene], cpu_s: Callable[[], float]) -> Iterator[MeasuredPlan]:
    """Measure one scene after the other; ``cpu_s`` reads processor time."""
    streets = PlainStreets()
    for scene in scenes:
        cost = measured_render(scene, small_render_ms(scene, cpu_s), streets)
        yield MeasuredPlan(scene, planned_effects(scene, cpu_s, streets.world), cost)


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write the rows with the command, the revision and the host that they come from."""
    result = {
        "case": "scene-plan",
        "command": shlex.join(["rfedge", *sys.argv[1:]]),
        "revision": revision(),
        "host": host(),
        "rows": list(rows),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, json.dumps(result, indent=1) + "\n")


def plan_table(rows: Sequence[Row]) -> str:
    """Return the rows as a table in Markdown; the plain render has no effect's name."""
    lines = [
        f"| `{row['scene']}` | {row['effect'] or 'render without effects'} | {row['once_ms']:.0f} "
        f"| {row['frame_ms']:.0f} | {row['share_percent']:.1f} % |"
        for row in rows
    ]
    return "\n".join([*HEAD, *lines])


def write_page(path: Path, rows: Sequence[Row]) -> None:
    """Replace the table in a page; raise ``InvalidInput`` for one without its marks."""
    before, begin, rest = path.read_text(encoding="utf-8").partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise InvalidInput("page", f"{path} has no '{BEGIN}' followed by '{END}'")
    write_whole(path, f"{before}{BEGIN}\n\n{plan_table(rows)}\n\n{END}{after}")
