"""Taking one shot: render, let the air and the sensor act, write the files.

Surface points that a view sees: pixels taken by chance, carried back to where they came from.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera
from rfcore.dataset.source import SourcePoints
from rfcore.image import Rgb
from rfcore.lens import LensCamera
from rfedge.street.assembly import apply_effects, world_of
from rfedge.street.build.shot_files import ShotFiles
from rfedge.street.frame import LinearFrame, display_rgb
from rfedge.street.geometry.mesh import F32, Label
from rfedge.street.render.backend import Backend
from rfedge.street.render.renderer import Quality, Renderer
from rfedge.street.scene_file import Scene
from rfedge.street.shots import Shot

__all__ = ["POINTS_PER_VIEW", "RenderJob", "SceneRenderer", "camera_of_pictures", "seen_points"]


POINTS_PER_VIEW = 1000


def seen_points(
    camera: Camera,
    rgb: Rgb,
    depth_m: F32,
    labels: NDArray[np.uint8],
    rng: np.random.Generator,
) -> SourcePoints:
    """Return at most 1000 points behind the centres of pixels that do not show the sky.

    They are spread over the surfaces rather than the picture: a pixel's chance grows with the
    square of its depth up to 30 m, as the area does that it covers.
    """
    rows, columns = np.nonzero(labels != Label.SKY)
    if len(rows) == 0:
        return SourcePoints(np.empty((0, 3)), np.empty((0, 3), np.uint8))
    z = depth_m[rows, columns].astype(np.float64)
    weight = np.minimum(z, 30.0) ** 2
    count = min(POINTS_PER_VIEW, len(rows))
    taken = rng.choice(len(rows), count, replace=False, p=weight / weight.sum())
    k = camera.intrinsics
    u, v, z = columns[taken] + 0.5, rows[taken] + 0.5, z[taken]
    local = np.stack([(u - k.cx_px) / k.fx_px * z, (v - k.cy_px) / k.fy_px * z, z], axis=1)
    rotation = np.array(camera.world_from_cam.rotation_matrix())
    xyz_m = local @ rotation.T + np.array(camera.world_from_cam.translation_m)
    return SourcePoints(xyz_m, rgb[rows[taken], columns[taken]])


@dataclass(frozen=True)
class RenderJob:
    """What is built where and how; everything a worker needs to know."""

    scene: Scene
    folder: Path
    quality: Quality
    backend: Backend
    threads: int
    size_px: tuple[int, int] | None = None


class SceneRenderer:
    """A scene's world, ready to be photographed. One in a process."""

    def __init__(self, order: RenderJob) -> None:
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
