"""The recorder against a stand-in for the server, with the client library's own types.

No CARLA server is run here: the stand-in answers the calls the recorder makes.
"""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import carla
import numpy as np
import pytest

from rfcore.dataset import read_dataset
from rfcore.dataset.rig import RIG, mounts_named
from rfcore.errors import InvalidInput, RfedgeError
from rfedge.datasets import DatasetRecordCarla
from rfedge.datasets.carla import CarlaRecorder

SMALL = DatasetRecordCarla(Path("out"), stations=3, spacing_m=5.0, size="32x18", timeout_s=0.2)


class Waypoint:
    """A straight street along x: lane 1 leads to +x at y = 0, lane -1 back at y = -4."""

    def __init__(self, x: float, lane_id: int, end: float = 1000.0) -> None:
        self.x, self.lane_id, self._end = x, lane_id, end

    @property
    def transform(self) -> carla.Transform:
        there = self.lane_id > 0
        at = carla.Location(self.x, 0.0 if there else -4.0, 0.0)
        return carla.Transform(at, carla.Rotation(yaw=0.0 if there else 180.0))

    def next(self, distance: float) -> list["Waypoint"]:
        x = self.x + distance * (1 if self.lane_id > 0 else -1)
        return [Waypoint(x, self.lane_id, self._end)] if x <= self._end else []

    def get_left_lane(self) -> "Waypoint | None":
        return Waypoint(self.x, -1) if self.lane_id > 0 else None


class Sensor:
    def __init__(self, world: "World", mount: carla.Transform) -> None:
        self.world, self.mount, self.put = world, mount, None

    def listen(self, put: Any) -> None:
        self.put = put
        self.world.sensors.append(self)

    def stop(self) -> None:
        self.world.sensors.remove(self)

    def destroy(self) -> None:
        self.world.alive -= 1

    def shoot(self, frame: int) -> None:
        """A grey picture from where the sensor is; yaws add up, as car and street are level."""
        car = self.world.car.transform
        at = car.transform(carla.Location(self.mount.location))
        turn = carla.Rotation(
            pitch=self.mount.rotation.pitch, yaw=car.rotation.yaw + self.mount.rotation.yaw
        )
        pixels = np.full((18, 32, 4), (1, 2, 3, 255), np.uint8)
        self.put(
            SimpleNamespace(
                frame=frame,
                timestamp=frame * 0.05,
                width=32,
                height=18,
                raw_data=pixels.tobytes(),
                transform=carla.Transform(carla.Location(at.x, at.y, at.z), turn),
            )
        )


class World:
    def __init__(self, lane_end: float = 1000.0, mute: bool = False) -> None:
        self.sensors: list[Sensor] = []
        self.alive, self.frame, self.mute = 0, 7, mute
        self.settings = SimpleNamespace(synchronous_mode=False, fixed_delta_seconds=None)
        self.hidden: set[int] = set()
        self.lane_end = lane_end
        self.attributes: dict[str, str] = {}

    def get_map(self) -> Any:
        points = [carla.Transform(carla.Location(10.0, 0.0, 0.5))]
        return SimpleNamespace(
            get_spawn_points=lambda: points,
            get_waypoint=lambda at: Waypoint(at.x, 1, self.lane_end),
        )

    def get_settings(self) -> Any:
        return SimpleNamespace(**vars(self.settings))

    def apply_settings(self, settings: Any) -> None:
        self.settings = settings

    def get_environment_objects(self, label: Any) -> Any:
        return [SimpleNamespace(id=int(label))]

    def enable_environment_objects(self, objects: set[int], shown: bool) -> None:
        self.hidden = self.hidden - objects if shown else self.hidden | objects

    def get_blueprint_library(self) -> Any:
        return SimpleNamespace(
            find=lambda name: SimpleNamespace(id=name, set_attribute=self.attributes.__setitem__)
        )

    def spawn_actor(self, _blueprint: Any, at: Any, attach_to: Any = None) -> Any:
        self.alive += 1
        if attach_to is not None:
            return Sensor(self, at)
        self.car = SimpleNamespace(transform=at, set_simulate_physics=lambda _: None)
        self.car.set_transform = lambda t: setattr(self.car, "transform", t)
        self.car.destroy = lambda: setattr(self, "alive", self.alive - 1)
        return self.car

    def tick(self) -> int:
        assert self.settings.synchronous_mode
        assert len(self.hidden) == 5
        self.frame += 1
        if not self.mute:
            for sensor in self.sensors:
                sensor.shoot(self.frame)
        return self.frame


def test_a_recording_is_a_dataset_of_all_cameras_both_ways(tmp_path):
    world = World()
    assert CarlaRecorder(carla, world, SMALL).record(tmp_path) == 2 * 3 * 18
    dataset = read_dataset(tmp_path)
    assert len(dataset.pictures) == 108
    assert (dataset.pictures[0].read() == (3, 2, 1)).all(), "BGRA becomes RGB"
    assert dataset.pictures[0].camera.intrinsics.fx_px == pytest.approx(16.0)
    assert world.attributes["image_size_x"] == "32"


def test_every_camera_looks_where_its_mount_says(tmp_path):
    """The car drives along x at y = 0 and back at CARLA's y = -4, which is our +4."""
    CarlaRecorder(carla, World(), SMALL).record(tmp_path)
    found = {picture.name: picture.camera for picture in read_dataset(tmp_path).pictures}
    front = found["images/0001_mid_front.png"].world_from_cam
    assert front.translation_m == pytest.approx((15 + 2.5, 0, 2.8), abs=1e-5)
    assert front.apply((0, 0, 10)) == pytest.approx((27.5, 0, 2.8), abs=1e-4)
    right = found["images/0001_mid_right.png"].world_from_cam
    assert right.translation_m == pytest.approx((15, -1, 2.8), abs=1e-5)
    assert right.apply((0, 0, 10)) == pytest.approx((15, -11, 2.8), abs=1e-4)
    back = found["images/0004_mid_front.png"].world_from_cam
    assert back.apply((0, 0, 10)) == pytest.approx((15 - 2.5 - 10, 4, 2.8), abs=1e-4)
    low = found["images/0000_low_front.png"].world_from_cam
    assert low.apply((0, 0, 10))[2] > low.translation_m[2] + 2, "tilted up"


def test_the_world_is_left_as_it_was(tmp_path):
    world = World(mute=True)
    with pytest.raises(RfedgeError, match=r"no image of frame 9 within 0\.2 s"):
        CarlaRecorder(carla, world, SMALL).record(tmp_path)
    assert (world.alive, world.hidden, world.sensors) == (0, set(), [])
    assert not world.settings.synchronous_mode


def test_a_lane_that_ends_is_said(tmp_path):
    with pytest.raises(InvalidInput, match="ends after 2"):
        CarlaRecorder(carla, World(lane_end=16.0), SMALL).record(tmp_path)


def test_the_rig_has_18_cameras_in_three_rows():
    assert len({mount.name for mount in RIG}) == len(RIG) == 18
    assert {mount.z_m for mount in RIG} == {0.5, 2.5, 5.5}
    assert [mount.name for mount in mounts_named("mid_front,high_back")] == [
        "mid_front",
        "high_back",
    ]
    with pytest.raises(InvalidInput, match="'top' is none of low_front"):
        mounts_named("top")


def test_the_labels_and_calls_exist_in_the_client_library():
    """The stand-in answers only what the library offers."""
    for name in ("Car", "Truck", "Bus", "Motorcycle", "Bicycle"):
        assert hasattr(carla.CityObjectLabel, name)
    for owner, names in {
        carla.World: "get_map get_settings apply_settings tick spawn_actor get_blueprint_library "
        "get_environment_objects enable_environment_objects",
        carla.Map: "get_spawn_points get_waypoint",
        carla.Waypoint: "transform lane_id next get_left_lane",
        carla.Sensor: "listen stop destroy",
        carla.Vehicle: "set_transform set_simulate_physics destroy",
        carla.Image: "frame timestamp transform raw_data width height",
        carla.WorldSettings: "synchronous_mode fixed_delta_seconds",
        carla.BlueprintLibrary: "find",
        carla.Client: "set_timeout load_world get_world",
    }.items():
        assert [name for name in names.split() if not hasattr(owner, name)] == []
