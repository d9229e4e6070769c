"""What a scene will run, and what each effect costs, measured on this machine.

Effects on frames are timed on a plain frame of the drive's size. Effects on the street run once,
before the first frame; they are timed on the scene's own street, which is made only if there are
any. What an effect on the street adds to rendering is the difference between small renders before
and after it; the difference can be negative (a sky without a sun needs fewer samples of light).
Scenes with the same street share the plain render.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from rfcore.camera import Camera, Intrinsics, Pose
from streetgen.assembly import plain_world
from streetgen.effects import EFFECTS, Effect, EffectKind, rng_of
from streetgen.frame import LinearFrame
from streetgen.geometry.layout import Geometry
from streetgen.geometry.world import World
from streetgen.scene_file import Drive, Rig, Scene

__all__ = [
    "PlainStreets",
    "PlannedEffect",
    "RenderCost",
    "measured_render",
    "plain_frame",
    "planned_effects",
    "small_render_ms",
]


REPETITIONS = 5


@dataclass(frozen=True)
class PlannedEffect:
    """An effect that will run, with its settings and its median processor time.

    ``each_frame``: whether that is spent in every frame, or once before the first.
    """

    name: str
    kind: EffectKind
    why: str
    settings: object
    cost_ms: float
    each_frame: bool = True


@dataclass(frozen=True)
class RenderCost:
    """Processor milliseconds a frame of the drive: the plain street, and what each effect adds."""

    plain_ms: float
    added_ms: dict[str, float]

    def share_percent(self, cost_ms: float, frame_effects_ms: float) -> float:
        """Return a cost's share of a whole frame with all effects."""
        whole_ms = self.plain_ms + sum(self.added_ms.values()) + frame_effects_ms
        return 100.0 * cost_ms / whole_ms


def planned_effects(
    scene: Scene, cpu_s: Callable[[], float], world_of: Callable[[Scene], World] | None = None
) -> tuple[PlannedEffect, ...]:
    """Run each declared effect; ``cpu_s`` reads processor time.

    ``world_of`` gives a scene's street without effects, where the caller has it.
    """
    declared = [effect for effect in EFFECTS if effect.name in scene.effects]
    changes = [effect for effect in declared if not effect.on_frames]
    frame = plain_frame(*scene.drive.size_px, scene.rig.fov_deg)
    changed = _changed(scene, changes, cpu_s, world_of)
    planned = [_planned(scene, effect, cost_ms) for effect, cost_ms in changed]
    for effect in declared:
        if effect.on_frames:
            apply = scene.effects[effect.name].apply
            times_s = []
            for i in range(REPETITIONS):
                start_s = cpu_s()
                apply(frame, rng_of(effect, scene.geometry.seed, i))
                times_s.append(cpu_s() - start_s)
            planned.append(_planned(scene, effect, 1e3 * statistics.median(times_s)))
    return tuple(planned)


def _changed(
    scene: Scene,
    changes: Sequence[Effect],
    cpu_s: Callable[[], float],
    world_of: Callable[[Scene], World] | None,
) -> Iterator[tuple[Effect, float]]:
    """Change the scene's street by one effect after the other, in milliseconds each."""
    if not changes:
        return
    from streetgen.assembly import plain_world

    world = (world_of or plain_world)(scene)
    for effect in changes:
        start_s = cpu_s()
        world = scene.effects[effect.name].change(world, rng_of(effect, scene.geometry.seed, 0))
        yield effect, 1e3 * (cpu_s() - start_s)


def _planned(scene: Scene, effect: Effect, cost_ms: float) -> PlannedEffect:
    settings = scene.effects[effect.name]
    return PlannedEffect(effect.name, effect.kind, effect.why, settings, cost_ms, effect.on_frames)


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


class PlainStreets:
    """Streets without effects and what a frame of them takes, each made once."""

    def __init__(self) -> None:
        self._worlds: dict[Geometry, World] = {}
        self._ms: dict[tuple[Geometry, Rig, Drive], float] = {}

    def world(self, scene: Scene) -> World:
        """Return the scene's street."""
        if scene.geometry not in self._worlds:
            self._worlds[scene.geometry] = plain_world(scene)
        return self._worlds[scene.geometry]

    def frame_ms(self, scene: Scene, measure: Callable[[World], float]) -> float:
        """Return what a frame of it takes, measured when it is first asked for."""
        key = (scene.geometry, scene.rig, scene.drive)
        if key not in self._ms:
            self._ms[key] = measure(self.world(scene))
        return self._ms[key]


def measured_render(
    scene: Scene, frame_ms: Callable[[World], float], streets: PlainStreets
) -> RenderCost:
    """Render the scene's street plain and after each of its effects; ``frame_ms`` does it."""
    plain_ms = before_ms = streets.frame_ms(scene, frame_ms)
    world = streets.world(scene)
    added_ms = {}
    for effect in EFFECTS:
        if effect.name in scene.effects and not effect.on_frames:
            rng = rng_of(effect, scene.geometry.seed, 0)
            world = scene.effects[effect.name].change(world, rng)
            after_ms = frame_ms(world)
            added_ms[effect.name] = after_ms - before_ms
            before_ms = after_ms
    return RenderCost(plain_ms, added_ms)


def small_render_ms(scene: Scene, cpu_s: Callable[[], float]) -> Callable[[World], float]:
    """Return a measure of a world: the median of 3 frames of 320x180, 4 samples a pixel.

    It is scaled to the pixels of the drive's frames, but for what moving vehicles take; samples are
    not scaled.
    """
    from streetgen.render.backend import chosen_backend
    from streetgen.render.renderer import Renderer, Sampling
    from streetgen.shots import Split, shots_of

    shots = shots_of(scene, Split.DRIVE, SIZE_PX)[: FRAMES + 1]
    width_px, height_px = scene.drive.size_px
    scale = width_px * height_px / (SIZE_PX[0] * SIZE_PX[1])
    backend = chosen_backend()

    def frame_ms(world: World) -> float:
        renderer = Renderer(world, Sampling(SAMPLES), backend, threads=1)
        times_s = []
        for shot in shots:
            start_s = cpu_s()
            renderer.at(shot.time_s)
            placed_s = cpu_s()
            renderer.render(shot.camera, shot.time_s)
            times_s.append(placed_s - start_s + scale * (cpu_s() - placed_s))
        return 1e3 * statistics.median(times_s[1:] or times_s)

    return frame_ms
