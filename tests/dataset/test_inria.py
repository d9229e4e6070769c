"""The folder the INRIA code trains into: its starting points and its last iteration."""

import json

import numpy as np
import pytest

from rfcore.dataset import read_dataset
from rfcore.dataset.read import trained_ply
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


def test_the_last_iteration_is_found(tmp_path):
    for iteration in ("7000", "30000", "x"):
        folder = tmp_path / "point_cloud" / f"iteration_{iteration}"
        folder.mkdir(parents=True)
        (folder / "point_cloud.ply").write_bytes(b"")
    assert trained_ply(tmp_path).parent.name == "iteration_30000"
    with pytest.raises(DatasetError, match="no point_cloud/iteration_N"):
        trained_ply(tmp_path / "point_cloud")


@pytest.mark.parametrize("content", [{}, [], [3], [{"img_name": ""}]])
def test_what_is_no_list_of_cameras_is_refused(content, tmp_path):
    (tmp_path / "cameras.json").write_text(json.dumps(content))
    with pytest.raises(DatasetError, match=r"cameras\.json"):
        read_dataset(tmp_path)
