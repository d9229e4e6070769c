"""Training pictures are read once, as they are, and known by their digest."""

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfcore.train.targets import Target, halved, load_targets


def test_black_is_zero_and_white_is_one(posed):
    targets, _ = load_targets(posed(lambda i: np.full((24, 40, 3), 255 * (i % 2), np.uint8)))
    assert [float(target.colour().max()) for target in targets] == [0.0, 1.0, 0.0, 1.0]
    assert targets[0].colour().dtype == np.float32


def test_the_digest_depends_on_pixels_and_cameras(posed):
    black, grey = (posed(lambda _, c=c: np.full((24, 40, 3), c, np.uint8)) for c in (0, 9))
    assert load_targets(black)[1] == load_targets(black)[1]
    assert load_targets(black)[1] != load_targets(grey)[1]
    assert load_targets(black)[1] != load_targets(black[::-1])[1]


def test_no_pictures_are_refused():
    with pytest.raises(InvalidInput, match="at least one"):
        load_targets([])


CAMERA = Camera(Intrinsics(5, 4, 6.0, 8.0, 2.4, 2.0), Pose((0, 0, 0), (1.0, 0, 0, 0)))


def test_a_halved_picture_is_the_mean_of_its_quads_and_drops_an_odd_column():
    rgb = np.random.default_rng(1).integers(0, 256, (4, 5, 3), dtype=np.uint8)
    half = halved(Target(CAMERA, rgb)).rgb
    assert (half.shape, half.dtype, half.flags.c_contiguous) == ((2, 2, 3), np.uint8, True)
    for y, x in np.ndindex(2, 2):
        mean = rgb[2 * y : 2 * y + 2, 2 * x : 2 * x + 2].reshape(4, 3).mean(axis=0)
        np.testing.assert_array_equal(half[y, x], np.floor(mean + 0.5))


def test_a_point_lies_at_half_its_coordinates_in_a_halved_picture():
    half = halved(Target(CAMERA, np.zeros((4, 5, 3), np.uint8)))
    u, v, z = CAMERA.project((0.3, -0.2, 2.0))
    assert half.camera.project((0.3, -0.2, 2.0)) == pytest.approx((u / 2, v / 2, z))


def test_a_picture_of_one_row_cannot_be_halved():
    camera = Camera(Intrinsics(5, 1, 6.0, 8.0, 2.4, 0.5), CAMERA.world_from_cam)
    with pytest.raises(InvalidInput, match="5x1 px cannot be halved"):
        halved(Target(camera, np.zeros((1, 5, 3), np.uint8)))
