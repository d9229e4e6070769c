"""A contact sheet shows what was built, fits its limit, and refuses what is no scene."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from rfcore.errors import DatasetError, InvalidInput
from streetgen.contact_sheet import contact_sheet, write_contact_sheet


@pytest.fixture
def built(tmp_path: Path) -> Path:
    """A scene of five pictures, each of its own grey."""
    images = tmp_path / "scene" / "drive" / "images"
    images.mkdir(parents=True)
    for i in range(5):
        cv2.imwrite(str(images / f"{i:06d}.png"), np.full((36, 64, 3), 50 * i, np.uint8))
    (tmp_path / "scene" / "build.json").write_text(json.dumps({"scene": {"name": "street-x"}}))
    return tmp_path / "scene"


def test_first_and_last_picture_are_on_the_sheet(built):
    sheet = contact_sheet([built, built], columns=2, width_px=140)
    assert sheet.shape == (2 * (22 + 36 + 4), 140, 3)
    assert (sheet[22:58, 4:68] == 0).all()
    assert (sheet[22:58, 72:136] == 200).all()
    assert (sheet[:22] < 128).any(), "the scene is named"


def test_fewer_pictures_than_columns_leave_room(built):
    sheet = contact_sheet([built], columns=8, width_px=600)
    assert (sheet[22:, -70:] == 250).all()


def test_the_sheet_fits_its_limit(built, tmp_path):
    out = tmp_path / "sheet.jpg"
    size = write_contact_sheet([built], out, columns=4, width_px=400, max_bytes=6000)
    assert size == out.stat().st_size <= 6000
    assert cv2.imread(str(out)).shape[1] == 400
    with pytest.raises(InvalidInput, match=r"max_bytes: 10 is too few"):
        write_contact_sheet([built], tmp_path / "no.jpg", 4, 400, max_bytes=10)
    assert not (tmp_path / "no.jpg").exists()


def test_what_is_no_scene_is_refused(built, tmp_path):
    with pytest.raises(DatasetError, match="no pictures in SPLIT/images"):
        contact_sheet([tmp_path], 4, 400)
    with pytest.raises(InvalidInput, match="columns: 90 of 400 px leave 0 px"):
        contact_sheet([built], 90, 400)
    (built / "drive" / "images" / "000000.png").write_bytes(b"no")
    with pytest.raises(DatasetError, match=r"000000.png: is not a picture"):
        contact_sheet([built], 4, 400)
    (built / "build.json").unlink()
    (built / "drive" / "images" / "000000.png").unlink()
    with pytest.raises(DatasetError, match=r"build.json: does not name a scene"):
        contact_sheet([built], 4, 400)
