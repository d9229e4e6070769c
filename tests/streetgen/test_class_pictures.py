"""Class pictures lie beside their pictures and are read as they were written."""

from pathlib import Path

import av
import numpy as np
import pytest

from rfcore.errors import DatasetError
from rfcore.image import write_png
from streetgen.classes import Label, class_picture_of, read_classes


def write_grey(path: Path, levels: np.ndarray) -> Path:
    """Write an 8-bit PNG of one channel."""
    encoder = av.CodecContext.create("png", "w")
    encoder.height, encoder.width = levels.shape
    encoder.pix_fmt, encoder.time_base = "gray", 1
    path.write_bytes(bytes(encoder.encode(av.VideoFrame.from_ndarray(levels, "gray"))[0]))
    return path


def test_every_label_is_read_as_it_was_written(tmp_path):
    levels = np.arange(16, dtype=np.uint8).reshape(2, 8) % len(Label)
    read = read_classes(write_grey(tmp_path / "0.png", levels))
    np.testing.assert_array_equal(read, levels)
    assert read.dtype == np.uint8


def test_the_numbers_of_the_labels_stay():
    """They are in the files of datasets that exist."""
    names = "SKY ROAD MARKING PAVEMENT BUILDING WINDOW VEGETATION VEHICLE SIGN POLE WIRE OBJECT"
    assert [label.name for label in Label] == [*names.split(), "PERSON", "BICYCLE"]
    assert [int(label) for label in Label] == list(range(14))


def test_a_class_picture_lies_beside_its_picture():
    found = class_picture_of(Path("out/drive/images/000012.png"))
    assert found == Path("out/drive/classes/000012.png")
    with pytest.raises(DatasetError, match=r"drive_empty.*streetgen build"):
        class_picture_of(Path("street/drive_empty/000.webp"))


def test_what_is_no_class_picture_is_refused_by_name(tmp_path):
    write_png(tmp_path / "rgb.png", np.array([[[1, 2, 3]] * 2] * 2, np.uint8))
    write_grey(tmp_path / "high.png", np.full((2, 2), 200, np.uint8))
    (tmp_path / "text.png").write_text("no picture")
    for name, said in (
        ("rgb", "has colours"),
        ("high", "level 200 is no label, at most 13"),
        ("text", "not a readable picture"),
        ("none", "cannot be read"),
    ):
        with pytest.raises(DatasetError, match=rf"{name}.png: {said}"):
            read_classes(tmp_path / f"{name}.png")
