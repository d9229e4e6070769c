"""New pictures are placed in a field alone, whose own pictures are not at hand."""

import math
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from rfcore.dataset import read_dataset
from rfcore.errors import DatasetError, FieldFormatError, InvalidInput
from rfcore.field import load_field
from rfcore.image import write_png
from rfedge.arguments import is_field_file
from rfedge.cli.dataset import DatasetPoses
from rfedge.fields import register

SAMPLES = Path(__file__).parents[2] / "samples"
FIELD = SAMPLES / "fields" / "street.rff"
PINHOLE = (320.0, 320.0, 320.0, 180.0)


@pytest.fixture
def images(tmp_path: Path) -> Path:
    """Three pictures of the sample's drive without their poses, and a black one."""
    folder = tmp_path / "images"
    folder.mkdir()
    for i, picture in enumerate(drive()):
        write_png(folder / f"{i}.png", picture.read())
    write_png(folder / "3.png", np.zeros((360, 640, 3), np.uint8))
    return folder


def drive():
    return read_dataset(SAMPLES / "street/transforms_drive_empty.json").pictures[:12:4]


@pytest.mark.sample
def test_pictures_are_placed_in_a_field_told_by_its_content(images, tmp_path, capsys):
    field, out = tmp_path / "no-suffix", tmp_path / "out"
    field.write_bytes(FIELD.read_bytes())
    assert is_field_file(field)
    DatasetPoses(images, out, register_to=field, camera_model="PINHOLE", parameters=PINHOLE).run()
    placed = read_dataset(out).pictures
    assert [Path(p.name).name for p in placed] == ["0.png", "1.png", "2.png"]
    for found, truth in zip(placed, drive(), strict=True):
        between = truth.camera.world_from_cam.inverse().compose(found.camera.world_from_cam)
        assert math.hypot(*between.translation_m) < 0.1
    said = capsys.readouterr()
    assert "3 of 4 pictures placed in the field; not placed: 3.png" in said.out
    assert "placing pictures: 3 of 4, 2 found" in said.err


@pytest.mark.sample
def test_a_field_does_not_know_the_camera(images, tmp_path):
    with pytest.raises(InvalidInput, match="--camera-model PINHOLE"):
        DatasetPoses(images, tmp_path / "out", register_to=FIELD).run()
    assert not (tmp_path / "out").exists()


def test_what_is_neither_field_nor_dataset_is_refused(tmp_path):
    damaged = tmp_path / "damaged.rff"
    damaged.write_bytes(FIELD.read_bytes()[:100])
    settings = {"camera_model": "PINHOLE", "parameters": PINHOLE}
    (tmp_path / "images").mkdir()
    with pytest.raises(FieldFormatError):
        DatasetPoses(tmp_path / "images", tmp_path / "o", register_to=damaged, **settings).run()
    text = tmp_path / "text.json"
    text.write_text("{}")
    with pytest.raises(DatasetError):
        DatasetPoses(tmp_path / "images", tmp_path / "o", register_to=text).run()
    with pytest.raises(InvalidInput, match="is no field"):
        DatasetPoses(tmp_path / "images", tmp_path / "o", register_to=Path("nosuchfield")).run()


@pytest.mark.sample
def test_what_is_found_nowhere_asks_which_axis_is_up(tmp_path, monkeypatch):
    monkeypatch.setattr(register, "GRID_STEPS", (0.0,))
    noise = np.random.default_rng(1).integers(0, 256, (360, 640, 3), np.uint8)
    (tmp_path / "images").mkdir()
    write_png(tmp_path / "images" / "0.png", noise)
    settings, said = register.RegisterSettings("PINHOLE", tuple(PINHOLE), "y"), []
    with pytest.raises(DatasetError, match=r"where y is up.*--up z or y or -y"):
        register.register_pictures(
            tmp_path / "images", tmp_path / "out", load_field(FIELD), settings, said.append
        )
    assert said[-1] == "not found in the whole field, where y is up (--up)"
    assert not (tmp_path / "out").exists()


@pytest.mark.sample
def test_sigterm_ends_a_search_and_leaves_nothing(tmp_path):
    images = tmp_path / "images"
    images.mkdir()
    noise = np.random.default_rng(1).integers(0, 256, (360, 640, 3), np.uint8)
    write_png(images / "0.png", noise)
    command = ["dataset", "poses", str(images), "--out", str(tmp_path / "out")]
    command += ["--register-to", str(FIELD), "--camera-model", "PINHOLE", "--parameters"]
    command += [str(value) for value in PINHOLE]
    with subprocess.Popen(
        [sys.executable, "-m", "rfedge", *command], stderr=subprocess.PIPE, text=True
    ) as process:
        assert any("searching the whole field" in line for line in process.stderr)
        process.send_signal(signal.SIGTERM)
        said = process.stderr.read()
        assert process.wait(60) == 130
    assert "interrupted" in said
    assert "Traceback" not in said
    assert [path.name for path in tmp_path.iterdir()] == ["images"]
