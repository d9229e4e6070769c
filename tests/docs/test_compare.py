"""The example of a user's codec that ``docs/how-to/compare.md`` names is one."""

import runpy
from pathlib import Path

import numpy as np
import pytest

from rfcore.image import I420

ROOT = Path(__file__).parents[2]
EXAMPLE = "examples/own_codec.py"


@pytest.mark.parametrize("size_px", [(64, 48), (63, 47)])
def test_the_example_codec_codes_a_clip_better_where_it_says_so(size_px):
    width_px, height_px = size_px
    assert EXAMPLE in (ROOT / "docs" / "how-to" / "compare.md").read_text(encoding="utf-8")
    coder = runpy.run_path(str(ROOT / EXAMPLE))["MotionJpeg"]()
    rng = np.random.default_rng(1)
    chroma = np.full((24, 32), 128, np.uint8)
    clip = [I420(rng.integers(40, 200, (height_px, width_px)).astype(np.uint8), chroma, chroma)] * 3
    best, worst = (coder.code(clip, 10, point) for point in (coder.points[0], coder.points[-1]))
    assert best.frame_bytes.shape == (3,)
    assert best.luma_mse.mean() < worst.luma_mse.mean()
    assert best.frame_bytes.sum() > worst.frame_bytes.sum()
    assert best.cpu_ms > 0
