"""The I_PCM picture decodes to exactly the picture it was made from."""

import numpy as np
import pytest

from codec.pictures import noise
from rfcore.codec.h264.bitstream import (
    NAL_IDR,
    NAL_P,
    join_nals,
    parse_slice_start,
    rbsp_of_nal,
    split_nals,
)
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.h264.ffmpeg import H264Decoder
from rfcore.codec.h264.splice import PcmPictures, PcmPlace, pcm_pps, without_zeros
from rfcore.codec.sender.encoder import DeltaEncoder
from rfcore.errors import CodecError, InvalidInput
from rfcore.image import I420


def pcm_picture(picture: I420, place: PcmPlace) -> bytes:
    """Return the NAL unit of one picture."""
    (nal,) = split_nals(bytes(PcmPictures(picture.size_px).access_unit(picture, place)))
    return nal


@pytest.mark.parametrize("size_px", [(2, 2), (16, 16), (18, 34), (300, 168)])
def test_any_samples_above_zero_come_back_bit_for_bit(size_px):
    header = DeltaEncoder(CodecConfig(*size_px)).header
    decoder = H264Decoder(size_px)
    sets = [header.sps, header.pps, pcm_pps()]
    for index in range(3):
        source = noise(*size_px, index)
        nal = pcm_picture(source, PcmPlace(idr_pic_id=index % 2))
        decoded = decoder.decode(join_nals([*(sets if index == 0 else []), nal]))
        assert decoded.digest() == without_zeros(source).digest()


def test_the_picture_is_one_idr_slice_without_emulation_bytes():
    nal = pcm_picture(noise(40, 24, 0), PcmPlace(idr_pic_id=1))
    assert nal[0] & 0x1F == NAL_IDR
    assert len(rbsp_of_nal(nal)) == len(nal) - 1
    start = parse_slice_start(nal)
    assert (start.first_mb, start.slice_type, start.pps_id, start.frame_num) == (0, 2, 1, 0)


def test_later_pictures_are_not_idr_and_come_back_bit_for_bit():
    header = DeltaEncoder(CodecConfig(50, 34)).header
    decoder = H264Decoder((50, 34))
    decoder.decode(
        join_nals([header.sps, header.pps, pcm_pps(), pcm_picture(noise(50, 34, 0), PcmPlace())])
    )
    for frame_num in (1, 2):
        nal = pcm_picture(noise(50, 34, frame_num), PcmPlace(frame_num))
        assert nal[0] & 0x1F == NAL_P
        assert parse_slice_start(nal).frame_num == frame_num
        shown = decoder.decode(join_nals([nal]))
        assert shown.digest() == without_zeros(noise(50, 34, frame_num)).digest()


def test_macroblocks_hold_y_cb_cr_row_by_row_and_the_edge_again():
    source = noise(35, 19, 5)
    padded = [
        np.pad(np.maximum(plane, 1), ((0, h - plane.shape[0]), (0, w - plane.shape[1])), "edge")
        for plane, (h, w) in zip(source.planes, ((32, 48), (16, 24), (16, 24)), strict=True)
    ]
    rows = []
    for row, column in np.ndindex(2, 3):
        blocks = [
            plane[row * side : (row + 1) * side, column * side : (column + 1) * side]
            for plane, side in zip(padded, (16, 8, 8), strict=True)
        ]
        rows.append(b"\x0d\x00" + b"".join(block.tobytes() for block in blocks))
    assert pcm_picture(source, PcmPlace()).endswith(b"".join(rows)[2:] + b"\x80")


def test_the_next_picture_takes_the_place_of_the_one_before():
    pictures = PcmPictures((32, 32))
    sets = join_nals([pcm_pps()])
    first = pictures.access_unit(noise(32, 32, 0), PcmPlace(), sets)
    assert bytes(first[: len(sets)]) == sets
    second = pictures.access_unit(noise(32, 32, 1), PcmPlace())
    assert np.shares_memory(np.asarray(first), np.asarray(second))
    assert bytes(second) == join_nals([pcm_picture(noise(32, 32, 1), PcmPlace())])


def test_a_picture_of_another_size_is_refused():
    with pytest.raises(InvalidInput, match="out"):
        PcmPictures((32, 32)).access_unit(noise(32, 16, 0), PcmPlace())


def test_clamping_changes_zeros_only():
    source = noise(64, 64, 4)
    for before, after in zip(source.planes, without_zeros(source).planes, strict=True):
        assert np.array_equal(before[before > 0], after[before > 0])
        assert (after[before == 0] == 1).all()


def test_a_picture_larger_than_announced_is_refused_before_it_is_decoded():
    header = DeltaEncoder(CodecConfig(320, 256)).header
    decoder = H264Decoder((64, 64))
    unit = join_nals(
        [header.sps, header.pps, pcm_pps(), pcm_picture(noise(320, 256, 0), PcmPlace())]
    )
    with pytest.raises(CodecError, match="decoder"):
        decoder.decode(unit)


def test_after_a_reset_the_decoder_starts_over():
    header = DeltaEncoder(CodecConfig(32, 32)).header
    decoder = H264Decoder((32, 32))
    picture = pcm_picture(noise(32, 32, 0), PcmPlace())
    with pytest.raises(CodecError):
        decoder.decode(join_nals([picture]))
    decoder.reset()
    unit = join_nals([header.sps, header.pps, pcm_pps(), picture])
    assert decoder.decode(unit).digest() == without_zeros(noise(32, 32, 0)).digest()
