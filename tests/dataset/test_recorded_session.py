"""Recordings of a server: what is read, and how wrong ones are refused."""

import json
from pathlib import Path

import numpy as np
import pytest

from rfcore.camera import Intrinsics, Pose
from rfcore.dataset import read_dataset
from rfcore.dataset.recorded_session import (
    RecordedCamera,
    RecordedPicture,
    read_recorded_part,
)
from rfcore.errors import DatasetError
from rfcore.image import write_png

CAMERA = RecordedCamera("cav-1", "front", "s1", Intrinsics(8, 6, 10.0, 12.0, 4.0, 3.0))


def picture(number: int, time_ns: int) -> RecordedPicture:
    pose = Pose((float(number), 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    return RecordedPicture(f"{number:06}.png", time_ns, 0, number, "ab" * 32, pose, "cd" * 16)


def write_part(folder: Path, *pictures: RecordedPicture) -> Path:
    folder.mkdir(parents=True)
    for one in pictures:
        write_png(folder / one.file, np.full((6, 8, 3), one.sequence, np.uint8))
    file = folder / "recording.jsonl"
    file.write_text("".join([CAMERA.line(), *(one.line() for one in pictures)]))
    return file


def test_what_is_written_is_read(tmp_path):
    pictures = (picture(0, 10**18 + 1), picture(1, 10**18 + 10**8))
    part = read_recorded_part(write_part(tmp_path / "p", *pictures))
    assert (part.camera, part.pictures) == (CAMERA, pictures)


def test_a_folder_of_parts_is_one_dataset_in_order_of_time(tmp_path):
    write_part(tmp_path / "v/front/1-a", picture(0, 100), picture(1, 300))
    write_part(tmp_path / "v/front/2-b", picture(2, 200))
    dataset = read_dataset(tmp_path)
    assert [p.time_ns for p in dataset.pictures] == [100, 200, 300]
    assert [int(p.read()[0, 0, 0]) for p in dataset.pictures] == [0, 2, 1]
    assert len({p.name for p in dataset.pictures}) == 3


def test_a_line_that_is_being_written_is_left_out(tmp_path):
    file = write_part(tmp_path / "p", picture(0, 1))
    with file.open("a") as unfinished:
        unfinished.write('{"file": "0000')
    assert len(read_recorded_part(file).pictures) == 1


@pytest.mark.parametrize(
    ("key", "value", "problem"),
    [
        ("file", "../../etc/passwd", "leaves the dataset's folder"),
        ("file", "000009.png", "is missing"),
        ("capture_time_ns", -1, "line 2: key 'capture_time_ns' is -1"),
        ("rotation_wxyz", [1, 1, 0, 0], "rotation"),
        ("translation_m", [0, 1], "line 2: key 'translation_m'"),
    ],
)
def test_a_wrong_line_is_named(tmp_path, key, value, problem):
    file = write_part(tmp_path / "p", picture(0, 1))
    head, line = file.read_text().splitlines()
    file.write_text(f"{head}\n{json.dumps(json.loads(line) | {key: value})}\n")
    with pytest.raises(DatasetError, match=problem):
        read_dataset(file)


@pytest.mark.parametrize(
    ("head", "problem"),
    [
        ("", "no first line"),
        ("[1]\n", "not a table"),
        ("{\n", "line 1: not JSON"),
        (CAMERA.line().replace('"recording": 1', '"recording": 2'), "version 2"),
        (CAMERA.line().replace('"width_px": 8', '"width_px": 0'), "width_px"),
    ],
)
def test_a_wrong_head_is_named(tmp_path, head, problem):
    (tmp_path / "recording.jsonl").write_text(head)
    with pytest.raises(DatasetError, match=problem):
        read_dataset(tmp_path)


def test_a_picture_of_another_size_than_its_camera_is_refused(tmp_path):
    file = write_part(tmp_path / "p", picture(0, 1))
    write_png(tmp_path / "p/000000.png", np.zeros((6, 7, 3), np.uint8))
    with pytest.raises(DatasetError, match="7x6"):
        read_dataset(file)
