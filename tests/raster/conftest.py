"""Scenes with known properties, and every way to run the native rasterizer."""

from collections.abc import Iterator

import numpy as np
import pytest

from forward_isas import DEVICE, WORST_CASE, forward_isas
from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.native.backend import available_isas
from rfcore.raster.gaussians import Gaussians
from rfcore.raster.opencl import self_check
from rfcore.raster.opencl.device import BUILDS, Build, Device, build_device, find_device
from rfcore.raster.opencl.self_check import check_device


def scene(count: int = 300, degree: int = 3, seed: int = 0) -> Gaussians:
    """Return translucent blobs of 0.03 to 0.3 m in a box of 4 x 3 x 6 m in front of the camera."""
    rng = np.random.default_rng(seed)
    coefficients = (degree + 1) ** 2
    sh = rng.normal(0.0, 0.15, (count, coefficients, 3))
    sh[:, 0] += rng.uniform(-1.0, 1.5, (count, 3))
    arrays = (
        rng.uniform((-2.0, -1.5, 1.0), (2.0, 1.5, 7.0), (count, 3)),
        rng.normal(size=(count, 4)) * rng.uniform(0.2, 3.0, (count, 1)),
        rng.uniform(np.log(0.03), np.log(0.3), (count, 3)),
        rng.uniform(-3.0, 3.0, count),
        sh,
    )
    return Gaussians(*(np.ascontiguousarray(a, dtype=np.float32) for a in arrays))


def camera(width_px: int = 67, height_px: int = 45) -> Camera:
    """Return a camera that looks slightly down and to the left, off-centre principal point."""
    focal = 0.8 * width_px
    intrinsics = Intrinsics(
        width_px, height_px, focal, 1.03 * focal, 0.48 * width_px, 0.53 * height_px
    )
    rotation = (0.9979, 0.03, -0.05, 0.02)
    norm = sum(v * v for v in rotation) ** 0.5
    w, x, y, z = (v / norm for v in rotation)
    return Camera(intrinsics, Pose((0.1, -0.05, -0.2), (w, x, y, z)))


UNGUARDED = Build("unguarded", ("-DWORST_CASE", "-cl-mad-enable", "-cl-denorms-are-zero"))
WORST = Build("worst", (*BUILDS[1].options, *UNGUARDED.options))


@pytest.fixture(scope="session", autouse=True)
def worst_case_device() -> Iterator[None]:
    """Give ``open_device`` a device called worst-case, with the build of that name."""

    def open_first(wanted: str) -> Device:
        if wanted != WORST_CASE.partition(":")[2]:
            return first_exact(wanted)
        device = build_device(find_device(DEVICE), WORST)
        check_device(device)
        return device

    first_exact = self_check._first_exact
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(self_check, "_first_exact", open_first)
        yield


@pytest.fixture(scope="session")
def unguarded() -> Build:
    """Return the options of the worst build without the kernels' precautions."""
    return UNGUARDED


@pytest.fixture(params=forward_isas())
def forward_isa(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(params=available_isas())
def isa(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(params=[False, True], ids=["plain", "antialiased"])
def antialiased(request: pytest.FixtureRequest) -> bool:
    return bool(request.param)


@pytest.fixture(params=[1, 2, 5])
def threads(request: pytest.FixtureRequest) -> int:
    return int(request.param)
