"""The size of a picture is read from its header, and no name leaves the dataset's folder."""

import cv2
import numpy as np
import pytest

from rfcore.camera import Intrinsics
from rfcore.dataset.picture_file import (
    check_size,
    find_picture,
    inside,
    picture_size_px,
    read_picture,
)
from rfcore.errors import DatasetError

RGB = np.random.default_rng(2).integers(0, 256, (31, 77, 3), dtype=np.uint8)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("a.png", []),
        ("a.jpg", []),
        ("a.jpg", [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
        ("a.webp", [cv2.IMWRITE_WEBP_QUALITY, 101]),
        ("a.webp", [cv2.IMWRITE_WEBP_QUALITY, 80]),
    ],
)
def test_the_header_says_how_large_a_picture_is(name, options, tmp_path):
    assert cv2.imwrite(str(tmp_path / name), RGB, options)
    assert picture_size_px(tmp_path / name) == (77, 31)


def test_other_formats_are_measured_when_they_are_read(tmp_path):
    assert cv2.imwrite(str(tmp_path / "a.bmp"), RGB)
    assert picture_size_px(tmp_path / "a.bmp") is None


def test_a_hostile_size_is_refused_unread(tmp_path):
    header = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + (30_000).to_bytes(4) * 2
    (tmp_path / "huge.png").write_bytes(header)
    with pytest.raises(DatasetError, match=r"huge\.png: picture is 30000x30000 px, over.*8192"):
        check_size(tmp_path / "huge.png", Intrinsics(8, 6, 9, 9, 4, 3))


def test_a_name_without_suffix_finds_its_picture(tmp_path):
    cv2.imwrite(str(tmp_path / "r_0.jpg"), RGB)
    cv2.imwrite(str(tmp_path / "r_1.5.png"), RGB)
    assert find_picture("x", tmp_path, "./r_0") == tmp_path / "r_0.jpg"
    assert find_picture("x", tmp_path, "r_1.5") == tmp_path / "r_1.5.png"
    with pytest.raises(DatasetError, match=r"^x: picture .*r_2 is missing"):
        find_picture("x", tmp_path, "r_2")


@pytest.mark.parametrize("name", ["../a.png", "/etc/passwd", "b/../../a.png", "..\\a.png", "a\0b"])
def test_no_name_leaves_the_folder(name, tmp_path):
    with pytest.raises(DatasetError, match="leaves the dataset's folder"):
        inside("x", tmp_path, name)


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.webp"])
@pytest.mark.parametrize("share", [0.3, 0.7, 0.97])
def test_a_truncated_picture_is_refused(name, share, tmp_path):
    path = tmp_path / name
    assert cv2.imwrite(str(path), RGB)
    camera = Intrinsics(77, 31, 50.0, 50.0, 38.0, 15.0)
    assert read_picture(path, camera).shape == (31, 77, 3)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(DatasetError, match=rf"{path.name}: (truncated|not a readable)"):
        read_picture(path, camera)


def test_a_picture_longer_than_its_pixels_can_be_is_refused_unread(tmp_path):
    path = tmp_path / "long.jpg"
    assert cv2.imwrite(str(path), RGB)
    k = Intrinsics(77, 31, 9, 9, 4, 3)
    assert read_picture(path, k).shape == RGB.shape
    with path.open("r+b") as file:
        file.truncate(1 << 40)
    with pytest.raises(DatasetError, match="1099511627776 bytes are too many for 77x31 px"):
        read_picture(path, k)
