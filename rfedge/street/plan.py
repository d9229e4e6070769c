"""What a scene will run, and what each effect costs: measured here and now, on a plain frame."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rfcore.camera import Camera, Intrinsics, Pose
from rfedge.street.effects import EFFECTS, Stage, rng_of
from rfedge.street.frame import LinearFrame
from rfedge.street.scene_file import Scene

__all__ = ["PlannedEffect", "plain_frame", "planned_effects"]

REPETITIONS = 5


@dataclass(frozen=True)
class PlannedEffect:
    """An effect that will run, with its settings and its median processor time a frame."""

    name: str
    stage: Stage
    why: str
    settings: object
    cost_ms: float


def planned_effects(scene: Scene, cpu_s: Callable[[], float]) -> tuple[PlannedEffect, ...]:
    """Run each declared effect on a frame of the drive's size; ``cpu_s`` reads processor time."""
    frame = plain_frame(*scene.drive.size_px, scene.rig.fov_deg)
    planned = []
    for effect in EFFECTS:
        if effect.name in scene.effects:
            settings = scene.effects[effect.name]
            times_s = []
            for i in range(REPETITIONS):
                start_s = cpu_s()
                settings.apply(frame, rng_of(effect, scene.geometry.seed, i))
                times_s.append(cpu_s() - start_s)
            cost_ms = 1e3 * statistics.median(times_s)
            planned.append(PlannedEffect(effect.name, effect.stage, effect.why, settings, cost_ms))
    return tuple(planned)


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
