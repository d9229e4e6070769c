"""A scene's plan in words: its pictures, its effects in their order, and what they cost."""

from __future__ import annotations

from collections.abc import Sequence

from rfedge.street.plan import PlannedEffect, RenderCost
from rfedge.street.scene_file import Scene

__all__ = ["effect_lines", "scene_lines"]


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
        f"  {effect.stage:<11} {effect.name}: {effect.why}; {_cost(effect, on_frames_ms, cost)}"
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
