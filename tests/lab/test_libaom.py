"""libaom as a rival: every picture comes back, in order, one packet each."""

import numpy as np
import pytest

from lab.libaom import Good6, Realtime6
from rfcore.errors import CodecError
from rfcore.image import I420
from rfedge.evaluate.own_coder import own_coder

FRAMES = [
    I420(
        np.full((50, 71), 40 + 50 * number, np.uint8),
        *[np.full((25, 36), 128, np.uint8)] * 2,
    )
    for number in range(4)
]


@pytest.mark.parametrize("coder", [Good6(), Realtime6()])
def test_pictures_come_back_in_order_and_a_finer_point_takes_more_bytes(coder):
    fine, coarse = (coder.pictures(FRAMES, 10.0, point) for point in (10.0, 60.0))
    for made in (fine, coarse):
        assert len(made.frame_bytes) == len(made.decoded) == len(FRAMES)
        assert made.cpu_ms > 0
    for decoded, frame in zip(fine.decoded, FRAMES, strict=True):
        assert decoded.size_px == frame.size_px
        assert np.abs(decoded.y.astype(int) - frame.y).max() <= 3
    assert sum(fine.frame_bytes) >= sum(coarse.frame_bytes)


def test_it_is_a_codec_of_eval_compare():
    coder = own_coder("lab.libaom:Good6")
    clip = coder.code(FRAMES, 10.0, 40.0)
    assert clip.psnr_db() > 30
    assert coder.limits == (1.0, 63.0)
    assert "-lag-in-frames 0" in coder.version


def test_what_ffmpeg_says_is_the_error():
    with pytest.raises(CodecError, match=r"libaom-good-6: .*crf"):
        Good6().code(FRAMES, 10.0, 100.0)
