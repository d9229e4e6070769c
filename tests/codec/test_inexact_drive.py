"""Renderers that differ by rounding: over a long drive the error stays where it began."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from rfcore.codec.decoder import DeltaDecoder
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.references import RENDER_ONLY
from rfcore.codec.sender.encoder import DeltaEncoder, FrameChoice
from rfcore.image import I420
from rfcore.views import FieldView

PairMaker = Callable[..., tuple[I420, FieldView]]
SIZE_PX = (96, 64)
FRAMES = 300
WITH_BLOCK_MEANS = FrameChoice(block_means=True)


def perturbed(view: FieldView, rng: np.random.Generator) -> FieldView:
    """Move every sample of the render by -1, 0 or +1 level."""
    y, u, v = (
        np.clip(p.astype(np.int16) + rng.integers(-1, 2, p.shape), 1, 255).astype(np.uint8)
        for p in view.render.planes
    )
    return replace(view, render=I420(y, u, v))


def mse_y(a: I420, b: I420) -> float:
    return float(np.mean((a.y.astype(float) - b.y) ** 2))


@pytest.mark.slow
def test_over_300_frames_the_error_does_not_grow_and_is_visible(pair: PairMaker) -> None:
    """+-1 level is noise of variance 2/3 on the reference. It reaches the picture unchanged where
    the slice copies, and deblocking or interpolation only average it: so every single frame stays
    within 2/3 and a margin of 1/2 of the sender's, the last ones like the first ones."""
    encoder = DeltaEncoder(CodecConfig(*SIZE_PX, effort="fast", crf=30))
    decoder = DeltaDecoder(encoder.header, exact=False)
    sending, receiving = encoder.start(0), decoder.start(0)
    rng = np.random.default_rng(3)
    errors = []
    for index in range(FRAMES):
        frame, render = pair(*SIZE_PX, 0.5 * index)
        sent = encoder.encode(replace(sending, past=None), frame, render, choice=WITH_BLOCK_MEANS)
        assert sent.packet.references == RENDER_ONLY
        got = decoder.decode(receiving, sent.packet, perturbed(render, rng))
        assert not got.exact
        errors.append(mse_y(got.frame, sent.reconstruction))
        sending, receiving = sent.state, got.state
    assert max(errors) < 2 / 3 + 1 / 2
    assert np.mean(errors[-50:]) < np.mean(errors[:50]) + 0.1
