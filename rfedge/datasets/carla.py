"""Drives the rig along a street of a CARLA world and writes what its cameras see.

The server runs in synchronous mode; the car, without physics, is set down on the lane every
``spacing_m`` and, on the way back, on the lane of the other direction. Poses are those which the
images carry, not those that were asked for. This is the only module that talks to a server.

CARLA (Unreal) has left-handed axes: x forward, y right, z up, in the world as in a sensor, which
looks along its x; ``Transform.get_matrix`` is world_from_sensor. Our world is the same with y
negated, p = S p_carla with S = diag(1, -1, 1), so that it is right-handed with z up. A camera's
OpenCV axes are right = y, down = -z, forward = x of the sensor, the columns of P below, hence
R = S R_carla P.
"""

from __future__ import annotations

import math
import queue
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from rfcore.camera import Intrinsics, Pose
from rfcore.dataset.rig import Mount, mounts_named
from rfcore.dataset.source import SourceCamera
from rfcore.dataset.write import WrittenPicture, write_transforms
from rfcore.errors import InvalidInput, RfedgeError
from rfcore.image import write_png
from rfedge.datasets import DatasetRecordCarla


def pose_from_carla(world_from_sensor: Sequence[Sequence[float]]) -> Pose:
    """Return world_from_cam of a sensor's 4x4 ``Transform.get_matrix()``.

    Raises ``InvalidInput`` when it is not rigid; its float32 entries are well within tolerance.
    """
    rows = []
    for sign, (x, y, z, t) in zip((1.0, -1.0, 1.0), world_from_sensor[:3], strict=True):
        rows.append([sign * y, -sign * z, sign * x, sign * t])
    return Pose.from_matrix(rows)


def intrinsics_of_fov(width_px: int, height_px: int, fov_deg: float) -> Intrinsics:
    """Return the intrinsics of ``sensor.camera.rgb``: horizontal field of view, square pixels."""
    if not 0 < fov_deg < 180:
        raise InvalidInput("fov_deg", f"{fov_deg} is outside 0..180 degrees")
    focal_px = width_px / (2 * math.tan(math.radians(fov_deg) / 2))
    return Intrinsics(width_px, height_px, focal_px, focal_px, width_px / 2, height_px / 2)


PARKED = ("Car", "Truck", "Bus", "Motorcycle", "Bicycle")
SETTLING_TICKS = 2
"""An image shows the transform of the tick before its own at the earliest."""


VEHICLE, TICK_S = "vehicle.tesla.model3", 0.05


class CarlaRecorder:
    """Records in ``world`` with the client library, the module ``carla``."""

    def __init__(self, carla: Any, world: Any, settings: DatasetRecordCarla) -> None:
        self._carla = carla
        self._world = world
        self._settings = settings
        self._mounts = mounts_named(settings.cameras)
        self._camera = SourceCamera(intrinsics_of_fov(*settings.size_px, settings.fov_deg))

    def record(self, folder: Path) -> int:
        """Fill ``folder`` with pictures and transforms.json; return the number of pictures."""
        (folder / "images").mkdir()
        stations = self._stations()
        written: list[WrittenPicture] = []
        with ExitStack() as stack:
            stack.enter_context(self._synchronous())
            if not self._settings.keep_parked:
                stack.enter_context(self._without_parked())
            car = stack.enter_context(self._car(stations[0]))
            images = stack.enter_context(self._cameras(car))
            for i, station in enumerate(stations):
                car.set_transform(station)
                frame = [self._world.tick() for _ in range(SETTLING_TICKS)][-1]
                for mount, queued in zip(self._mounts, images, strict=True):
                    name = f"images/{i:04d}_{mount.name}.png"
                    written.append(self._written(folder, name, self._image(queued, frame)))
        write_transforms(folder, written, None)
        return len(written)

    def _stations(self) -> list[Any]:
        """Return transforms on the lane and, for the way back, on that of the other direction."""
        street = self._world.get_map()
        spawns = street.get_spawn_points()
        if self._settings.spawn >= len(spawns):
            raise InvalidInput(
                "spawn", f"{self._settings.spawn}: the map has {len(spawns)} spawn points"
            )
        there = self._walk(street.get_waypoint(spawns[self._settings.spawn].location))
        ways = [*there]
        if not self._settings.no_both_ways:
            ways += self._walk(_opposite(there[-1]))
        return [_raised(self._carla, waypoint.transform) for waypoint in ways]

    def _walk(self, waypoint: Any) -> list[Any]:
        found = [waypoint]
        while len(found) < self._settings.stations:
            ahead = found[-1].next(self._settings.spacing_m)
            if not ahead:
                raise InvalidInput(
                    "stations", f"the lane ends after {len(found)}; take fewer or another spawn"
                )
            found.append(ahead[0])
        return found

    @contextmanager
    def _synchronous(self) -> Iterator[None]:
        before = self._world.get_settings()
        settings = self._world.get_settings()
        settings.synchronous_mode = True
        settings.fixed_delta_seconds = TICK_S
        self._world.apply_settings(settings)
        try:
            yield
        finally:
            self._world.apply_settings(before)

    @contextmanager
    def _without_parked(self) -> Iterator[None]:
        """Hide the vehicles that belong to the map: the field is to be of the empty street."""
        labels = [getattr(self._carla.CityObjectLabel, name) for name in PARKED]
        objects = {o.id for label in labels for o in self._world.get_environment_objects(label)}
        self._world.enable_environment_objects(objects, False)
        try:
            yield
        finally:
            self._world.enable_environment_objects(objects, True)

    @contextmanager
    def _car(self, station: Any) -> Iterator[Any]:
        blueprint = self._world.get_blueprint_library().find(VEHICLE)
        car = self._world.spawn_actor(blueprint, station)
        try:
            car.set_simulate_physics(False)
            yield car
        finally:
            car.destroy()

    @contextmanager
    def _cameras(self, car: Any) -> Iterator[Sequence[queue.Queue[Any]]]:
        blueprint = self._blueprint()
        with ExitStack() as stack:
            queues = []
            for mount in self._mounts:
                place = _transform(self._carla, mount)
                sensor = self._world.spawn_actor(blueprint, place, attach_to=car)
                stack.callback(sensor.destroy)
                images: queue.Queue[Any] = queue.Queue()
                sensor.listen(images.put)
                stack.callback(sensor.stop)
                queues.append(images)
            yield queues

    def _blueprint(self) -> Any:
        blueprint = self._world.get_blueprint_library().find("sensor.camera.rgb")
        width_px, height_px = self._settings.size_px
        blueprint.set_attribute("image_size_x", str(width_px))
        blueprint.set_attribute("image_size_y", str(height_px))
        blueprint.set_attribute("fov", str(self._settings.fov_deg))
        blueprint.set_attribute("motion_blur_intensity", "0.0")
        return blueprint

    def _image(self, images: queue.Queue[Any], frame: int) -> Any:
        """Return the image of a tick; earlier ones are left over from settling."""
        while True:
            try:
                image = images.get(timeout=self._settings.timeout_s)
            except queue.Empty as error:
                raise RfedgeError(
                    f"CARLA sent no image of frame {frame} within {self._settings.timeout_s:g} s"
                ) from error
            if image.frame >= frame:
                return image

    def _written(self, folder: Path, name: str, image: Any) -> WrittenPicture:
        bgra = np.frombuffer(image.raw_data, np.uint8).reshape(image.height, image.width, 4)
        write_png(folder / name, np.ascontiguousarray(bgra[..., 2::-1]))
        pose = pose_from_carla(image.transform.get_matrix())
        return WrittenPicture(name, self._camera, pose, round(image.timestamp * 1e9))


def _opposite(waypoint: Any) -> Any:
    """Return the nearest lane beside a waypoint that leads the other way."""
    lane = waypoint
    while lane is not None and lane.lane_id * waypoint.lane_id > 0:
        lane = lane.get_left_lane()
    if lane is None:
        raise InvalidInput("spawn", "there is no lane of the other direction; use --no-both-ways")
    return lane


def _transform(carla: Any, mount: Mount) -> Any:
    rotation = carla.Rotation(pitch=mount.pitch_deg, yaw=mount.yaw_deg, roll=0.0)
    return carla.Transform(carla.Location(mount.x_m, mount.y_m, mount.z_m), rotation)


def _raised(carla: Any, transform: Any) -> Any:
    """Return the transform of a waypoint raised off the road, which a car would collide with."""
    at = transform.location
    return carla.Transform(carla.Location(at.x, at.y, at.z + 0.3), transform.rotation)
