"""A street of a few hundred Gaussians as a whole sample: views, points, two drives, manifest."""

import json
from pathlib import Path

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.dataset import write_manifest
from rfcore.image import write_png
from rfcore.raster.gaussians import Gaussians
from rfcore.raster.native import Rasterizer

INTRINSICS = Intrinsics(96, 64, 60.0, 60.0, 48.0, 32.0)
OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
DRIVE_FRAMES = 4


def tiny_street() -> Gaussians:
    rng = np.random.default_rng(3)
    n = 400
    means = rng.uniform([-4, -2, 4], [4, 2, 9], (n, 3)).astype(np.float32)
    sh = np.zeros((n, 1, 3), np.float32)
    sh[:, 0] = rng.uniform(-1.5, 1.5, (n, 3))
    return Gaussians(
        means=means,
        quaternions=np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        log_scales=np.full((n, 3), np.log(0.25), np.float32),
        opacity_logits=np.full(n, 2.0, np.float32),
        sh=sh,
    )


def camera_at(x_m: float) -> Camera:
    return Camera(INTRINSICS, Pose((x_m, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)))


def picture_of(rasterizer: Rasterizer, camera: Camera) -> np.ndarray:
    colour = rasterizer.render(camera).colour
    return np.floor(np.clip(colour, 0, 1) * 255 + 0.5).astype(np.uint8)


def write_views(folder: Path, name: str, xs_m: list[float], boxes: bool = False) -> None:
    """Render and write one set of views, with a box nobody trained on if ``boxes``."""
    rasterizer = Rasterizer(tiny_street())
    frames = []
    (folder / name).mkdir()
    for number, x_m in enumerate(xs_m):
        camera = camera_at(x_m)
        rgb = picture_of(rasterizer, camera)
        if boxes:
            rgb[20:40, 10 + 4 * number : 34 + 4 * number] = (200, 30, 40)
        file = f"{name}/{number:03d}.png"
        write_png(folder / file, rgb)
        matrix = np.eye(4)
        matrix[0, 3] = x_m
        frames.append(
            {
                "file_path": file,
                "transform_matrix": (matrix @ OPENGL_FROM_OPENCV).tolist(),
                "time": number / 10,
            }
        )
    k = INTRINSICS
    content = {"w": k.width_px, "h": k.height_px, "fl_x": k.fx_px, "fl_y": k.fy_px}
    content |= {"cx": k.cx_px, "cy": k.cy_px, "frames": frames}
    if name == "train":
        content["ply_file_path"] = "points.ply"
    (folder / f"transforms_{name}.json").write_text(json.dumps(content))


def write_points(path: Path) -> None:
    gaussians = tiny_street()
    vertex = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])
    vertices = np.zeros(len(gaussians), vertex)
    vertices["xyz"] = gaussians.means
    vertices["rgb"] = 128
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(gaussians)}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    header += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    path.write_bytes(f"{header}end_header\n".encode() + vertices.tobytes())


@pytest.fixture
def tiny_sample(tmp_path: Path) -> Path:
    """Return a folder laid out as ``samples/street``."""
    folder = tmp_path / "tiny"
    folder.mkdir()
    write_views(folder, "train", [i / 4 - 1.5 for i in range(12)])
    drive = [i / 10 for i in range(DRIVE_FRAMES)]
    write_views(folder, "drive_empty", drive)
    write_views(folder, "drive_vehicles", drive, boxes=True)
    write_points(folder / "points.ply")
    write_manifest(folder)
    return folder


@pytest.fixture
def tiny_gaussians() -> Gaussians:
    """Return the Gaussians the tiny street's pictures were rendered from."""
    return tiny_street()
