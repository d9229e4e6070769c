"""Plans of scenes as text: lines for the terminal, rows of a result file, and a table in a page.

The table stands between two marks in the page, so that its figures are generated, never typed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rfcore.errors import InvalidInput
from rfcore.files import write_whole
from rfedge.results import make_result, provenance, write_result
from streetgen.plan import (
    PlainStreets,
    PlannedEffect,
    RenderCost,
    measured_render,
    planned_effects,
    small_render_ms,
)
from streetgen.scene_file import Scene

__all__ = [
    "MeasuredPlan",
    "effect_lines",
    "measured_plans",
    "plan_table",
    "scene_lines",
    "write_page",
    "write_rows",
]


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
    write_result(path, make_result("scene-plan", provenance(), {"rows": list(rows)}))


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


def scene_lines(scene: Scene) -> list[str]:
    """Return what pictures a scene asks for."""
    train, evaluation, drive = scene.train, scene.evaluation, scene.drive
    evaluated = evaluation.stations * scene.rig.cameras
    return [
        f"{scene.name}: field of {scene.field}",
        f"  train       {train.views} views of {_size(train.size_px)} px",
        f"  evaluation  {evaluated} views of {_size(evaluation.size_px)} px "
        f"({scene.rig.cameras} cameras, {evaluation.stations} stations)",
        f"  drive       {drive.frames} frames of {_size(drive.size_px)} px, {drive.rate_hz:g} Hz",
    ]


def effect_lines(planned: Sequence[PlannedEffect], cost: RenderCost | None) -> list[str]:
    """Return a line for each effect, and with ``cost`` its share of a whole frame."""
    lines = []
    on_frames_ms = sum(effect.cost_ms for effect in planned if effect.each_frame)
    if cost is not None:
        share = cost.share_percent(cost.plain_ms, on_frames_ms)
        lines.append(
            f"  render      {cost.plain_ms:.0f} ms a frame without effects, {share:.0f} % of it "
            "(4 samples a pixel, 320x180 scaled to the drive's pixels, one core)"
        )
    if not planned:
        lines.append("  effects     none: pictures are as rendered")
    lines += [
        f"  {effect.kind:<11} {effect.name}: {effect.why}; {_cost(effect, on_frames_ms, cost)}"
        for effect in planned
    ]
    return lines


def _cost(effect: PlannedEffect, on_frames_ms: float, cost: RenderCost | None) -> str:
    if not effect.each_frame:
        once = f"{effect.cost_ms:.0f} ms once, before the first frame"
        if cost is None:
            return once
        added_ms = cost.added_ms[effect.name]
        share = cost.share_percent(added_ms, on_frames_ms)
        return f"{once}; {added_ms:+.0f} ms a frame, {share:.1f} % of it"
    if cost is not None:
        share = cost.share_percent(effect.cost_ms, on_frames_ms)
        return f"{effect.cost_ms:.1f} ms a frame, {share:.1f} % of it"
    share = 100 * effect.cost_ms / on_frames_ms if on_frames_ms else 0.0
    return f"{effect.cost_ms:.1f} ms a frame, {share:.0f} % of all effects on frames"


def _size(size_px: tuple[int, int]) -> str:
    return "{}x{}".format(*size_px)
