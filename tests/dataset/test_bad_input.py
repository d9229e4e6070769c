"""A fault in a dataset is one line that names the file and the place, in every format.

A fault is written into a golden dataset. Most are found when the dataset is read; a picture that is
damaged behind its header is found when its pixels are.
"""

import json
import math
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rfcore.dataset import read_dataset
from rfcore.errors import DatasetError

Fault = Callable[[Path], None]

PICTURES = {
    "transforms": "images",
    "colmap_text": "images",
    "colmap_binary": "images",
    "kitti": "image_2",
    "inria": "images",
    "folder": "frames",
}


def picture(format_name: str) -> str:
    return f"{PICTURES[format_name]}/000001.png"


def edit_json(name: str, change: Callable[[Any], None]) -> Fault:
    def fault(folder: Path) -> None:
        content = json.loads((folder / name).read_text())
        change(content)
        (folder / name).write_text(json.dumps(content))

    return fault


def frame(key: str, value: object) -> Fault:
    return edit_json("transforms.json", lambda c: c["frames"][1].update({key: value}))


def top(key: str, value: object) -> Fault:
    return edit_json("transforms.json", lambda c: c.update({key: value}))


def cell(value: float) -> Fault:
    def change(content: Any) -> None:
        content["frames"][1]["transform_matrix"][0][0] = value

    return edit_json("transforms.json", change)


def inria(key: str, value: object) -> Fault:
    return edit_json("cameras.json", lambda c: c[1].update({key: value}))


def edit_word(name: str, line: int, word: int, value: str, separator: str = " ") -> Fault:
    """Replace one word of one line, both counted from 0."""

    def fault(folder: Path) -> None:
        lines = (folder / name).read_text().splitlines()
        words = lines[line].split(separator)
        words[word : word + 1] = [value] if value else []
        lines[line] = separator.join(words)
        (folder / name).write_text("\n".join(lines) + "\n")

    return fault


def edit_bytes(name: str, at: int, content: bytes) -> Fault:
    def fault(folder: Path) -> None:
        data = bytearray((folder / name).read_bytes())
        data[at : at + len(content)] = content
        (folder / name).write_bytes(data)

    return fault


def edit_text(name: str, old: str, new: str) -> Fault:
    def fault(folder: Path) -> None:
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1))

    return fault


def remove(name: str) -> Fault:
    return lambda folder: (folder / name).unlink()


def resize(name: str, width_px: int, height_px: int) -> Fault:
    """Give a PNG a header of another size."""
    size = b"IHDR" + struct.pack(">II5B", width_px, height_px, 8, 2, 0, 0, 0)
    return edit_bytes(name, 12, size + struct.pack(">I", zlib.crc32(size)))


def truncate(name: str) -> Fault:
    def fault(folder: Path) -> None:
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(content[: len(content) * 2 // 3])

    return fault


TEXT = "sparse/0/images.txt"
BINARY = "sparse/0/images.bin"
SECOND_IMAGE = 8 + 4 + 56 + 4 + 11 + 8 + 24
"""Offset of the second image: count, id, pose, camera, name, points."""
SECOND_NAME = SECOND_IMAGE + 4 + 56 + 4
NAN = struct.pack("<d", math.nan)

FAULTS: dict[str, list[tuple[str, Fault, str]]] = {
    "missing image": [
        (name, remove(picture(name)), r"images/000001(\.png)? is missing")
        for name in PICTURES
        if name not in ("kitti", "folder")
    ]
    + [
        ("kitti", remove(picture("kitti")), r"times\.txt: holds 3 times for 2 pictures"),
        ("video", remove("drive.mp4"), r"drive\.mp4: not a readable video"),
    ],
    "wrong matrix size": [
        ("transforms", frame("transform_matrix", [[1, 0, 0]] * 3), r"frames\[1\].*not 3x4 or 4x4"),
        ("colmap_text", edit_word(TEXT, 3, 9, ""), r"images\.txt: line 4: has 9 values"),
        ("kitti", edit_word("poses.txt", 1, 11, ""), r"poses\.txt: line 2: has 11 numbers"),
        ("kitti", edit_word("calib.txt", 2, 12, ""), r"calib\.txt: line 3 \(P2\): has 11"),
        ("inria", inria("rotation", [[1, 0], [0, 1]]), r"cameras\.json: \[1\].*'rotation'.*3x3"),
        ("folder", edit_word("trajectory.csv", 2, 7, "", ","), r"csv: line 3: has not as many"),
        ("video", edit_word("trajectory.txt", 2, 7, ""), r"txt: line 3: has 7 values"),
        (
            "video",
            edit_text("camera.toml", "], [", ", "),
            r"'body_from_cam' is \[\[.*not 3x4 or 4x4",
        ),
    ],
    "no rotation": [
        ("transforms", cell(3.0), r"frames\[1\].*transform_matrix: .*not a rotation"),
        ("colmap_text", edit_word(TEXT, 3, 1, "2.0"), r"images\.txt: line 4 .*quaternion.*norm"),
        (
            "colmap_binary",
            edit_bytes(BINARY, SECOND_IMAGE + 4, struct.pack("<d", 2.0)),
            r"images\.bin: image 1 .*quaternion.*norm",
        ),
        ("kitti", edit_word("poses.txt", 1, 0, "3.0"), r"poses\.txt: line 2: .*not a rotation"),
        ("inria", inria("rotation", [[2, 0, 0], [0, 1, 0], [0, 0, 1]]), r"\[1\].*not a rotation"),
        ("folder", edit_word("trajectory.csv", 2, 7, "2.0", ","), r"csv: line 3: quaternion"),
        ("video", edit_word("trajectory.txt", 2, 7, "2.0"), r"txt: line 3: quaternion"),
        ("video", edit_text("camera.toml", "[[0.0", "[[9.0"), r"body_from_cam: .*not a rotation"),
    ],
    "mixed sizes": [
        (name, resize(picture(name), 60, 48), r"000001\.png: picture is 60x48 px.*64x48")
        for name in PICTURES
    ]
    + [("video", edit_text("camera.toml", "width_px = 64", "width_px = 60"), r"video is 64x48")],
    "a picture of 30,000 px": [
        (name, resize(picture(name), 30_000, 30_000), r"000001\.png: picture is 30000x30000.*8192")
        for name in PICTURES
    ],
    "a camera of 30,000 px": [
        ("transforms", top("w", 30_000), r"frames\[0\].*width_px: 30000 px.*8192"),
        (
            "colmap_text",
            edit_word("sparse/0/cameras.txt", 1, 2, "30000"),
            r"cameras\.txt: line 2: .*30000 px",
        ),
        (
            "colmap_binary",
            edit_bytes("sparse/0/cameras.bin", 16, (30_000).to_bytes(8, "little")),
            r"cameras\.bin: camera 0: .*30000 px",
        ),
        ("inria", inria("width", 30_000), r"cameras\.json: \[1\].*30000 px"),
        ("folder", edit_text("camera.toml", "width_px = 64", "width_px = 30000"), r"30000 px"),
    ],
    "NaN pose": [
        ("transforms", cell(math.nan), r"frames\[1\].*transform_matrix\[0\]\[0\]' is nan"),
        ("colmap_text", edit_word(TEXT, 3, 5, "nan"), r"images\.txt: line 4: nan is not"),
        (
            "colmap_binary",
            edit_bytes(BINARY, SECOND_IMAGE + 36, NAN),
            r"images\.bin: image 1 .*nan",
        ),
        ("kitti", edit_word("poses.txt", 1, 3, "nan"), r"poses\.txt: line 2: nan is not"),
        ("inria", inria("position", [0, math.nan, 0]), r"\[1\].*position.*is nan"),
        ("inria", inria("position", [0, 1]), r"\[1\].*'position' is .*, not a list of 3"),
        ("folder", edit_word("trajectory.csv", 2, 1, "nan", ","), r"csv: line 3: nan is not"),
        ("video", edit_word("trajectory.txt", 2, 1, "nan"), r"txt: line 3: nan is not"),
    ],
    "unknown camera model": [
        (
            "transforms",
            top("camera_model", "THIN_PRISM"),
            r"frames\[0\].*camera model THIN_PRISM is none",
        ),
        (
            "colmap_text",
            edit_word("sparse/0/cameras.txt", 1, 1, "LENS"),
            r"cameras\.txt: line 2: camera model LENS is none of",
        ),
        (
            "colmap_binary",
            edit_bytes("sparse/0/cameras.bin", 12, (77).to_bytes(4, "little")),
            r"cameras\.bin: camera 0: camera model number 77 is none of",
        ),
        (
            "folder",
            edit_text("camera.toml", "[camera]", "[camera]\nmodel = 'X'"),
            r"camera model X is none of",
        ),
        ("kitti", edit_text("calib.txt", "P2:", "P9:"), r"calib\.txt: has no line 'P2:'"),
        ("kitti", edit_word("calib.txt", 2, 2, "0.5"), r"line 3 \(P2\): is not K \[I \| t\]"),
    ],
    "path that leaves the folder": [
        ("transforms", frame("file_path", "../a.png"), r"frames\[1\].*'\.\./a\.png' leaves"),
        ("colmap_text", edit_word(TEXT, 3, 9, "../a.png"), r"line 4 .*'\.\./a\.png' leaves"),
        (
            "colmap_binary",
            edit_bytes(BINARY, SECOND_NAME, b"../001.png\0"),
            r"'\.\./001\.png' leaves",
        ),
        ("inria", inria("img_name", "/etc/a"), r"\[1\].*'/etc/a' leaves"),
        ("folder", edit_text("camera.toml", "trajectory.csv", "../t.csv"), r"'\.\./t\.csv' leaves"),
        (
            "folder",
            edit_text("camera.toml", '"frames"', '"../x"'),
            r"\[pictures\].*'\.\./x' leaves",
        ),
        ("video", edit_text("camera.toml", "drive.mp4", "/tmp/x.mp4"), r"'/tmp/x\.mp4' leaves"),
    ],
    "truncated picture": [
        (name, truncate(picture(name)), r"000001\.png: not a readable picture") for name in PICTURES
    ]
    + [("video", truncate("drive.mp4"), r"drive\.mp4: (not a readable video|frame \d)")],
    "times out of order": [
        ("transforms", frame("time", 7.0), r"frames\[1\].*time 7 s comes after 100 s"),
        ("kitti", edit_word("times.txt", 1, 0, "7.0"), r"line 2: time 7 s comes after 100 s"),
        (
            "folder",
            edit_word("trajectory.csv", 2, 0, "7.0", ","),
            r"csv: line 3: time 7\.0* s does",
        ),
        ("video", edit_word("trajectory.txt", 2, 0, "7.0"), r"txt: line 3: time 7\.0* s does"),
    ],
    "a recording's own": [
        ("video", edit_text("camera.toml", "100.0", "99.95"), r"drive_000000: time .*outside"),
        ("video", edit_text("camera.toml", '.mp4"', ".mp4"), r"not TOML"),
        (
            "video",
            edit_text("camera.toml", "[pictures]", "[photos]"),
            r"section \[photos\] is none",
        ),
        ("video", edit_text("camera.toml", "[pic", "[points]\n[pic"), r"\[points\]: key 'file' is"),
        ("video", edit_text("camera.toml", "[camera]", "camera = 3\n[x]"), r"\[x\] is none of"),
        ("video", edit_text("camera.toml", "fx_px", "focal"), r"\[camera\]: key 'focal' is none"),
        ("video", edit_text("camera.toml", "fx_px", "k1 = 0.0\n#"), r"\[camera\]: key 'fx_px' is"),
        ("folder", edit_text("camera.toml", "rate_hz", "#"), r"\[pictures\]: .*either 'rate_hz'"),
        ("folder", edit_text("camera.toml", "= 10", "= 0"), r"\[pictures\]: key 'rate_hz' is 0"),
        ("folder", edit_text("camera.toml", '"frames"', '"."'), r"d: holds no pictures"),
        ("folder", edit_text("camera.toml", "rate_hz", "every = 1.5\nrate_hz"), r"'every' is 1\.5"),
        (
            "folder",
            edit_text("camera.toml", "time_offset_s", "outside = 'hold'\ntime_offset_s"),
            r"\[trajectory\]: key 'outside' is 'hold'",
        ),
    ],
}
CASES = [
    pytest.param(name, fault, named, id=f"{what}-{name}-{i}")
    for what, rows in FAULTS.items()
    for i, (name, fault, named) in enumerate(rows)
]


@pytest.mark.parametrize(("format_name", "fault", "named"), CASES)
def test_a_fault_is_named_in_one_line(golden, format_name, fault, named, tmp_path):
    folder = golden.write(format_name, tmp_path / "d")
    fault(folder)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(DatasetError, match=named) as caught:
        assert [found.read() for found in read_dataset(folder).pictures] == []
    message = str(caught.value)
    assert "\n" not in message
    assert str(folder) in message
    after = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert after == before, "nothing is written"


def test_a_picture_outside_the_trajectory_is_left_out_when_that_is_declared(golden, tmp_path):
    folder = golden.write("video", tmp_path / "d")
    edit_text("camera.toml", "100.0", "99.95\noutside = 'drop'")(folder)
    dataset = read_dataset(folder)
    assert [found.name for found in dataset.pictures] == ["drive_000001", "drive_000002"]
    assert dataset.sorted_out == 1


def test_a_transforms_file_beyond_the_budget_is_refused(tmp_path, monkeypatch):
    (tmp_path / "transforms.json").write_text('{"frames": []}')
    monkeypatch.setattr("rfcore.dataset.keys.MAX_TEXT_BYTES", 13)
    with pytest.raises(DatasetError, match=r"transforms\.json: more than 13 bytes; split it"):
        read_dataset(tmp_path)


@pytest.mark.parametrize("name", ["transforms.json", "camera.toml", "recording.jsonl"])
def test_a_pipe_is_refused_and_not_waited_for(tmp_path, name):
    os.mkfifo(tmp_path / name)
    with pytest.raises(DatasetError, match=f"{name}: is no file, but a pipe"):
        read_dataset(tmp_path / name)


@pytest.mark.parametrize("name", ["transforms.json", "camera.toml"])
def test_values_that_are_nested_too_deep_are_refused(tmp_path, name):
    (tmp_path / name).write_text("a = " * name.endswith("toml") + "[" * 3000 + "]" * 3000)
    with pytest.raises(DatasetError, match=f"{name}: not "):
        read_dataset(tmp_path)
