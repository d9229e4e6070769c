"""The quick SSIM is the exact one."""

import numpy as np
import pytest

from rfcore.errors import InvalidInput
from rfcore.metrics import ssim
from rfedge.evaluate.ssim import luma_ssim

RNG = np.random.default_rng(4)
SMOOTH = np.cumsum(RNG.integers(-3, 4, (64, 96)), axis=1).clip(-100, 100) + 128
PICTURES = {
    "noise": RNG.integers(0, 256, (64, 96)),
    "smooth": SMOOTH,
    "flat and bright": np.full((64, 96), 235),
    "black": np.zeros((64, 96)),
}


@pytest.mark.parametrize("name", PICTURES)
@pytest.mark.parametrize("error", [0, 1, 12])
def test_it_is_the_exact_one_but_for_rounding(name, error):
    a = PICTURES[name].astype(np.uint8)
    b = (a + RNG.integers(-error, error + 1, a.shape)).clip(0, 255).astype(np.uint8)
    assert luma_ssim(a, b) == pytest.approx(ssim(a, b), abs=1e-4)


def test_unequal_shapes_are_refused():
    with pytest.raises(InvalidInput, match="ssim"):
        luma_ssim(np.zeros((4, 4), np.uint8), np.zeros((4, 5), np.uint8))
