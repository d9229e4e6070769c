"""Render one shot and write its files: picture, depth, classes and surface points.

``SPLIT/images/N.png`` is written last, so that an existing picture means a finished shot. Depth is
z in millimetres as 16-bit integers; 0 means none, or more than 65.535 m. Classes are the numbers of
``streetgen.classes.Label``. The 1000 points of each shot are what a LiDAR at the camera would
measure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera
from rfcore.dataset.source import SourcePoints
from rfcore.dataset.write import write_points
from rfcore.errors import DatasetError
from rfcore.files import write_whole
from rfcore.image import Rgb, write_png
from rfcore.lens import LensCamera
from streetgen.assembly import apply_effects, world_of
from streetgen.classes import Label
from streetgen.frame import LinearFrame, display_rgb
from streetgen.geometry.mesh import F32
from streetgen.render.backend import Backend
from streetgen.render.renderer import PathTracer, Sampling
from streetgen.scene_file import Scene
from streetgen.shots import Shot, Split

FARTHEST_MM = 65535
PLACES = ("images", "depth", "classes", "points")


@dataclass(frozen=True)
class ShotFiles:
    """The paths of a shot's files."""

    folder: Path
    split: Split
    name: str

    @staticmethod
    def of(folder: Path, shot: Shot) -> ShotFiles:
        """Return a shot's files in the dataset's folder."""
        return ShotFiles(folder, shot.split, shot.name)

    @property
    def picture(self) -> Path:
        """The picture, 8-bit RGB."""
        return self._file("images", "png")

    @property
    def points(self) -> Path:
        """The surface points that the shot shows."""
        return self._file("points", "ply")

    @property
    def picture_name(self) -> str:
        """The picture's path in the dataset."""
        return f"{self.split}/images/{self.name}.png"

    @property
    def done(self) -> bool:
        """Whether the shot is finished."""
        return self.picture.is_file()

    def write(
        self, rgb: Rgb, depth_m: F32, labels: NDArray[np.uint8], points: SourcePoints
    ) -> None:
        """Write all files, each whole or not at all. Raises ``OSError``."""
        for place in PLACES:
            (self.folder / self.split / place).mkdir(parents=True, exist_ok=True)
        write_whole(self._file("depth", "png"), _png_bytes(depth_mm(depth_m)))
        write_whole(self._file("classes", "png"), _png_bytes(labels))
        write_points(self.points, points)
        write_png(self.picture, rgb)

    def _file(self, place: str, suffix: str) -> Path:
        return self.folder / self.split / place / f"{self.name}.{suffix}"


def depth_mm(depth_m: F32) -> NDArray[np.uint16]:
    """Return z in whole millimetres, 0 for what is farther than 65.535 m."""
    rounded = np.floor(depth_m.astype(np.float64) * 1000 + 0.5)
    return np.where(rounded <= FARTHEST_MM, rounded, 0).astype(np.uint16)


def read_depth_m(path: Path) -> F32:
    """Return z in metres float32 [H, W], infinite where the file has none.

    Raises ``DatasetError`` naming the file.
    """
    stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if stored is None or stored.dtype != np.uint16 or stored.ndim != 2:
        raise DatasetError(f"{path}: no 16-bit picture of depths")
    return np.where(stored == 0, np.inf, stored / 1000).astype(np.float32)


def _png_bytes(values: NDArray[np.uint8] | NDArray[np.uint16]) -> bytes:
    _, encoded = cv2.imencode(".png", values)
    return encoded.tobytes()


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
    """Everything that a worker needs to know to take shots of a scene."""

    scene: Scene
    folder: Path
    sampling: Sampling
    backend: Backend
    threads: int
    size_px: tuple[int, int] | None = None


class SceneRenderer:
    """Takes shots of a scene, whose world it has loaded; a process holds one."""

    def __init__(self, job: RenderJob) -> None:
        self._job = job
        world = world_of(job.scene)
        self._renderer = PathTracer(world, job.sampling, job.backend, job.threads)

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
        rng = np.random.default_rng([self._job.sampling.seed, shot.number])
        points = seen_points(shot.camera, display_rgb(rendered), view.depth_m, view.labels, rng)
        frame = apply_effects(self._job.scene, rendered, shot.number)
        labels = view.labels if frame.labels is None else frame.labels
        files = ShotFiles.of(self._job.folder, shot)
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
