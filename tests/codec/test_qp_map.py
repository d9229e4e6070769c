"""Finer where a mask says so: the map's laws, and what x264 and the receiver make of it."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from codec.pictures import pair
from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.h264.qp_map import MaskSettings, QpMap, qp_map_of_mask
from rfcore.codec.references import RENDER_ONLY
from rfcore.codec.sender.encoder import DeltaEncoder, Encoded, FrameChoice
from rfcore.errors import DatasetError, InvalidInput
from rfcore.image import I420, write_png
from rfcore.views import FieldView

SIZE_PX = (320, 192)
MBS = (12, 20)


@given(
    arrays.arrays(
        np.int8,
        arrays.array_shapes(min_dims=2, max_dims=2, max_side=12),
        elements=st.sampled_from([0, 0, -6, 3]),
    )
)
def test_regions_cover_every_offset_once_and_nothing_else(offsets):
    painted = np.zeros(offsets.shape, int)
    for region in QpMap(offsets).regions():
        rows = slice(region.y_px // 16, (region.y_px + region.height_px) // 16)
        columns = slice(region.x_px // 16, (region.x_px + region.width_px) // 16)
        assert not painted[rows, columns].any()
        painted[rows, columns] = region.qp_offset
    assert np.array_equal(painted, offsets)


def test_a_rectangle_is_one_region():
    mask = np.zeros(MBS, bool)
    mask[3:9, 5:8] = True
    assert len(qp_map_of_mask(mask, SIZE_PX, -6).regions()) == 1


def test_a_mask_of_pixels_takes_macroblocks_it_covers_a_quarter_of():
    mask = np.zeros((192, 320), np.uint8)
    mask[0:8, 0:8] = 255
    mask[20:23, 40:44] = 255
    offsets = qp_map_of_mask(mask, SIZE_PX, -6).offsets
    assert np.argwhere(offsets).tolist() == [[0, 0]]


def test_macroblocks_that_the_edge_cuts_count_what_they_have():
    mask = np.zeros((17, 33), np.uint8)
    mask[16, 32] = 1
    offsets = qp_map_of_mask(mask, (33, 17), -6).offsets
    assert offsets.shape == (2, 3)
    assert np.argwhere(offsets).tolist() == [[1, 2]]


def code(encoder: DeltaEncoder, pair: tuple[I420, FieldView], choice: FrameChoice) -> Encoded:
    return encoder.encode(encoder.start(0), *pair, choice=choice)


def errors(made: Encoded, frame: I420) -> tuple[float, float]:
    """Return the mean squared luma errors of the left and the right half."""
    squares = (made.reconstruction.y.astype(float) - frame.y) ** 2
    half = squares.shape[1] // 2
    return float(squares[:, :half].mean()), float(squares[:, half:].mean())


def left_half(qp_offset: int, size_px: tuple[int, int] = SIZE_PX) -> QpMap:
    mask = np.zeros((size_px[1], size_px[0]), bool)
    mask[:, : size_px[0] // 2] = True
    return qp_map_of_mask(mask, size_px, qp_offset)


@pytest.mark.parametrize("effort", ["fast", "default", "thorough", "x264-veryfast"])
def test_bits_go_where_the_mask_is(effort):
    encoder = DeltaEncoder(CodecConfig(*SIZE_PX, effort=effort, crf=26))
    pictures = pair(*SIZE_PX)
    plain = code(encoder, pictures, FrameChoice(RENDER_ONLY, photometric=()))
    finer = code(encoder, pictures, FrameChoice(RENDER_ONLY, photometric=(), qp_map=left_half(-8)))
    before, after = errors(plain, pictures[0]), errors(finer, pictures[0])
    assert after[0] < 0.85 * before[0]
    assert after[1] == pytest.approx(before[1], rel=0.05)
    decoder = DeltaDecoder(encoder.header)
    shown = decoder.decode(decoder.start(0), finer.packet, pictures[1])
    assert shown.frame.digest() == finer.reconstruction.digest()


def test_a_map_of_nothing_changes_no_byte():
    encoder = DeltaEncoder(CodecConfig(*SIZE_PX, effort="fast"))
    pictures = pair(*SIZE_PX)
    plain = code(encoder, pictures, FrameChoice(RENDER_ONLY))
    nothing = QpMap(np.zeros(MBS, np.int8))
    assert code(encoder, pictures, FrameChoice(RENDER_ONLY, qp_map=nothing)).packet == plain.packet


@pytest.mark.parametrize("size_px", [(2, 2), (33, 17), (101, 67)])
@pytest.mark.parametrize("qp_offset", [-24, 24])
def test_odd_sizes_and_the_ends_of_the_range_decode(size_px, qp_offset):
    encoder = DeltaEncoder(CodecConfig(*size_px, effort="fast"))
    frame, render = pair(*size_px)
    mask = np.ones((size_px[1], size_px[0]))
    choice = FrameChoice(RENDER_ONLY, qp_map=qp_map_of_mask(mask, size_px, qp_offset))
    made = code(encoder, (frame, render), choice)
    decoder = DeltaDecoder(encoder.header)
    shown = decoder.decode(decoder.start(0), made.packet, render)
    assert shown.frame.digest() == made.reconstruction.digest()


def test_maps_that_cannot_be_are_refused():
    for mask, offset, named in (
        (np.zeros((3, 3)), -6, r"mask: shape \(3, 3\) is neither"),
        (np.full(MBS, np.nan), -6, "NaN"),
        (np.zeros(MBS), -25, "-25 and 0 must be within"),
    ):
        with pytest.raises(InvalidInput, match=named):
            qp_map_of_mask(mask, SIZE_PX, offset)
    with pytest.raises(InvalidInput, match="offset -30 is outside"):
        QpMap(np.full((2, 2), -30, np.int8))
    with pytest.raises(InvalidInput, match="must be int8"):
        QpMap(np.zeros((2, 2)))
    encoder = DeltaEncoder(CodecConfig(*SIZE_PX))
    choice = FrameChoice(qp_map=QpMap(np.zeros((2, 2), np.int8)))
    with pytest.raises(InvalidInput, match=r"qp_map: shape \(2, 2\) where the stream has"):
        code(encoder, pair(*SIZE_PX), choice)


@pytest.fixture
def mask(tmp_path: Path) -> Path:
    pixels = np.zeros((48, 64, 3), np.uint8)
    pixels[16:32, 32:64] = 255
    write_png(tmp_path / "mask.png", pixels)
    return tmp_path / "mask.png"


def test_what_is_white_in_a_masks_file_is_coded_finer(mask):
    qp_map = MaskSettings(mask, mask_qp=-8).qp_map((64, 48))
    assert qp_map.offsets.tolist() == [[0] * 4, [0, 0, -8, -8], [0] * 4]
    assert MaskSettings().qp_map((64, 48)) is None


def test_a_mask_that_does_not_fit_is_refused(mask, tmp_path):
    with pytest.raises(InvalidInput, match="has 64x48 px, the camera 640x360 px"):
        MaskSettings(mask).qp_map((640, 360))
    with pytest.raises(InvalidInput, match="-40 and 0 must be within"):
        MaskSettings(mask, mask_qp=-40).qp_map((64, 48))
    (tmp_path / "text.png").write_text("no picture")
    with pytest.raises(DatasetError, match="not a readable picture"):
        MaskSettings(tmp_path / "text.png").qp_map((64, 48))
