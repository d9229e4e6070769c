"""Points of a PLY file: colours of any kind or none; damaged ones name the file."""

import json

import cv2
import numpy as np
import pytest

from rfcore.dataset import read_dataset
from rfcore.dataset.source import read_points
from rfcore.errors import DatasetError

HEADER = (
    "ply\nformat binary_little_endian 1.0\nelement vertex {n}\n"
    "property float x\nproperty float y\nproperty float z\n"
    "property {colour} red\nproperty uchar green\nproperty uchar blue\nend_header\n"
)


@pytest.mark.parametrize(
    ("header", "rows", "named"),
    [
        (HEADER.format(n=2, colour="uchar"), bytes(15), "30 bytes"),
        (HEADER.format(n=2_000_000_000, colour="uchar"), bytes(15), "30000000000 bytes"),
        (HEADER.format(n=1, colour="int"), bytes(30), "must be uchar"),
        (HEADER.format(n=1, colour="uchar").replace(" z", " w"), bytes(15), "no vertex.* z"),
    ],
)
def test_damaged_points_are_refused(tmp_path, header, rows, named):
    file = tmp_path / "points.ply"
    file.write_bytes(header.encode() + rows)
    with pytest.raises(DatasetError, match=rf"points\.ply.*{named}"):
        read_points(file)


def test_points_that_are_not_finite_are_left_out(tmp_path):
    file = tmp_path / "points.ply"
    rows = b"\0\0\xc0\x7f" + bytes(11) + bytes(12) + b"\1\2\3"
    file.write_bytes(HEADER.format(n=2, colour="uchar").encode() + rows)
    points = read_points(file)
    assert points.rgb.tolist() == [[1, 2, 3]]
    assert points.note == f"{file}: 1 of 2 points are not finite and left out"


@pytest.mark.parametrize("points", [b"", b"ply\nformat ascii 1.0\n", b"# .PCD v0.7\n"])
def test_a_dataset_is_read_without_points_that_cannot_be(tmp_path, points):
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((6, 8, 3), np.uint8))
    (tmp_path / "points.ply").write_bytes(points)
    frames = [{"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}]
    k = {"fl_x": 8, "fl_y": 8, "cx": 4, "cy": 3, "w": 8, "h": 6, "ply_file_path": "points.ply"}
    (tmp_path / "transforms.json").write_text(json.dumps({**k, "frames": frames}))
    dataset = read_dataset(tmp_path)
    assert len(dataset.pictures) == 1
    assert dataset.points is None
    assert any("no points: points of" in change for change in dataset.changes)


@pytest.mark.parametrize(
    ("dtype", "colour", "shown"),
    [
        ("u1", (1, 2, 255), (1, 2, 255)),
        ("<u2", (0, 32768, 65535), (0, 128, 255)),
        ("<f4", (0.0, 0.5, 1.0), (0, 128, 255)),
        ("<f8", (0.0, 127.6, 255.0), (0, 128, 255)),
    ],
)
@pytest.mark.parametrize("prefix", ["", "diffuse_"])
def test_colours_of_any_kind_are_brought_to_bytes(tmp_path, dtype, colour, shown, prefix):
    names = [f"{prefix}{name}" for name in ("red", "green", "blue")]
    table = np.array(
        [(1, 2, 3, *colour)], [(n, "<f4") for n in "xyz"] + [(n, dtype) for n in names]
    )
    kinds = {"u1": "uchar", "<u2": "ushort", "<f4": "float", "<f8": "double"}
    lines = ["ply", "format binary_little_endian 1.0", "element vertex 1"]
    lines += [
        f"property {kinds[table.dtype[n].str.lstrip('|') if n in names else '<f4']} {n}"
        for n in table.dtype.names
    ]
    file = tmp_path / "points.ply"
    file.write_bytes("\n".join([*lines, "end_header\n"]).encode() + table.tobytes())
    points = read_points(file)
    assert points.rgb.tolist() == [list(shown)]
    assert bool(points.note) == (dtype != "u1")


def test_points_without_colours_are_grey_and_said(tmp_path):
    header = "ply\nformat ascii 1.0\nelement vertex 1\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n1 2 3\n"
    (tmp_path / "points.ply").write_text(header)
    points = read_points(tmp_path / "points.ply")
    assert points.rgb.tolist() == [[128, 128, 128]]
    assert "has no colours" in points.note
