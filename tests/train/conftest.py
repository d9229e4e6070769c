"""A scene of a few hundred points and pictures of 40x24 px, and what can be wrong with them."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.image import Rgb
from rfcore.views import PointCloud, PosedPicture

K = Intrinsics(40, 24, 30.0, 30.0, 20.0, 12.0)


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
