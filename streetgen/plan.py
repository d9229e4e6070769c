"""Say which effects a scene will run, and measure what each of them costs on this machine.

An effect on frames is timed on a plain frame of the drive's size. An effect on the street runs
once, before the first frame, and is timed on the scene's own street. What it adds to rendering is
the difference between small renders before and after it. That difference can be negative: a sky
without a sun needs fewer samples of light.

Shares are percentages of a whole frame of the drive with all effects.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rfcore.camera import Camera, Intrinsics, Pose
from rfedge.results import make_result, provenance, write_result
from streetgen.assembly import plain_world
from streetgen.effects import EFFECTS, Effect, rng_of
from streetgen.frame import LinearFrame
from streetgen.geometry.layout import Geometry
from streetgen.geometry.world import World
from streetgen.scene_file import DriveSettings, RigSettings, Scene

REPETITIONS = 5
FrameMs = Callable[[World], float]
"""A measure of the processor time that a frame of a world takes to render, ms."""


@dataclass(frozen=True)
class EffectCost:
    """An effect and its processor time: ``once_ms`` before the first frame, then each frame.

    ``frame_ms`` is None for an effect on the street whose street was not rendered.
    """

    effect: Effect
    once_ms: float
    frame_ms: float | None


@dataclass(frozen=True)
class ScenePlan:
    """A scene and its effects. ``plain_ms`` is what a frame without effects takes, if measured."""

    scene: Scene
    effects: tuple[EffectCost, ...]
    plain_ms: float | None = None

    def lines(self) -> list[str]:
        """Return a text of the pictures that the scene asks for, and a line for each effect."""
        train, evaluation, drive = self.scene.train, self.scene.evaluation, self.scene.drive
        cameras, stations = self.scene.rig.cameras, evaluation.stations
        lines = [
            f"{self.scene.name}: field of {self.scene.field}",
            f"  train       {train.views} views of {_size(train.size_px)} px",
            f"  evaluation  {stations * cameras} views of {_size(evaluation.size_px)} px "
            f"({cameras} cameras, {stations} stations)",
            f"  drive       {drive.frames} frames of {_size(drive.size_px)} px, "
            f"{drive.rate_hz:g} Hz",
        ]
        if self.plain_ms is not None:
            lines.append(
                f"  render      {self.plain_ms:.0f} ms a frame without effects, "
                f"{self._percent(self.plain_ms):.0f} % of it "
                "(4 samples a pixel, 320x180 scaled to the drive's pixels, one core)"
            )
        if not self.effects:
            lines.append("  effects     none: pictures are as rendered")
        for cost in self.effects:
            effect = cost.effect
            lines.append(f"  {effect.kind:<11} {effect.name}: {effect.why}; {self._text(cost)}")
        return lines

    def rows(self) -> list[dict[str, Any]]:
        """Return a row for the plain render and one for each effect; both must be measured."""
        assert self.plain_ms is not None
        rows = [self._row("", 0.0, self.plain_ms)]
        for cost in self.effects:
            assert cost.frame_ms is not None
            rows.append(self._row(cost.effect.name, cost.once_ms, cost.frame_ms))
        return rows

    def _row(self, effect: str, once_ms: float, frame_ms: float) -> dict[str, Any]:
        return {
            "scene": self.scene.name,
            "effect": effect,
            "once_ms": round(once_ms, 1),
            "frame_ms": round(frame_ms, 1),
            "share_percent": round(self._percent(frame_ms), 2),
        }

    def _text(self, cost: EffectCost) -> str:
        if cost.effect.on_frames:
            of = "it" if self.plain_ms is not None else "all effects on frames"
            digits = 1 if self.plain_ms is not None else 0
            assert cost.frame_ms is not None
            share = self._percent(cost.frame_ms)
            return f"{cost.frame_ms:.1f} ms a frame, {share:.{digits}f} % of {of}"
        once = f"{cost.once_ms:.0f} ms once, before the first frame"
        if cost.frame_ms is None:
            return once
        return (
            f"{once}; {cost.frame_ms:+.0f} ms a frame, {self._percent(cost.frame_ms):.1f} % of it"
        )

    def _percent(self, cost_ms: float) -> float:
        whole_ms = (self.plain_ms or 0.0) + sum(cost.frame_ms or 0.0 for cost in self.effects)
        return 100 * cost_ms / whole_ms if whole_ms else 0.0


class Planner:
    """Plans scenes one after another; scenes of the same street share its plain render.

    ``cpu_s`` reads processor time. ``render`` returns a scene's measure of a frame; without it
    nothing is rendered.
    """

    def __init__(
        self, cpu_s: Callable[[], float], render: Callable[[Scene], FrameMs] | None = None
    ) -> None:
        self._cpu_s = cpu_s
        self._render = render
        self._worlds: dict[Geometry, World] = {}
        self._plain_ms: dict[tuple[Geometry, RigSettings, DriveSettings], float] = {}

    def plan(self, scene: Scene) -> ScenePlan:
        """Run each declared effect and return what it took."""
        declared = [effect for effect in EFFECTS if effect.name in scene.effects]
        frame_ms = None if self._render is None else self._render(scene)
        plain_ms = None if frame_ms is None else self._plain(scene, frame_ms)
        changes = [effect for effect in declared if not effect.on_frames]
        costs = self._changes(scene, changes, frame_ms, plain_ms) if changes else []
        frame = plain_frame(*scene.drive.size_px, scene.rig.fov_deg)
        costs += [
            EffectCost(effect, 0.0, self._apply_ms(scene, effect, frame))
            for effect in declared
            if effect.on_frames
        ]
        return ScenePlan(scene, tuple(costs), plain_ms)

    def _world(self, scene: Scene) -> World:
        if scene.geometry not in self._worlds:
            self._worlds[scene.geometry] = plain_world(scene)
        return self._worlds[scene.geometry]

    def _plain(self, scene: Scene, frame_ms: FrameMs) -> float:
        key = (scene.geometry, scene.rig, scene.drive)
        if key not in self._plain_ms:
            self._plain_ms[key] = frame_ms(self._world(scene))
        return self._plain_ms[key]

    def _changes(
        self,
        scene: Scene,
        effects: Sequence[Effect],
        frame_ms: FrameMs | None,
        plain_ms: float | None,
    ) -> list[EffectCost]:
        """Change the scene's street by one effect after the other, and render it in between."""
        world, before_ms, costs = self._world(scene), plain_ms, []
        for effect in effects:
            start_s = self._cpu_s()
            world = scene.effects[effect.name].change(world, rng_of(effect, scene.geometry.seed, 0))
            once_ms, added_ms = 1e3 * (self._cpu_s() - start_s), None
            if frame_ms is not None and before_ms is not None:
                after_ms = frame_ms(world)
                added_ms, before_ms = after_ms - before_ms, after_ms
            costs.append(EffectCost(effect, once_ms, added_ms))
        return costs

    def _apply_ms(self, scene: Scene, effect: Effect, frame: LinearFrame) -> float:
        times_s = []
        for i in range(REPETITIONS):
            start_s = self._cpu_s()
            scene.effects[effect.name].apply(frame, rng_of(effect, scene.geometry.seed, i))
            times_s.append(self._cpu_s() - start_s)
        return 1e3 * statistics.median(times_s)


def plain_frame(width_px: int, height_px: int, fov_deg: float) -> LinearFrame:
    """Return a road under a sky, seen by a level camera 1.5 m above it that drives at 10 m/s."""
    focal_px = width_px / (2 * np.tan(np.radians(fov_deg) / 2))
    k = Intrinsics(width_px, height_px, focal_px, focal_px, width_px / 2, height_px / 2)
    rows = np.arange(height_px) + 0.5 - k.cy_px
    depth_m = np.where(rows > 0, 1.5 * k.fy_px / np.maximum(rows, 1e-6), np.inf)
    columns = np.ones(width_px, np.float32)
    grey = np.where(rows > 0, 0.2, 0.7).astype(np.float32)
    return LinearFrame(
        colour=np.repeat((grey[:, None] * columns)[..., None], 3, axis=2),
        depth_m=(depth_m[:, None] * columns).astype(np.float32),
        camera=Camera(k, Pose.identity()),
        velocity_mps=(0.0, 0.0, 10.0),
    )


SIZE_PX = (320, 180)
SAMPLES = 4
FRAMES = 3


def small_render_ms(scene: Scene, cpu_s: Callable[[], float]) -> FrameMs:
    """Return a measure of a world: the median of 3 frames of 320x180, 4 samples a pixel.

    It is scaled to the pixels of the drive's frames, except for the time that moving vehicles take;
    samples are not scaled.
    """
    from streetgen.render.backend import chosen_backend
    from streetgen.render.renderer import PathTracer, Sampling
    from streetgen.shots import Split, shots_of

    shots = shots_of(scene, Split.DRIVE, SIZE_PX)[: FRAMES + 1]
    width_px, height_px = scene.drive.size_px
    scale = width_px * height_px / (SIZE_PX[0] * SIZE_PX[1])
    backend = chosen_backend()

    def frame_ms(world: World) -> float:
        renderer = PathTracer(world, Sampling(SAMPLES), backend, threads=1)
        times_s = []
        for shot in shots:
            start_s = cpu_s()
            renderer.at(shot.time_s)
            placed_s = cpu_s()
            renderer.render(shot.camera, shot.time_s)
            times_s.append(placed_s - start_s + scale * (cpu_s() - placed_s))
        return 1e3 * statistics.median(times_s[1:] or times_s)

    return frame_ms


def write_rows(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write the rows with the command, the revision and the host that they come from."""
    made = provenance()
    write_result(path, make_result("scene-plan", made, {"rows": list(rows)}))


def _size(size_px: tuple[int, int]) -> str:
    return "{}x{}".format(*size_px)
