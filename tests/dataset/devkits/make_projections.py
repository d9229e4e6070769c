"""Project the golden scene's point with the sets' own code: ``projections.json`` of this folder.

``python -m tests.dataset.public_sets FOLDER``, then, by a Python that has the set's library,
``python make_projections.py KIT FOLDER [REPOSITORY]``:

* ``argoverse``: av2 0.3.6, ``nuscenes``: nuscenes-devkit 1.2.0
* ``comma2k19``, ``boreas``: checkouts of commaai/comma2k19 and utiasASRL/pyboreas
* ``123d``: py123d 0.7.0, which also writes ``log_123d``
"""

import json
import shutil
import sys
from pathlib import Path
from types import ModuleType

import numpy as np

HERE = Path(__file__).parent


def argoverse(log, golden):
    from av2.datasets.sensor.av2_sensor_dataloader import AV2SensorDataLoader

    loader = AV2SensorDataLoader(Path(log).parent, Path(log).parent)
    camera = loader.get_log_pinhole_camera(Path(log).name, "ring_front_center")
    found = []
    for path in loader.get_ordered_log_cam_fpaths(Path(log).name, "ring_front_center"):
        city_from_ego = loader.get_city_SE3_ego(Path(log).name, int(path.stem))
        in_ego = city_from_ego.inverse().transform_from(np.array([golden["point"]]))
        found.append(camera.project_ego_to_img(in_ego)[0][0].tolist())
    return found


def nuscenes(root, golden):
    from nuscenes.nuscenes import NuScenes
    from nuscenes.utils.data_classes import Box
    from nuscenes.utils.geometry_utils import view_points
    from pyquaternion import Quaternion

    kit, found = NuScenes("v1.0-mini", root, verbose=False), []
    for shot in sorted(kit.sample_data, key=lambda row: row["timestamp"]):
        box = Box(golden["point"], [1, 1, 1], Quaternion())
        for table in ("ego_pose", "calibrated_sensor"):
            row = kit.get(table, shot[f"{table}_token"])
            box.translate(-np.array(row["translation"]))
            box.rotate(Quaternion(row["rotation"]).inverse)
        k = np.array(row["camera_intrinsic"])
        found.append(view_points(box.center[:, None], k, normalize=True)[:2, 0].tolist())
    return found


def comma2k19(segment, golden, repository):
    sys.path.insert(0, repository)
    from utils.camera import denormalize, device_from_ecef, img_from_device

    poses = Path(segment) / "global_pose"
    places, turns = (np.load(poses / name) for name in ("frame_positions", "frame_orientations"))
    point = np.array(golden["point_ecef"])
    seen = (device_from_ecef(p, q, point) for p, q in zip(places, turns))  # noqa: B905
    return [denormalize(img_from_device(device[None]))[0].tolist() for device in seen]


def boreas(drive, golden, repository):
    for name in ("pyboreas", "pyboreas.utils"):  # without their __init__, which needs more
        sys.modules[name] = ModuleType(name)
        sys.modules[name].__path__ = [str(Path(repository, *name.split(".")))]
    from pyboreas.utils.utils import get_transform

    p = np.loadtxt(Path(drive) / "calib" / "P_camera.txt")
    lines = (Path(drive) / "applanix" / "camera_poses.csv").read_text().splitlines()[1:]
    found = []
    for line in lines:
        pose = get_transform([float(value) for value in line.split(",")])
        u, v, depth, _ = p @ np.linalg.inv(pose) @ [*golden["point"], 1.0]
        found.append([u / depth, v / depth])
    return found


def log_123d(_, golden):
    from py123d.api.scene.arrow.arrow_log_writer import ArrowLogWriter, SyncConfig
    from py123d.api.scene.arrow.utils.log_writer_config import LogWriterConfig
    from py123d.datatypes import LogMetadata, Timestamp
    from py123d.datatypes.sensors.base_camera import CameraID
    from py123d.datatypes.sensors.pinhole_camera import (
        PinholeCameraMetadata,
        PinholeDistortion,
        PinholeIntrinsics,
    )
    from py123d.datatypes.vehicle_state.ego_state import EgoStateSE3
    from py123d.datatypes.vehicle_state.ego_state_metadata import EgoStateSE3Metadata
    from py123d.geometry import PoseSE3
    from py123d.geometry.transform.transform_se3 import rel_to_abs_se3
    from py123d.parser.base_dataset_parser import ParsedCamera

    def pose(seven):
        return PoseSE3(*seven[4:], *seven[:4])

    fx, fy, cx, cy, width, height = golden["pinhole"]
    mounting, still = pose(golden["mounting"]), PoseSE3.identity()
    car = EgoStateSE3Metadata("car", 2.0, 4.5, 1.6, 2.8, still, still)
    lens = PinholeDistortion(0.02, -0.004, 0.001, -0.0005, 0.0)
    cameras = [
        PinholeCameraMetadata(
            name,
            number,
            PinholeIntrinsics(fx, fy, cx, cy),
            lens,
            width,
            height,
            mounting,
            is_undistorted=number == CameraID.PCAM_F0,
        )
        for name, number in (("CAM_FRONT", CameraID.PCAM_F0), ("CAM_BACK", CameraID.PCAM_B0))
    ]
    root = HERE / "log_123d"
    shutil.rmtree(root, ignore_errors=True)
    writer = ArrowLogWriter(
        LogWriterConfig(camera_store_option="png_binary"),
        root,
        root,
        sync_config=SyncConfig("ego_state_se3.timestamp_us"),
    )
    writer.reset(LogMetadata("nuscenes", "nuscenes-mini_train", "scene-0061", "boston-seaport"))
    found = {camera.camera_name: [] for camera in cameras}
    for picture, ego, time_ns in zip(golden["pictures"], golden["ego"], golden["times_ns"]):  # noqa: B905
        time, png = Timestamp.from_us(time_ns // 1000), Path(picture).read_bytes()
        writer.write_async(EgoStateSE3.from_imu(pose(ego), car, time))
        placed = rel_to_abs_se3(pose(ego), mounting)
        in_camera = np.linalg.inv(placed.transformation_matrix) @ [*golden["point"], 1.0]
        for camera in cameras:
            # The second camera's poses are left to the vehicle's.
            own = placed if camera.camera_id == CameraID.PCAM_F0 else None
            writer.write_async(ParsedCamera(camera, time, own, byte_string=png))
            found[camera.camera_name].append(
                camera.project_to_image(in_camera[None, :3])[0][0].tolist()
            )
    writer.close()
    return found


if __name__ == "__main__":
    kit, folder, *rest = sys.argv[1:]
    golden = json.loads((Path(folder) / "golden.json").read_text())
    projections = HERE / "projections.json"
    known = json.loads(projections.read_text()) if projections.exists() else {}
    made = {
        f.__name__.replace("log_", ""): f
        for f in (argoverse, nuscenes, comma2k19, boreas, log_123d)
    }
    known[kit] = made[kit](golden["sets"].get(kit), golden, *rest)
    projections.write_text(json.dumps(known, indent=1, sort_keys=True) + "\n")
