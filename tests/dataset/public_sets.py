"""The golden scene in the layouts of public sets, by their published definitions.

``python -m tests.dataset.public_sets FOLDER`` writes them for ``devkits/make_projections.py``.
"""

import json
import sys
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
from pyarrow import feather

from rfcore.image import jpeg_bytes, read_rgb, write_png
from tests.dataset.conftest import GoldenScene, quaternion

EGO_FROM_CAM = np.array(
    [[0, 0.1, 0.995, 1.2], [-1, 0, 0, 0.1], [0, -0.995, 0.1, 1.4], [0, 0, 0, 1]]
)
EGO_FROM_CAM[:3, :3] = (
    np.linalg.svd(EGO_FROM_CAM[:3, :3])[0] @ np.linalg.svd(EGO_FROM_CAM[:3, :3])[2]
)
START_S = 1_532_402_927.0
"""Added to the scene's times, so that they are a clock's."""
DEVICE_FROM_CAM = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
PLACE_DEG = (37.721, -122.4723)
HOME_ECEF_M = np.array([-2_712_087.5, -4_261_670.0, 3_881_014.4])
CAMERAS = ("ring_front_center", "ring_rear_left")
SEVEN = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")


def times_ns(golden: GoldenScene) -> list[int]:
    """Times of the pictures in whole microseconds."""
    return [round((START_S + time_s) * 1e6) * 1000 for time_s in golden.TIMES_S]


def world_from_ego(golden: GoldenScene) -> list[np.ndarray]:
    """The vehicle's poses at these times."""
    return [matrix @ np.linalg.inv(EGO_FROM_CAM) for matrix in golden.world_from_cam]


def seven(matrix: np.ndarray) -> list[float]:
    """A quaternion w, x, y, z and a place."""
    return [*map(float, quaternion(matrix)), *matrix[:3, 3].tolist()]


def jpegs(golden: GoldenScene, folder: Path, names: list[str]) -> None:
    """Write the scene's pictures as JPEG files."""
    for png, name in zip(golden._pictures(folder), names, strict=True):
        (folder / name).write_bytes(jpeg_bytes(read_rgb(folder / png), 2))
        (folder / png).unlink()


def table(file: Path, **columns: Any) -> None:
    """Write Feather 2, as pandas does."""
    file.parent.mkdir(parents=True, exist_ok=True)
    feather.write_feather(pa.table(columns), file, compression="lz4")


def write_argoverse(golden: GoldenScene, root: Path) -> Path:
    """A log with two cameras that see the same; return its folder."""
    log = root / "adcf7d18-0510-35b0-a2fa-b4cea13a6d76"
    (fx, fy), (cx, cy), (width, height) = golden.FOCAL_PX, golden.CENTRE_PX, golden.SIZE_PX
    for camera in CAMERAS:
        folder = log / "sensors" / "cameras" / camera
        jpegs(golden, folder, [f"{time_ns}.jpg" for time_ns in times_ns(golden)])
    n = len(CAMERAS)
    table(
        log / "calibration" / "intrinsics.feather",
        sensor_name=CAMERAS,
        **{key: [v] * n for key, v in (("fx_px", fx), ("fy_px", fy), ("cx_px", cx), ("cy_px", cy))},
        **{key: [-0.1] * n for key in ("k1", "k2", "k3")},
        height_px=[height] * n,
        width_px=[width] * n,
    )
    mounting = dict(zip(SEVEN, ([value] * n for value in seven(EGO_FROM_CAM)), strict=True))
    table(log / "calibration" / "egovehicle_SE3_sensor.feather", sensor_name=CAMERAS, **mounting)
    rows = np.array([seven(pose) for pose in world_from_ego(golden)])
    poses = dict(zip(SEVEN, rows.T.tolist(), strict=True))
    table(log / "city_SE3_egovehicle.feather", timestamp_ns=times_ns(golden), **poses)
    return log


def write_nuscenes(golden: GoldenScene, root: Path) -> Path:
    """Two scenes with two cameras; the first camera of the first has the pictures."""
    names = [f"n008__CAM_FRONT__{time_ns // 1000}.jpg" for time_ns in times_ns(golden)]
    jpegs(golden, root / "samples" / "CAM_FRONT", names)
    (root / "maps").mkdir()
    write_png(root / "maps" / "mask.png", np.zeros((4, 4, 3), np.uint8))
    (fx, fy), (cx, cy), (width, height) = golden.FOCAL_PX, golden.CENTRE_PX, golden.SIZE_PX
    w, x, y, z, *place = seven(EGO_FROM_CAM)
    rows: dict[str, list[dict[str, Any]]] = {
        name: []
        for name in ("category", "attribute", "visibility", "instance", "sample_annotation")
    }
    rows["log"] = [{"token": "log", "logfile": "n008", "location": "boston-seaport"}]
    rows["map"] = [{"token": "map", "filename": "maps/mask.png", "log_tokens": ["log"]}]
    rows["scene"] = [
        {"token": f"s{i}", "name": f"scene-006{i}", "log_token": "log", "nbr_samples": 1}
        for i in (1, 2)
    ]
    rows["sensor"] = [
        {"token": "front", "channel": "CAM_FRONT", "modality": "camera"},
        {"token": "back", "channel": "CAM_BACK", "modality": "camera"},
        {"token": "top", "channel": "LIDAR_TOP", "modality": "lidar"},
    ]
    rows["calibrated_sensor"] = [
        {
            "token": "front-on-car",
            "sensor_token": "front",
            "translation": place,
            "rotation": [w, x, y, z],
            "camera_intrinsic": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]],
        }
    ]
    rows["sample"] = [{"token": "sample", "scene_token": "s1", "timestamp": 0}]
    rows["ego_pose"], rows["sample_data"] = [], []
    shots = zip(names, times_ns(golden), world_from_ego(golden), strict=True)
    for i, (name, time_ns, pose) in enumerate(shots):
        w, x, y, z, *place = seven(pose)
        timed = {"token": f"{i:032x}", "timestamp": time_ns // 1000}
        rows["ego_pose"].append({**timed, "rotation": [w, x, y, z], "translation": place})
        rows["sample_data"].append(
            {
                **timed,
                "sample_token": "sample",
                "ego_pose_token": timed["token"],
                "calibrated_sensor_token": "front-on-car",
                "fileformat": "jpg",
                "is_key_frame": i == 0,
                "height": height,
                "width": width,
                "filename": f"samples/CAM_FRONT/{name}",
                "prev": "",
                "next": "",
            }
        )
    (root / "v1.0-mini").mkdir()
    for name, entries in rows.items():
        (root / "v1.0-mini" / f"{name}.json").write_text(json.dumps(entries, indent=0))
    return root


def ecef_from_world() -> np.ndarray:
    """The golden scene's place on the Earth: its axes are east, north, up there."""
    phi, lam = np.radians(PLACE_DEG)
    up = np.array([np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)])
    east = np.array([-np.sin(lam), np.cos(lam), 0])
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([east, np.cross(up, east), up], axis=1)
    matrix[:3, 3] = HOME_ECEF_M
    return matrix


def write_comma(golden: GoldenScene, root: Path) -> Path:
    """A segment of three frames, grey 40, 80, 120, with two fixes of its GNSS."""
    segment = root / "b0c9d2329ad1606b|2018-08-02--08-34-47" / "40"
    (segment / "global_pose").mkdir(parents=True)
    with av.open(str(segment / "video.hevc"), "w", format="hevc") as container:
        stream = container.add_stream(
            "libx265", rate=Fraction(20), options={"x265-params": "log-level=none"}
        )
        stream.width, stream.height, stream.pix_fmt = 1164, 874, "yuv420p"
        for level in (40, 80, 120):
            grey = np.full((874, 1164, 3), level, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(grey, "rgb24")))
        container.mux(stream.encode(None))
    poses = [ecef_from_world() @ m @ np.linalg.inv(DEVICE_FROM_CAM) for m in golden.world_from_cam]
    arrays = {
        "frame_times": np.array(golden.TIMES_S),
        "frame_positions": np.array([pose[:3, 3] for pose in poses]),
        "frame_orientations": np.array([quaternion(pose) for pose in poses]),
    }
    for name, values in arrays.items():
        save(segment / "global_pose" / name, values)
    fix = [*PLACE_DEG, 7.8, 1.53e12, 31.6, 2.1]
    save(segment / "processed_log" / "GNSS" / "live_gnss_ublox" / "t", np.array([100.05, 100.15]))
    save(segment / "processed_log" / "GNSS" / "live_gnss_ublox" / "value", np.array([fix, fix]))
    return segment


def save(file: Path, values: np.ndarray) -> None:
    """Write an array without a suffix, as the set has them."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("wb") as out:
        np.save(out, values)


def write_boreas(golden: GoldenScene, root: Path, name: str = "boreas-2020-11-26-13-58") -> Path:
    """A drive; its angles are those of C = Rx(-r) Ry(-p) Rz(-y)."""
    drive = root / name
    lines = [
        "GPSTime,easting,northing,altitude,vel_east,vel_north,vel_up,roll,pitch,heading,"
        "angvel_z,angvel_y,angvel_x"
    ]
    folder = drive / "camera"
    shots = zip(golden._pictures(folder), times_ns(golden), golden.world_from_cam, strict=True)
    for picture, time_ns, pose in shots:
        (folder / picture).rename(folder / f"{time_ns // 1000}.png")
        c = pose[:3, :3]
        angles = np.arctan2(c[1, 2], c[2, 2]), -np.arcsin(c[0, 2]), np.arctan2(c[0, 1], c[0, 0])
        if c[0, 2] == 1:  # heading and roll turn about one axis
            angles = np.arctan2(-c[1, 0], c[1, 1]), -np.pi / 2, 0
        values = [*pose[:3, 3], 0, 0, 0, *angles, 0, 0, 0]
        lines.append(",".join([str(time_ns // 1000), *map(repr, map(float, values))]))
    (fx, fy), (cx, cy) = golden.FOCAL_PX, golden.CENTRE_PX
    for file, text in (
        ("applanix/camera_poses.csv", "\n".join(lines) + "\n"),
        ("calib/P_camera.txt", f"{fx} 0 {cx} 0\n0 {fy} {cy} 0\n0 0 1 0\n0 0 0 1\n"),
    ):
        (drive / file).parent.mkdir()
        (drive / file).write_text(text)
    return drive


if __name__ == "__main__":
    scene, out = GoldenScene(), Path(sys.argv[1])
    written = {
        "argoverse": write_argoverse(scene, out / "argoverse"),
        "nuscenes": write_nuscenes(scene, out / "nuscenes"),
        "comma2k19": write_comma(scene, out / "comma2k19"),
        "boreas": write_boreas(scene, out / "boreas"),
    }
    golden_values = {
        "sets": {name: str(path) for name, path in written.items()},
        "point": scene.POINT,
        "point_ecef": (ecef_from_world() @ [*scene.POINT, 1.0])[:3].tolist(),
        "ego": [seven(pose) for pose in world_from_ego(scene)],
        "mounting": seven(EGO_FROM_CAM),
        "times_ns": times_ns(scene),
        "pinhole": [*scene.FOCAL_PX, *scene.CENTRE_PX, *scene.SIZE_PX],
        "pictures": [str(p) for p in sorted((out / "boreas").rglob("*.png"))],
    }
    (out / "golden.json").write_text(json.dumps(golden_values))
