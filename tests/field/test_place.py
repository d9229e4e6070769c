"""A field says where it is coarser than a camera."""

from dataclasses import replace

import pytest

from rfcore.camera import Intrinsics, median_focal_px
from rfcore.field import FieldMetadata, SplatField
from rfcore.field.place import coarseness
from tests.field.some import make_gaussians

SMALL = Intrinsics(640, 360, 320.0, 320.0, 320.0, 180.0)
LARGE = SMALL.resized(1280, 720)


@pytest.mark.parametrize(
    ("trained_px", "cameras", "said"),
    [
        (320.0, [SMALL], None),
        (320.0, [LARGE], "2.0 times as finely"),
        (320.0, [SMALL, LARGE, LARGE], "focal length 640 px, theirs 320 px"),
        (640.0, [LARGE], None),
        (640.0, [SMALL], None),
        (None, [LARGE], None),
    ],
)
def test_a_camera_that_sees_finer_than_the_training_pictures_is_told(trained_px, cameras, said):
    field = SplatField(make_gaussians(), FieldMetadata(focal_px=trained_px))
    told = coarseness(field, cameras)
    assert told is None if said is None else said in str(told)


def test_the_median_focal_length_is_that_of_most_cameras():
    wide = replace(SMALL, fx_px=100.004)
    assert median_focal_px([SMALL, wide, SMALL]) == 320.0
    assert median_focal_px([wide]) == 100.0
