"""Pictures and fields that must never change: both ends may run different versions.

``python tests/raster/test_native_golden.py`` prints the digests of today's kernels. They may only
change together with ``RENDERER_CONTRACT``, and the change belongs in CHANGELOG.md.
"""

import hashlib

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.native.backend import available_isas
from rfcore.raster.gaussians import Gaussians
from rfcore.raster.native import Rasterizer
from rfcore.raster.trainable import LearningRates, TrainableRasterizer

VIEW_DIGESTS = {
    False: "67e28fc19aca424329f52c2213f5a0b6",
    True: "166cd618d89adb962c1438894c17769a",
}
TRAINED_DIGESTS = {
    False: "939f45cf1ccd0c9d97f3774915e25b66",
    True: "0c3bf9129bb323d319e3c3666be49954",
}
FIELDS = ("means", "quaternions", "log_scales", "opacity_logits", "sh")


def cloud(count: int) -> Gaussians:
    """Uniform numbers alone: no transcendental function of some numpy decides a byte here."""
    rng = np.random.default_rng(2024)

    def uniform(low: float, high: float, *shape: int) -> np.ndarray:
        return (low + (high - low) * rng.random(shape)).astype(np.float32)

    means = uniform(-1.0, 1.0, count, 3) * np.array([3, 2, 3], np.float32)
    means[:, 2] += np.float32(4.0)
    return Gaussians(
        means,
        uniform(-1.0, 1.0, count, 4),
        uniform(-4.0, -1.0, count, 3),
        uniform(-4.0, 4.0, count),
        uniform(-0.5, 0.5, count, 16, 3),
    )


def camera(width_px: int, height_px: int) -> Camera:
    half = (0.5 * width_px, 0.5 * height_px)
    intrinsics = Intrinsics(width_px, height_px, 0.75 * width_px, 0.75 * width_px, *half)
    return Camera(intrinsics, Pose((0.25, -0.125, -0.5), (0.96, 0.0, 0.28, 0.0)))


def digest(*arrays: np.ndarray) -> str:
    return hashlib.blake2b(b"".join(a.tobytes() for a in arrays), digest_size=16).hexdigest()


def view_digest(antialiased: bool, isa: str | None = None) -> str:
    view = Rasterizer(cloud(1500), isa=isa, antialiased=antialiased).render(camera(90, 51))
    return digest(view.colour, view.depth, view.opacity)


def trained_digest(antialiased: bool, isa: str | None = None) -> str:
    trainable = TrainableRasterizer(cloud(500), isa=isa, antialiased=antialiased)
    view_from = camera(48, 40)
    target = np.random.default_rng(0).random((40, 48, 3), dtype=np.float32)
    for _ in range(2):
        trainable.iterate(view_from, target, LearningRates(means=1e-3))
    after = trainable.gaussians()
    return digest(*(getattr(after, name) for name in FIELDS))


def test_a_rendered_street_has_the_committed_bytes(forward_isa, antialiased):
    assert view_digest(antialiased, forward_isa) == VIEW_DIGESTS[antialiased]


@pytest.mark.parametrize("isa", available_isas())
def test_a_trained_street_has_the_committed_bytes(isa, antialiased):
    assert trained_digest(antialiased, isa) == TRAINED_DIGESTS[antialiased]


if __name__ == "__main__":
    for antialiased in (False, True):
        print(antialiased, view_digest(antialiased), trained_digest(antialiased))
