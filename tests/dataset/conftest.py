"""Datasets small enough to write by hand: two grey pictures, and one scene in every format."""

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from rfcore.field.ply_table import write_vertices
from rfcore.image import read_rgb, write_png

Write = Callable[..., Path]


def transforms() -> dict[str, Any]:
    identity = [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]]
    moved = [[1.0, 0, 0, 2.0], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]]
    return {
        "fl_x": 10.0,
        "fl_y": 12.0,
        "cx": 4.0,
        "cy": 3.0,
        "w": 8,
        "h": 6,
        "camera_model": "OPENCV",
        "ply_file_path": "points.ply",
        "frames": [
            {"file_path": "a.png", "transform_matrix": identity, "time": 0.0},
            {"file_path": "b.png", "transform_matrix": moved, "time": 0.1},
        ],
    }


@pytest.fixture
def content() -> dict[str, Any]:
    """The JSON of the dataset, to be changed by a test and passed to ``write``."""
    return transforms()


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Write pictures, points and the given JSON; return the transforms file."""
    for name, level in (("a.png", 10), ("b.png", 20)):
        write_png(tmp_path / name, np.full((6, 8, 3), level, np.uint8))
    row = [(n, "<f4") for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")]
    points = np.array([(0, 0, 1, 1, 2, 3), (4, 5, 6, 7, 8, 9), (0.5, 0, -1, 255, 0, 0)], row)
    write_vertices(tmp_path / "points.ply", points)

    def write_json(content: dict[str, Any], name: str = "transforms.json") -> Path:
        (tmp_path / name).write_text(json.dumps(content))
        return tmp_path / name

    return write_json


class GoldenScene:
    """Three cameras in a z-up world, written in every format by the formats' own definitions.

    Nothing of the readers is used: poses are 4x4 matrices, ``world_from_cam`` with OpenCV axes,
    made from a yaw and a place. Pictures are grey with one white pixel where ``POINT`` is seen.
    """

    FORMATS = ("transforms", "colmap_text", "colmap_binary", "kitti", "inria", "folder", "video")
    POINT = (7.0, 1.5, 2.25)
    SIZE_PX = (64, 48)
    FOCAL_PX = (50.0, 52.0)
    CENTRE_PX = (32.0, 24.0)
    TIMES_S = (100.0, 100.1, 100.2)

    def __init__(self, origin: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        self.point = tuple(a + b for a, b in zip(self.POINT, origin, strict=True))
        yaws_places = ((0.0, (0, 0, 1.5)), (0.2, (1, -0.5, 1.6)), (-0.15, (2, 0.5, 1.4)))
        self.world_from_cam = [
            looking_along(yaw, np.add(place, origin)) for yaw, place in yaws_places
        ]

    def pixels(self) -> list[tuple[float, float]]:
        """K [R | t] X, written out."""
        found = []
        for matrix in self.world_from_cam:
            x, y, z, _ = np.linalg.inv(matrix) @ (*self.point, 1.0)
            found.append(
                (
                    self.FOCAL_PX[0] * x / z + self.CENTRE_PX[0],
                    self.FOCAL_PX[1] * y / z + self.CENTRE_PX[1],
                )
            )
        return found

    def write(self, format_name: str, folder: Path) -> Path:
        """Write the scene; return the path to read."""
        folder.mkdir(parents=True, exist_ok=True)
        return getattr(self, f"_{format_name}")(folder)

    def _pictures(self, folder: Path) -> list[str]:
        folder.mkdir(parents=True, exist_ok=True)
        names = []
        for i, (u, v) in enumerate(self.pixels()):
            rgb = np.full((self.SIZE_PX[1], self.SIZE_PX[0], 3), 90, np.uint8)
            rgb[int(v), int(u)] = 255
            write_png(folder / f"{i:06d}.png", rgb)
            names.append(f"{i:06d}.png")
        return names

    def _transforms(self, folder: Path) -> Path:
        """nerfstudio: OpenGL axes, so the y and z columns change sign."""
        names = self._pictures(folder / "images")
        frames = [
            {
                "file_path": f"images/{name}",
                "transform_matrix": (matrix @ np.diag([1.0, -1, -1, 1])).tolist(),
                "time": time_s,
            }
            for name, matrix, time_s in zip(names, self.world_from_cam, self.TIMES_S, strict=True)
        ]
        (fx, fy), (cx, cy), (w, h) = self.FOCAL_PX, self.CENTRE_PX, self.SIZE_PX
        content = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": w, "h": h, "frames": frames}
        (folder / "transforms.json").write_text(json.dumps(content | {"camera_model": "OPENCV"}))
        return folder

    def _colmap_images(self) -> list[tuple[int, list[float]]]:
        """COLMAP: cam_from_world, quaternion w x y z."""
        rows = []
        for i, matrix in enumerate(self.world_from_cam):
            inverse = np.linalg.inv(matrix)
            rows.append((i + 1, [*quaternion(inverse), *inverse[:3, 3]]))
        return rows

    def _colmap_text(self, folder: Path) -> Path:
        names = self._pictures(folder / "images")
        model = folder / "sparse" / "0"
        model.mkdir(parents=True)
        (fx, fy), (cx, cy), (w, h) = self.FOCAL_PX, self.CENTRE_PX, self.SIZE_PX
        (model / "cameras.txt").write_text(f"# id model\n7 PINHOLE {w} {h} {fx} {fy} {cx} {cy}\n")
        lines = ["# two lines an image"]
        for (i, numbers), name in zip(self._colmap_images(), names, strict=True):
            lines += [f"{i} {' '.join(map(repr, map(float, numbers)))} 7 {name}", ""]
        (model / "images.txt").write_text("\n".join(lines) + "\n")
        x, y, z = self.point
        (model / "points3D.txt").write_text(f"# points\n1 {x} {y} {z} 255 128 0 0.5 1 0 2 0\n")
        return folder

    def _colmap_binary(self, folder: Path) -> Path:
        names = self._pictures(folder / "images")
        model = folder / "sparse" / "0"
        model.mkdir(parents=True)
        camera = struct.pack("<IiQQ4d", 7, 1, *self.SIZE_PX, *self.FOCAL_PX, *self.CENTRE_PX)
        (model / "cameras.bin").write_bytes(struct.pack("<Q", 1) + camera)
        images = struct.pack("<Q", len(names))
        for (i, numbers), name in zip(self._colmap_images(), names, strict=True):
            images += struct.pack("<I7dI", i, *numbers, 7) + name.encode() + b"\0"
            images += struct.pack("<QddQ", 1, 3.5, 4.5, 1)
        (model / "images.bin").write_bytes(images)
        point = struct.pack("<QQ3d3Bd", 1, 1, *self.point, 255, 128, 0, 0.5)
        (model / "points3D.bin").write_bytes(point + struct.pack("<QIIII", 2, 1, 0, 2, 0))
        return folder

    def _kitti(self, folder: Path) -> Path:
        """P2 = K [I | t] from camera 0, and the poses are camera 0's."""
        self._pictures(folder / "image_2")
        (fx, fy), (cx, cy) = self.FOCAL_PX, self.CENTRE_PX
        cam2_from_cam0 = np.eye(4)
        cam2_from_cam0[:3, 3] = (0.06, -0.002, 0.003)
        k = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        p2 = k @ cam2_from_cam0[:3]
        lines = [f"P{i}: {' '.join(['0'] * 12)}" for i in (0, 1)]
        lines += [f"P2: {' '.join(map(repr, p2.ravel().tolist()))}"]
        (folder / "calib.txt").write_text("\n".join(lines) + "\n")
        (folder / "times.txt").write_text("\n".join(f"{t:.6e}" for t in self.TIMES_S) + "\n")
        rows = [(m @ cam2_from_cam0)[:3].ravel().tolist() for m in self.world_from_cam]
        poses = "\n".join(" ".join(map(repr, row)) for row in rows)
        (folder / "poses.txt").write_text(poses + "\n")
        return folder

    def _inria(self, folder: Path) -> Path:
        """camera_to_JSON: rows of world_from_cam, principal point in the middle."""
        names = self._pictures(folder / "images")
        entries = [
            {
                "id": i,
                "img_name": name.removesuffix(".png"),
                "width": self.SIZE_PX[0],
                "height": self.SIZE_PX[1],
                "position": matrix[:3, 3].tolist(),
                "rotation": matrix[:3, :3].tolist(),
                "fx": self.FOCAL_PX[0],
                "fy": self.FOCAL_PX[1],
            }
            for i, (name, matrix) in enumerate(zip(names, self.world_from_cam, strict=True))
        ]
        (folder / "cameras.json").write_text(json.dumps(entries))
        return folder

    def _recording(self, folder: Path, pictures: str, csv: bool) -> Path:
        """The body is a vehicle (x forward, y left, z up) with the camera 1.2 m ahead, 0.4 m up."""
        body_from_cam = np.array([[0, 0, 1, 1.2], [-1, 0, 0, 0], [0, -1, 0, 0.4], [0, 0, 0, 1.0]])
        rows = []
        for time_s, matrix in zip(self.TIMES_S, self.world_from_cam, strict=True):
            world_from_body = matrix @ np.linalg.inv(body_from_cam)
            w, x, y, z = quaternion(world_from_body)
            rows.append((time_s, *world_from_body[:3, 3], x, y, z, w))
        head = "time_s,x_m,y_m,z_m,qx,qy,qz,qw" if csv else "# timestamp tx ty tz qx qy qz qw"
        separator = "," if csv else " "
        lines = [separator.join(repr(float(value)) for value in row) for row in rows]
        name = "trajectory.csv" if csv else "trajectory.txt"
        (folder / name).write_text("\n".join([head, *lines]) + "\n")
        (fx, fy), (cx, cy), (w_px, h_px) = self.FOCAL_PX, self.CENTRE_PX, self.SIZE_PX
        (folder / "camera.toml").write_text(
            f"[camera]\nwidth_px = {w_px}\nheight_px = {h_px}\nfx_px = {fx}\nfy_px = {fy}\n"
            f"cx_px = {cx}\ncy_px = {cy}\n[pictures]\n{pictures}\n[trajectory]\nfile = '{name}'\n"
            f"time_offset_s = 100.0\nbody_from_cam = {body_from_cam.tolist()}\n"
        )
        return folder

    def _folder(self, folder: Path) -> Path:
        self._pictures(folder / "frames")
        return self._recording(folder, 'folder = "frames"\nrate_hz = 10', csv=True)

    def _video(self, folder: Path) -> Path:
        names = self._pictures(folder / "shots")
        with av.open(str(folder / "drive.mp4"), "w") as container:
            stream = container.add_stream("libx264rgb", rate=10, options={"qp": "0"})
            stream.width, stream.height = self.SIZE_PX
            stream.pix_fmt = "rgb24"
            for name in names:
                frame = av.VideoFrame.from_ndarray(read_rgb(folder / "shots" / name), "rgb24")
                container.mux(stream.encode(frame))
            container.mux(stream.encode(None))
        return self._recording(folder, 'video = "drive.mp4"', csv=False)


def looking_along(yaw: float, place: np.ndarray) -> np.ndarray:
    """world_from_cam of a level camera: columns right, down, forward; yaw 0 looks along world x."""
    forward = np.array([np.cos(yaw), np.sin(yaw), 0])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0])
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    matrix[:3, 3] = place
    return matrix


def quaternion(matrix: np.ndarray) -> tuple[float, float, float, float]:
    """w, x, y, z of a rotation by its eigenvector (Bar-Itzhack), unlike the product's method."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = matrix[:3, :3]
    k = np.array(
        [
            [xx - yy - zz, yx + xy, zx + xz, zy - yz],
            [yx + xy, yy - xx - zz, zy + yz, xz - zx],
            [zx + xz, zy + yz, zz - xx - yy, yx - xy],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
    )
    x, y, z, w = np.linalg.eigh(k)[1][:, -1]
    return float(w), float(x), float(y), float(z)


@pytest.fixture
def golden() -> GoldenScene:
    """The golden scene around the world's zero."""
    return GoldenScene()


@pytest.fixture
def golden_utm() -> GoldenScene:
    """The same scene at UTM magnitudes."""
    return GoldenScene((691_608.0, 5_334_760.0, 519.0))
