"""What rendering costs, with and without each effect on the street, by small renders in one run.

The street is rendered plain, then again after each effect is added; what a frame then takes more is
that effect's. It may be less than nothing: a sky without a sun takes fewer decisions. Scenes of the
same street share its plain render.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable

from rfedge.street.assembly import plain_world
from rfedge.street.effects import EFFECTS, rng_of
from rfedge.street.geometry.world import World
from rfedge.street.plan import RenderCost
from rfedge.street.scene_file import Drive, Geometry, Rig, Scene

__all__ = ["PlainStreets", "measured_render", "small_render_ms"]

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
    from rfedge.street.render.backend import chosen_backend
    from rfedge.street.render.renderer import Quality, Renderer
    from rfedge.street.shots import Split, shots_of

    shots = shots_of(scene, Split.DRIVE, SIZE_PX)[: FRAMES + 1]
    width_px, height_px = scene.drive.size_px
    scale = width_px * height_px / (SIZE_PX[0] * SIZE_PX[1])
    backend = chosen_backend()

    def frame_ms(world: World) -> float:
        renderer = Renderer(world, Quality(SAMPLES), backend, threads=1)
        times_s = []
        for shot in shots:
            start_s = cpu_s()
            renderer.at(shot.time_s)
            placed_s = cpu_s()
            renderer.render(shot.camera, shot.time_s)
            times_s.append(placed_s - start_s + scale * (cpu_s() - placed_s))
        return 1e3 * statistics.median(times_s[1:] or times_s)

    return frame_ms
