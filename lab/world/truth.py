"""The generator's truth about a scene: positions of its vehicles, and a camera's view of them.

A ``Drive`` is the scene with the pictures that were taken there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, Pose
from rfcore.dataset import read_dataset
from rfcore.errors import InvalidInput
from rfcore.image import Rgb
from rfcore.views import PosedPicture
from streetgen.assembly import world_of
from streetgen.classes import Label
from streetgen.frame import LinearFrame, display_rgb
from streetgen.geometry.mesh import Mesh
from streetgen.geometry.world import World
from streetgen.render.backend import chosen_backend
from streetgen.render.renderer import PathTracer, Sampling
from streetgen.scene_file import load_scene

F64 = NDArray[np.float64]
SAMPLED = 4
"""Stride of the sampled pixels of vehicles."""
GAP_M = 0.3
"""Greatest distance of a vehicle's pixels from its outline on the ground."""


@dataclass(frozen=True)
class Drive:
    """A drive of a scene, and the scene's truth."""

    pictures: Sequence[PosedPicture]
    scene: str

    @staticmethod
    def given(text: str) -> Drive:
        """Read SCENE.toml,DATASET; raise ``InvalidInput`` for anything else."""
        scene, comma, dataset = text.partition(",")
        if not comma:
            raise InvalidInput("drive", f"{text!r} is not SCENE.toml,DATASET")
        return Drive(read_dataset(Path(dataset)).pictures, scene)

    def time_s(self, index: int) -> float:
        """Return when a picture was taken."""
        return (self.pictures[index].time_ns - self.pictures[0].time_ns) / 1e9


@dataclass(frozen=True, eq=False)
class Footprint:
    """The convex outline of a vehicle on the ground: float32 [N, 2], metres."""

    outline_m: NDArray[np.float32]

    @staticmethod
    def of(vertices_m: F64) -> Footprint:
        """Return that of a vehicle's vertices [V, 3]."""
        hull = cv2.convexHull(vertices_m[:, :2].astype(np.float32))
        return Footprint(np.asarray(hull[:, 0], np.float32))

    def distance_m(self, at_m: Sequence[float]) -> float:
        """Return how far a point on the ground is from the outline, inside or outside of it."""
        return abs(self.outside_m(at_m))

    def outside_m(self, at_m: Sequence[float]) -> float:
        """Return how far a point is outside of the outline; below 0 inside."""
        point = (float(at_m[0]), float(at_m[1]))
        return -float(cv2.pointPolygonTest(self.outline_m[:, None], point, True))


@dataclass(frozen=True, eq=False)
class VisibleVehicle:
    """Vehicle ``number`` of a scene as one picture shows it: ``pixels`` of it, the nearest at
    ``nearest_m``."""

    number: int
    footprint: Footprint
    pixels: int
    nearest_m: float


class SceneTruth:
    """A scene, loaded into the renderer."""

    def __init__(self, scene: str, threads: int = 2) -> None:
        self._world = world_of(load_scene(scene))
        self._renderer = PathTracer(self._world, Sampling(), chosen_backend(), threads)

    def picture(self, camera: Camera, time_s: float) -> Rgb:
        """Return the street as a camera there would see it, uint8 [H, W, 3]."""
        view = self._renderer.render(camera, time_s)
        return display_rgb(LinearFrame(view.colour, view.depth_m, camera, time_s))

    def vehicles(self, camera: Camera, time_s: float) -> list[VisibleVehicle]:
        """Return the vehicles of which the camera sees something."""
        depth_m, labels = self._renderer.cast(camera, time_s)
        rows, columns = np.nonzero(labels == Label.VEHICLE)
        if not len(rows):
            return []
        z = depth_m[rows, columns].astype(np.float64)
        k = camera.intrinsics
        local = np.stack(
            [(columns + 0.5 - k.cx_px) / k.fx_px * z, (rows + 0.5 - k.cy_px) / k.fy_px * z, z], 1
        )
        pose = camera.world_from_cam
        points = local @ np.array(pose.rotation_matrix()).T + np.array(pose.translation_m)
        footprints = [*self._parked, *_moving(self._world, time_s)]
        outside = np.array([[f.outside_m(p) for f in footprints] for p in points[::SAMPLED]])
        owner = np.where(outside.min(axis=1) < GAP_M, outside.argmin(axis=1), -1)
        visible = []
        for number, footprint in enumerate(footprints):
            own = owner == number
            if own.any():
                nearest_m = float(z[::SAMPLED][own].min())
                pixels = SAMPLED * int(own.sum())
                visible.append(VisibleVehicle(number, footprint, pixels, nearest_m))
        return visible

    @cached_property
    def _parked(self) -> list[Footprint]:
        return [Footprint.of(points) for points in _standing(self._world.meshes)]


def aside(camera: Camera, left_m: float) -> Camera:
    """Return a camera that looks the same way from ``left_m`` to the left."""
    pose = camera.world_from_cam
    moved = Pose(pose.apply((-left_m, 0.0, 0.0)), pose.rotation)
    return replace(camera, world_from_cam=moved)


def _moving(world: World, time_s: float) -> list[Footprint]:
    footprints = []
    for mover in world.movers:
        matrix = mover.world_from_mover(time_s)
        vertices = np.concatenate([mesh.vertices for mesh in mover.meshes]).astype(np.float64)
        footprints.append(Footprint.of(vertices @ matrix[:3, :3].T + matrix[:3, 3]))
    return footprints


def _standing(meshes: Sequence[Mesh]) -> list[F64]:
    """Return the vertices of each parked vehicle: those of meshes whose boxes touch."""
    groups: list[tuple[F64, list[F64]]] = []
    for mesh in meshes:
        if mesh.label is not Label.VEHICLE:
            continue
        points = mesh.vertices.astype(np.float64)
        box = np.stack([points.min(axis=0)[:2], points.max(axis=0)[:2]])
        members, apart = [points], []
        for other, theirs in groups:
            if (box[0] <= other[1]).all() and (other[0] <= box[1]).all():
                box = np.stack([np.minimum(box[0], other[0]), np.maximum(box[1], other[1])])
                members += theirs
            else:
                apart.append((other, theirs))
        groups = [*apart, (box, members)]
    return [np.concatenate(members) for _, members in groups]
