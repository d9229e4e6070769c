"""The splats' kernels and the YUV conversion on another architecture: the same bytes.

A scene like a street and one of all poisons, through the NEON and the scalar kernels: picture,
depth, opacity, YUV and RGB planes, losses, parameters after three steps.
"""

import struct
from dataclasses import astuple, dataclass

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.native.yuv import i420_from_colour, rgb_from_i420
from rfcore.raster.gaussians import Gaussians
from rfcore.raster.native import Rasterizer
from rfcore.raster.trainable import LearningRates, TrainableRasterizer

pytestmark = [pytest.mark.nightly, pytest.mark.slow, pytest.mark.timeout(900)]

ARRAYS = ("means", "quaternions", "log_scales", "opacity_logits", "sh")
STEPS = 3
RATES = LearningRates(means=1e-2)


@dataclass(frozen=True)
class Scene:
    """The scene that both machines draw and train."""

    gaussians: Gaussians
    camera: Camera
    antialiased: bool

    @property
    def target(self) -> np.ndarray:
        k = self.camera.intrinsics
        return np.random.default_rng(0).random((k.height_px, k.width_px, 3), dtype=np.float32)

    def to_bytes(self) -> bytes:
        k, g = self.camera.intrinsics, self.gaussians
        rotation = np.array(self.camera.cam_from_world().rotation_matrix()).ravel()
        numbers = [*rotation, *self.camera.world_from_cam.translation_m]
        numbers += [k.fx_px, k.fy_px, k.cx_px, k.cy_px]
        sizes = (len(g), g.sh_degree, k.width_px, k.height_px)
        header = struct.pack("<6i", *sizes, STEPS, self.antialiased)
        rates = struct.pack("<11f", *astuple(RATES))
        arrays = [getattr(g, name) for name in ARRAYS]
        return header + struct.pack("<16d", *numbers) + rates + _bytes(*arrays, self.target)


def street(antialiased: bool) -> Scene:
    """Uniform numbers alone, a camera that looks around, a picture of odd sides."""
    rng = np.random.default_rng(2024)
    n = 1500
    means = rng.uniform((-3, -2, 1), (3, 2, 7), (n, 3))
    values = (
        *(means, rng.uniform(-1, 1, (n, 4)), rng.uniform(-4, -1, (n, 3))),
        *(rng.uniform(-4, 4, n), rng.uniform(-0.5, 0.5, (n, 16, 3))),
    )
    pose = Pose((0.25, -0.125, -0.5), (0.96, 0.0, 0.28, 0.0))
    camera = Camera(Intrinsics(91, 51, 68.0, 70.0, 45.0, 26.0), pose)
    return Scene(Gaussians(*(v.astype(np.float32) for v in values)), camera, antialiased)


def poison(antialiased: bool) -> Scene:
    """Needles to giants, zero and overflowing quaternions, no and full opacity, bad places."""
    rng = np.random.default_rng(7)
    n = 512
    means = rng.normal(size=(n, 3)) * [2, 1, 1] + [0, 0, 3]
    quaternions = rng.normal(size=(n, 4)) * 10.0 ** rng.uniform(-40, 38, (n, 1))
    log_scales, logits = rng.uniform(-40, 40, (n, 3)), rng.normal(size=n) * 10
    sh = rng.normal(size=(n, 4, 3)) * 10.0 ** rng.uniform(-3, 30, (n, 1, 1))
    quaternions[:16], logits[16:32], logits[32:48], logits[48:56] = 0, 30, -30, 3e38
    means[64:80], means[80:96], means[96:112] = 0, [0, 0, 0.01], [1e6, -1e6, 0.02]
    means[112:128], means[128:144], means[144:160] = [1, 1, 3e38], [3e38, 3e38, 1], [0.1, 0.1, 3]
    log_scales[160:400] = rng.uniform(-6, 0, (240, 3))
    sh[160:400] = rng.normal(size=(240, 4, 3))
    values = (means, quaternions, log_scales, logits, sh)
    with np.errstate(over="ignore"):
        arrays = [np.nan_to_num(v.astype(np.float32)) for v in values]
    camera = Camera(Intrinsics(40, 24, 30.0, 30.0, 20.0, 12.0), Pose.identity())
    return Scene(Gaussians(*arrays), camera, antialiased)


SCENES = {"street": street, "poison": poison}


@pytest.mark.parametrize(
    ("isa", "threads", "antialiased"), [("neon", 1, True), ("neon", 3, False), ("scalar", 2, False)]
)
@pytest.mark.parametrize("name", SCENES)
def test_aarch64_draws_and_trains_the_same_bytes(
    emulated, first_difference, name, isa, threads, antialiased
):
    scene = SCENES[name](antialiased)
    there = emulated("exactness_splats", isa, threads, scene.to_bytes())
    assert first_difference(there, drawn(scene) + trained(scene)) is None


def drawn(scene: Scene) -> bytes:
    view = Rasterizer(scene.gaussians, antialiased=scene.antialiased).render(scene.camera)
    picture = i420_from_colour(view.colour)
    rgb = rgb_from_i420(picture)
    return _bytes(view.colour, view.depth, view.opacity, *picture.planes, rgb)


def trained(scene: Scene) -> bytes:
    trainable = TrainableRasterizer(scene.gaussians, antialiased=scene.antialiased)
    losses = [trainable.iterate(scene.camera, scene.target, RATES) for _ in range(STEPS)]
    after = trainable.gaussians()
    return struct.pack(f"<{STEPS}d", *losses) + _bytes(*(getattr(after, name) for name in ARRAYS))


def _bytes(*arrays: np.ndarray) -> bytes:
    return b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)
