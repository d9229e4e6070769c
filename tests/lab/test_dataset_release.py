"""The archive of the street: equal bytes, and a loader that reads what was put in."""

import json
import runpy
import sys
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from lab.dataset_release import release
from rfcore.dataset import write_manifest
from rfcore.errors import DatasetError

WIDTH, HEIGHT = 4, 2
ROAD, VEHICLE = 1, 7


def write_split(transforms: Path, pictures: str, at_m: float, truth: str | None = None) -> None:
    """Write two frames, grey, the second a metre on; ``truth``: folder of depth and classes."""
    frames = []
    for number in range(2):
        pose = np.eye(4)
        pose[0, 3] = at_m + number
        name = f"{number:06d}.png"
        frames.append({"file_path": f"{pictures}/{name}", "transform_matrix": pose.tolist()})
        grey = np.full((HEIGHT, WIDTH, 3), 90 + number, np.uint8)
        maps = {pictures: grey}
        if truth is not None:
            maps[f"{truth}/depth"] = np.full((HEIGHT, WIDTH), 2500, np.uint16)
            maps[f"{truth}/classes"] = np.full((HEIGHT, WIDTH), (ROAD, VEHICLE)[number], np.uint8)
        for folder, pixels in maps.items():
            (transforms.parent / folder).mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(transforms.parent / folder / name), pixels)
    camera = {"w": WIDTH, "h": HEIGHT, "fl_x": 2.0, "fl_y": 2.0, "cx": 2.0, "cy": 1.0}
    transforms.write_text(json.dumps({**camera, "frames": frames}))


@pytest.fixture
def made(tmp_path: Path) -> tuple[Path, Path]:
    """A sample with its three splits, and a folder of sizes with truth and a larger drive."""
    samples, sizes = tmp_path / "samples", tmp_path / "size"
    street, fields = samples / "street", samples / "fields"
    for split in ("train", "drive_empty", "drive_vehicles"):
        street.mkdir(parents=True, exist_ok=True)
        write_split(street / f"transforms_{split}.json", split, 1.0)
    fields.mkdir()
    (fields / "street.rff").write_bytes(b"a field")
    for folder in (street, fields):
        write_manifest(folder)
    for size in ("640x360", "1280x720"):
        built = sizes / size / "empty"
        built.mkdir(parents=True)
        write_split(built / "transforms_drive.json", "drive/images", 1.0, "drive")
    (sizes / "1280x720.rff").write_bytes(b"a larger field")
    (sizes / "1280x720.json").write_text("{}")
    return samples, sizes


@pytest.fixture
def load(monkeypatch, capsys):
    """Return a function that runs the loader that is in an archive, and returns what it prints."""

    def run(archive: Path, *split: str) -> list[str]:
        loader = archive.with_name("load_street.py")
        with zipfile.ZipFile(archive) as opened:
            loader.write_bytes(opened.read("load_street.py"))
        monkeypatch.setattr(sys, "argv", [str(loader), str(archive), *split])
        runpy.run_path(str(loader), run_name="__main__")
        return capsys.readouterr().out.splitlines()

    return run


def test_equal_files_give_equal_bytes_and_the_loader_reads_them(made, load, tmp_path):
    archive, again = tmp_path / "street.zip", tmp_path / "again.zip"
    splits = release(*made, "abc", archive)
    release(*made, "abc", again)
    assert archive.read_bytes() == again.read_bytes()
    assert load(archive) == splits
    assert {"640x360/train", "640x360/drive_vehicles", "1280x720/drive_empty"} <= set(splits)
    for split in ("640x360/drive_empty", "1280x720/drive_empty"):
        first, second = load(archive, split)
        assert first == "0: 4x2 at 1.00 0.00 0.00 m, nearest 2.5 m, road"
        assert second == "1: 4x2 at 2.00 0.00 0.00 m, nearest 2.5 m, vehicle"
    with zipfile.ZipFile(archive) as opened:
        names = set(opened.namelist())
        readme = opened.read("README.md").decode()
    assert {"LICENSE", "fields/1280x720.rff", "640x360/fields/street.rff"} <= names
    assert not any(name.startswith("640x360/empty/drive/images") for name in names)
    assert all(f"`{split}`" in readme for split in splits)


def test_a_damaged_archive_is_refused_by_its_loader(made, load, tmp_path):
    archive = tmp_path / "street.zip"
    release(*made, "abc", archive)
    damaged = tmp_path / "damaged.zip"
    with zipfile.ZipFile(archive) as old, zipfile.ZipFile(damaged, "w") as new:
        for name in old.namelist():
            changed = b"another field" if name == "fields/1280x720.rff" else old.read(name)
            new.writestr(name, changed)
    with pytest.raises(ValueError, match=r"fields/1280x720\.rff is damaged"):
        load(damaged)


def test_truth_of_other_poses_is_refused(made, tmp_path):
    samples, sizes = made
    write_split(sizes / "640x360/empty/transforms_drive.json", "drive/images", 1.5, "drive")
    with pytest.raises(DatasetError, match="poses are not those of"):
        release(samples, sizes, "abc", tmp_path / "street.zip")


def test_a_damaged_sample_is_refused(made, tmp_path):
    samples, sizes = made
    (samples / "fields/street.rff").write_bytes(b"b field")
    with pytest.raises(DatasetError, match="damaged"):
        release(samples, sizes, "abc", tmp_path / "street.zip")
