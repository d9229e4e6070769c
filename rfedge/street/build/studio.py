"""Taking one shot: render, let the air and the sensor act, write the files."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rfcore.camera import Camera
from rfcore.lens import LensCamera
from rfedge.street.apply import apply_effects
from rfedge.street.assembly import world_of
from rfedge.street.build.seen_points import seen_points
from rfedge.street.build.shot_files import ShotFiles
from rfedge.street.frame import LinearFrame, display_rgb
from rfedge.street.render.backend import Backend
from rfedge.street.render.renderer import Quality, Renderer
from rfedge.street.scene_file import Scene
from rfedge.street.shots import Shot

__all__ = ["Order", "Studio", "camera_of_pictures"]


@dataclass(frozen=True)
class Order:
    """What is built where and how; everything a worker needs to know."""

    scene: Scene
    folder: Path
    quality: Quality
    backend: Backend
    threads: int
    size_px: tuple[int, int] | None = None


class Studio:
    """A scene's world, ready to be photographed. One in a process."""

    def __init__(self, order: Order) -> None:
        self._order = order
        world = world_of(order.scene)
        self._renderer = Renderer(world, order.quality, order.backend, order.threads)

    def take(self, shot: Shot) -> None:
        """Write a shot's files. Raises ``OSError``, and then has left none that is not whole."""
        view = self._renderer.render(shot.camera, shot.time_s)
        rendered = LinearFrame(
            colour=view.colour,
            depth_m=view.depth_m,
            camera=shot.camera,
            time_s=shot.time_s,
            velocity_mps=shot.motion.velocity_mps,
            turn_radps=shot.motion.turn_radps,
            labels=view.labels,
        )
        rng = np.random.default_rng([self._order.quality.seed, shot.number])
        points = seen_points(shot.camera, display_rgb(rendered), view.depth_m, view.labels, rng)
        frame = apply_effects(self._order.scene, rendered, shot.number)
        labels = view.labels if frame.labels is None else frame.labels
        files = ShotFiles.of(self._order.folder, shot)
        files.write(display_rgb(frame), frame.depth_m, labels, points)


def camera_of_pictures(scene: Scene, camera: Camera) -> Camera | LensCamera:
    """Return the camera that the pictures of a rendered one have: the lens effect changes it."""
    k = camera.intrinsics
    blank = LinearFrame(
        colour=np.zeros((k.height_px, k.width_px, 3), np.float32),
        depth_m=np.full((k.height_px, k.width_px), np.inf, np.float32),
        camera=camera,
    )
    sensor = replace(scene, effects={k: v for k, v in scene.effects.items() if k == "lens"})
    return apply_effects(sensor, blank, 0).camera
