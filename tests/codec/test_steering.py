"""A mask from a file and a budget of time, as a command line gives them."""

from pathlib import Path

import numpy as np
import pytest

from rfcore.codec.sender.steering import Steering, SteeringSettings
from rfcore.errors import DatasetError, InvalidInput
from rfcore.image import write_png


@pytest.fixture
def mask(tmp_path: Path) -> Path:
    pixels = np.zeros((48, 64, 3), np.uint8)
    pixels[16:32, 32:64] = 255
    write_png(tmp_path / "mask.png", pixels)
    return tmp_path / "mask.png"


def test_what_is_white_is_coded_finer(mask: Path) -> None:
    steering = SteeringSettings(mask, mask_qp=-8).steering((64, 48))
    assert steering.qp_map is not None
    assert steering.qp_map.offsets.tolist() == [[0] * 4, [0, 0, -8, -8], [0] * 4]


def test_nothing_asked_is_nothing_done() -> None:
    assert SteeringSettings().steering((64, 48)) == Steering()


def test_a_mask_of_another_size_is_refused(mask: Path) -> None:
    with pytest.raises(InvalidInput, match="has 64x48 px, the camera 640x360 px"):
        SteeringSettings(mask).steering((640, 360))


def test_a_mask_that_is_no_picture_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mask.png").write_text("no picture")
    with pytest.raises(DatasetError, match="not a readable picture"):
        SteeringSettings(tmp_path / "mask.png").steering((64, 48))


def test_an_offset_out_of_range_is_refused(mask: Path) -> None:
    with pytest.raises(InvalidInput, match="-40 and 0 must be within"):
        SteeringSettings(mask, mask_qp=-40).steering((64, 48))
