"""Sizes of I pictures: of each picture alone, at a stated rate, of built scenes only."""

import json
from pathlib import Path

import numpy as np
import pytest

from lab.intra_size import EvalIntraSize, intra_bytes, sizes_of, write_sizes
from rfcore.errors import DatasetError, InvalidInput
from rfcore.image import write_png


@pytest.fixture
def grain() -> np.ndarray:
    """A picture with detail everywhere."""
    return np.random.default_rng(3).integers(60, 120, (96, 160, 3)).astype(np.uint8)


@pytest.fixture
def built(tmp_path: Path, grain: np.ndarray) -> Path:
    """A scene of two pictures, one blank."""
    folder = tmp_path / "scene"
    (folder / "eval" / "images").mkdir(parents=True)
    for i, rgb in enumerate((grain, np.full_like(grain, 90))):
        write_png(folder / "eval" / "images" / f"{i:06d}.png", rgb)
    (folder / "build.json").write_text(json.dumps({"scene": {"name": "x"}, "samples": 4}))
    return folder


def test_detail_takes_bytes_and_so_does_being_shown_for_longer(grain):
    size = intra_bytes(grain, 23.0, 10)
    assert size > 50 * intra_bytes(np.full_like(grain, 90), 23.0, 10)
    assert intra_bytes(grain, 23.0, 1) > size
    assert intra_bytes(grain, 33.0, 10) < size


def test_a_picture_is_measured_alone(built, grain):
    (sizes,) = sizes_of(EvalIntraSize((built,)))
    assert sizes.size_px == (160, 96)
    assert sizes.picture_bytes[0] == intra_bytes(grain, 23.0, 10)
    assert "x: 2 I pictures of 160x96 px at 4 samples a pixel" in sizes.line()


def test_figures_say_how_they_were_taken(built, tmp_path):
    job = EvalIntraSize((built,), crf=26.0)
    write_sizes(tmp_path / "new" / "sizes.json", list(sizes_of(job)), job)
    result = json.loads((tmp_path / "new" / "sizes.json").read_text())
    assert result["coding"] == {"preset": "medium", "crf": 26.0, "rate_hz": 10}
    row = result["rows"][0]
    assert row["mean_bytes"] == round(sum(row["picture_bytes"]) / 2)
    assert {"command", "revision", "host"} <= result.keys()


def test_what_cannot_be_measured_is_refused(built, tmp_path):
    with pytest.raises(DatasetError, match=r"build\.json: does not say"):
        list(sizes_of(EvalIntraSize((tmp_path,))))
    write_png(built / "eval" / "images" / "000002.png", np.zeros((8, 8, 3), np.uint8))
    with pytest.raises(DatasetError, match="pictures of 2 sizes"):
        list(sizes_of(EvalIntraSize((built,))))
    for wrong in ({"crf": 60.0}, {"rate_hz": 0}):
        with pytest.raises(InvalidInput, match="outside"):
            EvalIntraSize((built,), **wrong)
