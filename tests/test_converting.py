"""A converted dataset shows the same world as the one it was made from."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from rfcore.camera import Intrinsics, Pose
from rfcore.dataset import read_dataset
from rfcore.dataset.source import SourceCamera
from rfcore.dataset.write import WrittenPicture, write_transforms
from rfcore.errors import DatasetError, InvalidInput
from rfcore.image import read_rgb, write_png
from rfcore.lens import BrownLens
from rfedge.arguments import parse_size
from rfedge.datasets.convert import convert_dataset

LENS = BrownLens(k1=-0.1)
K = Intrinsics(64, 48, 50.0, 50.0, 32.0, 24.0)


@pytest.fixture
def distorted(tmp_path: Path) -> Path:
    folder = tmp_path / "recording"
    folder.mkdir()
    pictures = []
    for i in range(4):
        write_png(folder / f"{i}.png", np.full((48, 64, 3), 10 * i, np.uint8))
        pose = Pose((float(i), 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
        pictures.append(WrittenPicture(f"{i}.png", SourceCamera(K, LENS), pose, i * 100_000_000))
    write_transforms(folder, pictures, None)
    return folder


def test_a_converted_dataset_needs_no_lens(distorted, tmp_path):
    line = convert_dataset(distorted, tmp_path / "out", (32, 24), slice(1, None, 2))
    assert line == f"{tmp_path / 'out'}: 2 pictures\n2 of 2 pictures are undistorted"
    plain, chosen = read_dataset(tmp_path / "out"), read_dataset(distorted, distortion="undistort")
    assert plain.rate_hz == pytest.approx(5.0)
    for found, given in zip(plain.pictures, chosen.pictures[1::2], strict=True):
        assert found.camera.intrinsics == given.camera.intrinsics.resized(32, 24)
        assert found.camera.world_from_cam == given.camera.world_from_cam
        assert found.time_ns == given.time_ns
        assert (found.read() == given.read()[0, 0]).all()


def test_pictures_of_one_time_keep_it(distorted, tmp_path):
    """Several cameras take a picture at once: there is a time, but no rate."""
    content = (distorted / "transforms.json").read_text()
    (distorted / "transforms.json").write_text(content.replace('"time": 0.1', '"time": 0.2'))
    convert_dataset(distorted, tmp_path / "out", None)
    dataset = read_dataset(tmp_path / "out")
    assert dataset.rate_hz is None
    assert [p.time_ns for p in dataset.pictures] == [0, 200_000_000, 200_000_000, 300_000_000]


def test_a_fault_leaves_nothing_behind(distorted, tmp_path):
    content = (distorted / "3.png").read_bytes()
    (distorted / "3.png").write_bytes(content[: len(content) // 2])
    with pytest.raises(DatasetError, match=r"3\.png"):
        convert_dataset(distorted, tmp_path / "out", None)
    assert [path.name for path in tmp_path.iterdir()] == ["recording"]


@pytest.mark.parametrize("chosen", [slice(9, None), slice(0, None, 0), slice(-1, None)])
def test_a_choice_of_nothing_is_refused(chosen, distorted, tmp_path):
    with pytest.raises(InvalidInput, match=r"^(every|offset): "):
        convert_dataset(distorted, tmp_path / "out", None, chosen)


def test_the_pictures_are_lossless(distorted, tmp_path):
    convert_dataset(distorted, tmp_path / "out", None)
    assert cv2.imread(str(tmp_path / "out" / "images" / "000002.png")).shape == (48, 64, 3)
    assert (read_rgb(tmp_path / "out" / "images" / "000002.png") == 20).all()


@pytest.mark.parametrize("text", ["", "640", "0x3", "x", "640X360", "-1x4", "9000x10", "٣x4"])
def test_a_size_is_width_x_height(text):
    assert parse_size("640x360") == (640, 360)
    with pytest.raises(InvalidInput, match="size: "):
        parse_size(text)


def test_masks_are_kept_and_hide_what_comes_from_a_hidden_pixel(distorted, tmp_path):
    mask = np.full((48, 64, 3), 255, np.uint8)
    mask[10:20, 30:40] = 0
    write_png(distorted / "m.png", mask)
    content = json.loads((distorted / "transforms.json").read_text())
    content["frames"][1]["mask_path"] = "m.png"
    (distorted / "transforms.json").write_text(json.dumps(content))
    text = convert_dataset(distorted, tmp_path / "out", (32, 24))
    assert "1 of 4 pictures have a mask: what it hides is not learnt or measured" in text
    plain = read_dataset(tmp_path / "out").pictures
    given = read_dataset(distorted, distortion="undistort", size_px=(32, 24)).pictures
    assert [picture.mask is not None for picture in plain] == [False, True, False, False]
    assert np.array_equal(plain[1].read_mask(), given[1].read_mask())
    assert not plain[1].read_mask()[6:9, 16:19].any()
    assert plain[1].read_mask()[:4].all()
