"""The rivals are real encoders: what they send is decoded, and nothing is held back."""

import numpy as np
import pytest

from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfedge.experiments.rivals import (
    svtav1_lowdelay,
    x264_for_psnr,
    x264_lowdelay,
    x265_for_psnr,
    x265_lowdelay,
)

RIVALS = [x264_lowdelay("veryfast"), x265_lowdelay("ultrafast"), svtav1_lowdelay(10)]


def panning_clip(frames=5, width_px=128, height_px=96):
    """A texture that moves two pixels a frame."""
    rng = np.random.default_rng(5)
    wide = rng.uniform(40, 210, (height_px // 4, width_px // 4 + 4))
    wide = wide.repeat(4, 0).repeat(4, 1).astype(np.uint8)
    chroma = np.full((height_px // 2, width_px // 2), 128, np.uint8)
    return [
        I420(wide[:height_px, 2 * k : 2 * k + width_px].copy(), chroma, chroma)
        for k in range(frames)
    ]


@pytest.mark.parametrize("rival", RIVALS, ids=lambda rival: rival.name)
def test_a_worse_point_takes_fewer_bytes_and_shows_it(rival):
    clip = panning_clip()
    best, worst = (rival.code(clip, 10, point) for point in (rival.points[0], rival.points[-1]))
    assert worst.frame_bytes.sum() < best.frame_bytes.sum()
    assert worst.luma_mse.mean() > best.luma_mse.mean()
    assert worst.ssim.mean() < best.ssim.mean()


@pytest.mark.parametrize("rival", RIVALS, ids=lambda rival: rival.name)
def test_later_frames_are_predicted_from_earlier_ones(rival):
    coded = rival.code(panning_clip(), 10, rival.points[0])
    assert coded.frame_bytes[1:].mean() < 0.5 * coded.frame_bytes[0]
    assert coded.cpu_ms > 0


@pytest.mark.parametrize("rival", RIVALS, ids=lambda rival: rival.name)
def test_a_static_picture_costs_next_to_nothing_after_the_first(rival):
    clip = panning_clip(frames=1) * 4
    coded = rival.code(clip, 10, 30.0)
    assert coded.frame_bytes[1:].max() < 0.1 * coded.frame_bytes[0]


def test_odd_sizes_are_refused():
    plane = np.zeros((5, 7), np.uint8)
    chroma = np.zeros((3, 4), np.uint8)
    with pytest.raises(InvalidInput, match="even size"):
        RIVALS[0].code([I420(plane, chroma, chroma)], 10, 23)


def test_keyframes_can_be_asked_of_x264():
    rival = x264_lowdelay("veryfast", "x264-keyint-2", keyint="2")
    sizes = rival.code(panning_clip(), 10, 23.0).frame_bytes
    assert sizes[2] > 3 * sizes[1]
    assert sizes[4] > 3 * sizes[3]


@pytest.mark.parametrize(
    ("plain", "tuned"),
    [
        (x264_lowdelay("veryfast"), x264_for_psnr("veryfast")),
        (x265_lowdelay("ultrafast"), x265_for_psnr("ultrafast")),
    ],
    ids=["x264", "x265"],
)
def test_tuning_for_psnr_changes_the_stream(plain, tuned):
    clip = panning_clip()
    coded = [rival.code(clip, 10, 30.0).frame_bytes.tolist() for rival in (plain, tuned)]
    assert coded[0] != coded[1]
