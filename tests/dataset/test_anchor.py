"""The anchor of a dataset: stated in transforms.json, kept by conversion, in the tile's axes."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from rfcore.dataset import read_dataset
from rfcore.errors import DatasetError
from rfcore.geodesy import Anchor
from rfedge.datasets.convert import convert_dataset
from rfedge.samples import sample_path

ANCHOR = {"latitude_deg": 48.137, "longitude_deg": 11.575, "height_m": 519.0}


@pytest.fixture
def anchored(tmp_path: Path) -> Path:
    """The sample's drive with an anchor and its frames elsewhere."""
    drive = sample_path("street")
    source = read_file(drive)
    folder = tmp_path / "drive"
    shutil.copytree(source.parent, folder, ignore=shutil.ignore_patterns("*.rff"))
    file = folder / source.name
    content = json.loads(file.read_text())
    content["frames"] = content["frames"][:3]
    file.write_text(json.dumps({"anchor": ANCHOR, **content}))
    return file


def read_file(folder: Path) -> Path:
    return sorted(folder.rglob("transforms*drive*.json"))[0]


@pytest.mark.sample
def test_a_transforms_file_states_its_anchor_and_conversion_keeps_it(anchored, tmp_path):
    assert read_dataset(anchored).anchor == Anchor(48.137, 11.575, 519.0)
    convert_dataset(anchored, tmp_path / "out", (64, 36))
    assert read_dataset(tmp_path / "out").anchor == Anchor(48.137, 11.575, 519.0)


@pytest.mark.sample
def test_a_dataset_far_from_its_origin_has_the_anchor_relative_to_the_tile(anchored):
    content = json.loads(anchored.read_text())
    for frame in content["frames"]:
        frame["transform_matrix"][0][3] += 650_000.0
    anchored.write_text(json.dumps(content))
    dataset = read_dataset(anchored)
    assert dataset.tile_origin.east_m > 600_000
    assert dataset.anchor.point_m[0] == -dataset.tile_origin.east_m


@pytest.mark.sample
def test_an_anchor_that_is_none_is_refused_by_name(anchored):
    content = json.loads(anchored.read_text())
    content["anchor"] = {"latitude_deg": 200.0, "longitude_deg": 0.0}
    anchored.write_text(json.dumps(content))
    with pytest.raises(DatasetError, match=r"anchor\.latitude_deg: 200"):
        read_dataset(anchored)
