"""The rival that sends only the foreground: exact outside it, and never better than the render."""

import numpy as np
import pytest

from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfedge.evaluate.clips import Clip
from rfedge.evaluate.compare.foreground import (
    ForegroundCoder,
    by_macroblock,
    composed,
    foreground_mask,
    foreground_row,
)
from rfedge.evaluate.performance import perform
from rfedge.jobs import CellStore

SIZE = (96, 64)
CHROMA = np.full((SIZE[1] // 2, SIZE[0] // 2), 128, np.uint8)
RNG = np.random.default_rng(8)
STREET = I420(RNG.integers(60, 160, SIZE[::-1]).astype(np.uint8), CHROMA, CHROMA)
RENDER = I420(np.clip(STREET.y + np.int16(6), 1, 255).astype(np.uint8), CHROMA, CHROMA)
BOX = (slice(16, 48), slice(32, 64))


def with_object(seed):
    luma = STREET.y.copy()
    coarse = np.random.default_rng(seed).uniform(180, 250, (8, 8))
    luma[BOX] = coarse.repeat(4, 0).repeat(4, 1).astype(np.uint8)
    return I420(luma, CHROMA, CHROMA)


FRAMES = [with_object(seed) for seed in range(3)]
MASKS = [foreground_mask(frame, STREET) for frame in FRAMES]


def test_the_mask_is_the_object():
    expected = np.zeros(SIZE[::-1], bool)
    expected[BOX] = True
    np.testing.assert_array_equal(MASKS[0], expected)
    assert by_macroblock(MASKS[0]).sum() == 4


def test_a_background_of_another_size_is_refused():
    with pytest.raises(InvalidInput, match="background"):
        foreground_mask(FRAMES[0], I420(CHROMA, CHROMA[::2, ::2], CHROMA[::2, ::2]))


def test_no_rate_lifts_the_whole_picture_above_its_background():
    coder = ForegroundCoder.of("veryfast", MASKS, [RENDER] * 3, "test")
    best = coder.code(FRAMES, 10, 1.0)
    outside = 36.0 * (~MASKS[0]).mean()
    np.testing.assert_allclose(best.luma_mse, outside, rtol=0.02)
    assert max(best.notes["foreground_sse"]) < MASKS[0].sum()


def test_against_itself_the_foreground_costs_the_same_and_the_ceiling_is_said(tmp_path):
    coder = ForegroundCoder.of("veryfast", MASKS, [RENDER] * 3, "test")
    clip = Clip("street", 10.0, FRAMES, "digest", None)
    clips = perform(clip, coder, CellStore(tmp_path)).clips
    row = foreground_row(clip, clips, clips, MASKS)
    assert row.bd_rate_percent == pytest.approx(0)
    assert row.whole_picture_ceiling_db == pytest.approx(
        10 * np.log10(255**2 / (36 * (~MASKS[0]).mean())), abs=0.2
    )


def test_a_drive_without_foreground_is_refused(tmp_path):
    coder = ForegroundCoder.of("veryfast", MASKS, [RENDER] * 3, "test")
    clip = Clip("street", 10.0, FRAMES, "digest", None)
    clips = perform(clip, coder, CellStore(tmp_path)).clips
    with pytest.raises(InvalidInput, match="no frame differs"):
        foreground_row(clip, clips, clips, [np.zeros_like(MASKS[0])] * 3)


@pytest.mark.parametrize("shape", [(64, 96), (33, 17), (16, 16), (1, 1)])
def test_shares_of_macroblocks_count_every_pixel_once(shape):
    mask = np.random.default_rng(1).random(shape) < 0.4
    shares = by_macroblock(mask)
    assert shares.shape == (-(-shape[0] // 16), -(-shape[1] // 16))
    assert shares.sum() * 256 == mask.sum()


def test_a_picture_is_composed_of_one_in_the_blocks_and_the_other_elsewhere():
    block = np.zeros((4, 6), bool)
    block[1:3, 2:4] = True
    both = composed(FRAMES[0], RENDER, block)
    np.testing.assert_array_equal(both.y[BOX], FRAMES[0].y[BOX])
    outside = np.ones(SIZE[::-1], bool)
    outside[BOX] = False
    np.testing.assert_array_equal(both.y[outside], RENDER.y[outside])


@pytest.mark.parametrize("whole", [True, False])
def test_all_blocks_or_none_give_one_of_the_two_pictures(whole):
    made = composed(FRAMES[0], RENDER, np.full((4, 6), whole))
    assert made.digest() == (FRAMES[0] if whole else RENDER).digest()


def test_more_frames_than_masks_are_refused():
    coder = ForegroundCoder.of("veryfast", MASKS[:2], [RENDER] * 2, "test")
    with pytest.raises(InvalidInput, match="3 where there are 2 masks"):
        coder.code(FRAMES, 10, 30.0)


def test_a_mask_is_paid_for():
    """The bytes of a frame are those of its slices and of its mask."""
    coder = ForegroundCoder.of("veryfast", MASKS, [RENDER] * 3, "test")
    flat = I420(np.full_like(STREET.y, 128), CHROMA, CHROMA)
    alone = coder.rival.pictures(
        [composed(f, flat, by_macroblock(MASKS[0]) > 0) for f in FRAMES], 10, 30.0
    )
    assert (coder.code(FRAMES, 10, 30.0).frame_bytes > np.array(alone.frame_bytes)).all()


def test_another_stamp_or_option_is_another_version():
    versions = {
        ForegroundCoder.of(preset, MASKS, [RENDER] * 3, stamp).version
        for preset, stamp in (("veryfast", "a"), ("veryfast", "b"), ("medium", "a"))
    }
    assert len(versions) == 3


def test_an_idr_picture_comes_every_ten_frames():
    coder = ForegroundCoder.of("veryfast", MASKS * 4, [RENDER] * 12, "test")
    sizes = coder.code(FRAMES[:1] * 12, 10, 30.0).frame_bytes
    assert set(np.flatnonzero(sizes > 3 * np.median(sizes))) == {0, 10}
