"""A wall of splats, and passes of vehicles along it in the light of the field or in another."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.field import SplatField
from rfcore.field.layer import SH_DC
from rfcore.image import Rgb
from rfcore.raster.gaussians import Gaussians
from rfcore.update.passes import Pass
from rfcore.views import PosedPicture

K = Intrinsics(96, 64, 70.0, 70.0, 48.0, 32.0)
Paint = Callable[[int, Rgb], Rgb]
MakePass = Callable[..., Pass]


def wall() -> Gaussians:
    """900 flat splats at a depth of 4 m, textured."""
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.linspace(-4, 4, 36), np.linspace(-2.5, 2.5, 25))
    means = np.stack([x.ravel(), y.ravel(), np.full(x.size, 4.0)], axis=1)
    n = len(means)
    colours = 0.5 + 0.3 * rng.uniform(-1, 1, (n, 3))
    return Gaussians(
        means=means.astype(np.float32),
        quaternions=np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        log_scales=np.tile(np.log(np.float32([0.13, 0.13, 0.02])), (n, 1)),
        opacity_logits=np.full(n, 3.0, np.float32),
        sh=((colours - 0.5) / SH_DC).astype(np.float32)[:, None],
    )


def at_dusk(gaussians: Gaussians) -> Gaussians:
    """A third of the light, bluer, and darker to one side: no matrix of colours says it."""
    shade = 1.0 / (1.0 + np.exp(-2 * gaussians.means[:, 0]))
    colours = gaussians.sh[:, 0] * SH_DC + 0.5
    tint = np.array([0.25, 0.3, 0.5]) * (0.4 + shade)[:, None]
    return replace(gaussians, sh=((colours * tint - 0.5) / SH_DC).astype(np.float32)[:, None])


@pytest.fixture(scope="session")
def noon() -> SplatField:
    return SplatField(wall())


@pytest.fixture(scope="session")
def dusk() -> SplatField:
    return SplatField(at_dusk(wall()))


@pytest.fixture(scope="session")
def make_pass() -> MakePass:
    """Return a maker of passes of 12 frames along a field, 0.1 m apart."""

    def make(
        field: SplatField, identity: str = "cav-1", shift_m: float = 0.0, paint: Paint | None = None
    ) -> Pass:
        pictures = []
        for number in range(12):
            pose = Pose((0.1 * number - 0.6 + shift_m, 0.0, 0.0), (1.0, 0, 0, 0))
            camera = Camera(K, pose.rounded())
            rgb = np.rint(np.clip(field.render_colour(camera), 0, 1) * 255).astype(np.uint8)
            rgb = rgb if paint is None else paint(number, rgb)
            pictures.append(PosedPicture(f"{number}.png", camera, lambda rgb=rgb: rgb))
        return Pass(identity, tuple(pictures))

    return make
