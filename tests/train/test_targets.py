"""Training pictures are read once, as they are, and known by their digest."""

import numpy as np
import pytest

from rfcore.errors import InvalidInput
from rfcore.train.targets import load_targets


def test_black_is_zero_and_white_is_one(posed) -> None:
    targets, _ = load_targets(posed(lambda i: np.full((24, 40, 3), 255 * (i % 2), np.uint8)))
    assert [float(target.colour().max()) for target in targets] == [0.0, 1.0, 0.0, 1.0]
    assert targets[0].colour().dtype == np.float32


def test_the_digest_depends_on_pixels_and_cameras(posed) -> None:
    black, grey = (posed(lambda _, c=c: np.full((24, 40, 3), c, np.uint8)) for c in (0, 9))
    assert load_targets(black)[1] == load_targets(black)[1]
    assert load_targets(black)[1] != load_targets(grey)[1]
    assert load_targets(black)[1] != load_targets(black[::-1])[1]


def test_no_pictures_are_refused() -> None:
    with pytest.raises(InvalidInput, match="at least one"):
        load_targets([])
