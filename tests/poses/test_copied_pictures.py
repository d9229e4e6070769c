"""Pictures that COLMAP would read otherwise than they are shown are written anew."""

import cv2
import numpy as np
import pytest

from rfcore.errors import DatasetError
from rfcore.image import read_rgb
from rfedge.datasets.colmap_features import PoseSettings
from rfedge.datasets.poses import _copied, pose_dataset
from tests.dataset.test_picture_file import RGB, with_exif


def test_exif_is_applied_and_said(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), RGB)
    told: list[str] = []
    (tmp_path / "new").mkdir()
    copy = _copied(with_exif(tmp_path / "a.png", 6), tmp_path / "new", told.append)
    assert np.array_equal(read_rgb(copy)[..., ::-1], cv2.rotate(RGB, cv2.ROTATE_90_CLOCKWISE))
    assert told == ["a.png: turned by 90 degrees clockwise"]


@pytest.mark.parametrize(
    ("name", "kept"), [("a.png", True), ("a.jpg", True), ("a.webp", False), ("a.tif", False)]
)
def test_other_formats_become_png_and_the_rest_stays_as_it_is(name, kept, tmp_path):
    cv2.imwrite(str(tmp_path / name), RGB)
    told: list[str] = []
    (tmp_path / "new").mkdir()
    copy = _copied(tmp_path / name, tmp_path / "new", told.append)
    assert (copy.read_bytes() == (tmp_path / name).read_bytes()) == kept
    assert bool(told) != kept
    assert np.array_equal(read_rgb(copy), read_rgb(tmp_path / name))


def test_heic_is_named_with_what_to_do(tmp_path):
    (tmp_path / "shots").mkdir()
    (tmp_path / "shots" / "IMG_1.jpg").write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic")
    with pytest.raises(
        DatasetError, match="1 of 1 pictures are HEIC, which is not read; convert: pip"
    ):
        pose_dataset(tmp_path / "shots", tmp_path / "out", None, PoseSettings(), print)
    assert not (tmp_path / "out").exists()
