"""The folder the INRIA code trains into: its starting points and its last iteration."""

import json

import numpy as np
import pytest

from rfcore.dataset import read_dataset
from rfcore.dataset.source import SourcePoints
from rfcore.dataset.write import write_points
from rfcore.errors import DatasetError


def test_the_points_training_started_from_come_along(golden, tmp_path):
    folder = golden.write("inria", tmp_path)
    write_points(
        folder / "input.ply", SourcePoints(np.array([[1.0, 2, 3]]), np.array([[4, 5, 6]], np.uint8))
    )
    points = read_dataset(folder).points
    np.testing.assert_array_equal(points.xyz_m, [[1, 2, 3]])


@pytest.mark.parametrize("content", [{}, [], [3], [{"img_name": ""}]])
def test_what_is_no_list_of_cameras_is_refused(content, tmp_path):
    (tmp_path / "cameras.json").write_text(json.dumps(content))
    with pytest.raises(DatasetError, match=r"cameras\.json"):
        read_dataset(tmp_path)
