"""The rival that sends only the foreground: exact outside it, and never better than the render."""

import numpy as np
import pytest

from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfedge.experiments.clips import Clip
from rfedge.experiments.compare.foreground import (
    ForegroundCoder,
    by_macroblock,
    foreground_mask,
    foreground_row,
)
from rfedge.experiments.performance import perform

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


class NoStore:
    def clip(self, _key, make):
        return make()

    def rows(self, _key, make):
        return make()


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


def test_against_itself_the_foreground_costs_the_same_and_the_ceiling_is_said():
    coder = ForegroundCoder.of("veryfast", MASKS, [RENDER] * 3, "test")
    clip = Clip("street", 10.0, FRAMES, "digest", None)
    clips = perform(clip, coder, NoStore()).clips
    row = foreground_row(clip, clips, clips, MASKS)
    assert row.bd_rate_percent == pytest.approx(0)
    assert row.whole_picture_ceiling_db == pytest.approx(
        10 * np.log10(255**2 / (36 * (~MASKS[0]).mean())), abs=0.2
    )


def test_a_drive_without_foreground_is_refused():
    coder = ForegroundCoder.of("veryfast", MASKS, [RENDER] * 3, "test")
    clip = Clip("street", 10.0, FRAMES, "digest", None)
    clips = perform(clip, coder, NoStore()).clips
    with pytest.raises(InvalidInput, match="no frame differs"):
        foreground_row(clip, clips, clips, [np.zeros_like(MASKS[0])] * 3)
