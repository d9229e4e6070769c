"""The I_PCM picture decodes to exactly the picture it was made from."""

from collections.abc import Callable

import numpy as np
import pytest

from rfcore.codec import CodecConfig, DeltaEncoder
from rfcore.codec.bitstream import join_nals, rbsp_of_nal
from rfcore.codec.h264 import H264Decoder
from rfcore.codec.parameter_sets import NAL_IDR, NAL_P, parse_pps, parse_slice_start
from rfcore.codec.reference import PCM_PPS_ID, PcmPlace, pcm_picture, pcm_pps, without_zeros
from rfcore.errors import CodecError
from rfcore.image import I420

PictureMaker = Callable[..., I420]


@pytest.mark.parametrize("size_px", [(2, 2), (16, 16), (18, 34), (300, 168)])
def test_any_samples_above_zero_come_back_bit_for_bit(
    size_px: tuple[int, int], noise: PictureMaker
) -> None:
    header = DeltaEncoder(CodecConfig(*size_px)).header
    decoder = H264Decoder(size_px)
    sets = [header.sps, header.pps, pcm_pps()]
    for index in range(3):
        source = noise(*size_px, index)
        nal = pcm_picture(source, PcmPlace(4, idr_pic_id=index % 2))
        decoded = decoder.decode(join_nals([*(sets if index == 0 else []), nal]))
        assert decoded.digest() == without_zeros(source).digest()


def test_the_picture_is_one_idr_slice_without_emulation_bytes(noise: PictureMaker) -> None:
    nal = pcm_picture(noise(40, 24, 0), PcmPlace(4, idr_pic_id=1))
    assert nal[0] & 0x1F == NAL_IDR
    assert len(rbsp_of_nal(nal)) == len(nal) - 1
    start = parse_slice_start(nal, log2_max_frame_num=4)
    assert (start.first_mb, start.slice_type, start.pps_id, start.frame_num) == (0, 2, 1, 0)


def test_later_pictures_are_not_idr_and_come_back_bit_for_bit(noise: PictureMaker) -> None:
    header = DeltaEncoder(CodecConfig(50, 34)).header
    decoder = H264Decoder((50, 34))
    decoder.decode(
        join_nals([header.sps, header.pps, pcm_pps(), pcm_picture(noise(50, 34, 0), PcmPlace(4))])
    )
    for frame_num in (1, 2):
        nal = pcm_picture(noise(50, 34, frame_num), PcmPlace(4, frame_num))
        assert nal[0] & 0x1F == NAL_P
        assert parse_slice_start(nal, log2_max_frame_num=4).frame_num == frame_num
        shown = decoder.decode(join_nals([nal]))
        assert shown.digest() == without_zeros(noise(50, 34, frame_num)).digest()


def test_each_macroblock_takes_its_samples_and_two_bytes(flat: PictureMaker) -> None:
    small, large = (len(pcm_picture(flat(16 * n, 16, 9), PcmPlace(4))) for n in (1, 5))
    assert large - small == 4 * 386


def test_its_parameter_set_is_cavlc_under_an_id_of_its_own() -> None:
    pps = parse_pps(pcm_pps())
    assert (pps.pps_id, pps.sps_id, pps.cabac, pps.deblocking_control) == (
        PCM_PPS_ID,
        0,
        False,
        True,
    )


def test_clamping_changes_zeros_only(noise: PictureMaker) -> None:
    source = noise(64, 64, 4)
    for before, after in zip(source.planes, without_zeros(source).planes, strict=True):
        assert np.array_equal(before[before > 0], after[before > 0])
        assert (after[before == 0] == 1).all()


def test_a_picture_larger_than_announced_is_refused_before_it_is_decoded(
    noise: PictureMaker,
) -> None:
    header = DeltaEncoder(CodecConfig(320, 256)).header
    decoder = H264Decoder((64, 64))
    unit = join_nals(
        [header.sps, header.pps, pcm_pps(), pcm_picture(noise(320, 256, 0), PcmPlace(4))]
    )
    with pytest.raises(CodecError, match="decoder"):
        decoder.decode(unit)


def test_after_a_reset_the_decoder_starts_over(noise: PictureMaker) -> None:
    header = DeltaEncoder(CodecConfig(32, 32)).header
    decoder = H264Decoder((32, 32))
    picture = pcm_picture(noise(32, 32, 0), PcmPlace(4))
    with pytest.raises(CodecError):
        decoder.decode(join_nals([picture]))
    decoder.reset()
    unit = join_nals([header.sps, header.pps, pcm_pps(), picture])
    assert decoder.decode(unit).digest() == without_zeros(noise(32, 32, 0)).digest()
