"""A scene of a few hundred points and pictures of 40x24 px, and what can be wrong with them."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.image import Rgb
from rfcore.views import PointCloud, PosedPicture

PAINTS = {
    "black": lambda _: np.zeros((24, 40, 3), np.uint8),
    "white": lambda _: np.full((24, 40, 3), 255, np.uint8),
    "noise": lambda i: np.random.default_rng(i).integers(0, 256, (24, 40, 3), dtype=np.uint8),
}
K = Intrinsics(40, 24, 30.0, 30.0, 20.0, 12.0)


def write_drive(folder: Path, xs_m: Sequence[float]) -> Path:
    """Write pictures of a painted wall 4 m ahead as a dataset without points."""
    frames = []
    for i, x in enumerate(xs_m):
        u, v = (np.arange(48) + 0.5 - 24) / 10 + x, (np.arange(32) + 0.5 - 16) / 10
        level = 128 + 60 * np.sin(3 * u)[None] * np.cos(2 * v)[:, None]
        cv2.imwrite(str(folder / f"{i}.png"), np.repeat(level[..., None], 3, axis=2).astype("u1"))
        matrix = np.eye(4)  # OpenGL axes: looking along -z
        matrix[0, 3] = x
        frames.append({"file_path": f"{i}.png", "transform_matrix": matrix.tolist()})
    k = {"fl_x": 40.0, "fl_y": 40.0, "cx": 24.0, "cy": 16.0, "w": 48, "h": 32}
    (folder / "transforms.json").write_text(json.dumps({**k, "frames": frames}))
    return folder


@pytest.fixture(scope="session")
def cameras() -> tuple[Camera, ...]:
    """Four cameras side by side, looking along +z."""
    return tuple(Camera(K, Pose((x, 0.0, 0.0), (1.0, 0, 0, 0))) for x in (-0.4, -0.1, 0.2, 0.5))


@pytest.fixture(scope="session")
def points() -> PointCloud:
    """A wavy, coloured wall at a depth of 3 m."""
    rng = np.random.default_rng(0)
    xy = rng.uniform((-3, -2), (3, 2), (400, 2))
    z = 3 + 0.2 * np.sin(2 * xy[:, 0])
    rgb = 128 + 100 * np.sin(3 * xy @ np.array([[1.0, 0.5, 0.2], [0.3, 1.0, 0.8]]))
    return PointCloud(
        np.column_stack([xy, z]).astype(np.float32), np.clip(rgb, 0, 255).astype(np.uint8)
    )


@pytest.fixture(scope="session")
def posed(cameras: Sequence[Camera]) -> Callable[[Callable[[int], Rgb]], tuple[PosedPicture, ...]]:
    """Return a maker of posed pictures from a function of the view's number."""

    def make(paint: Callable[[int], Rgb]) -> tuple[PosedPicture, ...]:
        return tuple(
            PosedPicture(f"{i}.png", camera, lambda i=i: paint(i))
            for i, camera in enumerate(cameras)
        )

    return make
