"""A dataset small enough to write by hand: two grey pictures of 8x6 px and three points."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rfcore.field.ply_table import write_vertices
from rfcore.image import write_png

Write = Callable[..., Path]


def transforms() -> dict[str, Any]:
    identity = [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]]
    moved = [[1.0, 0, 0, 2.0], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]]
    return {
        "fl_x": 10.0,
        "fl_y": 12.0,
        "cx": 4.0,
        "cy": 3.0,
        "w": 8,
        "h": 6,
        "camera_model": "OPENCV",
        "ply_file_path": "points.ply",
        "frames": [
            {"file_path": "a.png", "transform_matrix": identity, "time": 0.0},
            {"file_path": "b.png", "transform_matrix": moved, "time": 0.1},
        ],
    }


@pytest.fixture
def content() -> dict[str, Any]:
    """The JSON of the dataset, to be changed by a test and passed to ``write``."""
    return transforms()


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Write pictures, points and the given JSON; return the transforms file."""
    for name, level in (("a.png", 10), ("b.png", 20)):
        write_png(tmp_path / name, np.full((6, 8, 3), level, np.uint8))
    row = [(n, "<f4") for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")]
    points = np.array([(0, 0, 1, 1, 2, 3), (4, 5, 6, 7, 8, 9), (0.5, 0, -1, 255, 0, 0)], row)
    write_vertices(tmp_path / "points.ply", points)

    def write_json(content: dict[str, Any], name: str = "transforms.json") -> Path:
        (tmp_path / name).write_text(json.dumps(content))
        return tmp_path / name

    return write_json
