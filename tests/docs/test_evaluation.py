"""The example of a user's codec in ``docs/evaluation.md`` is one."""

import re
from pathlib import Path

import numpy as np

from rfcore.image import I420

PAGE = (Path(__file__).parents[2] / "docs" / "evaluation.md").read_text(encoding="utf-8")


def test_the_example_codec_codes_a_clip_better_where_it_says_so():
    (example,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    assert len(example.splitlines()) <= 42
    names: dict[str, type] = {}
    exec(example, names)
    coder = names["MotionJpeg"]()
    rng = np.random.default_rng(1)
    chroma = np.full((24, 32), 128, np.uint8)
    clip = [I420(rng.integers(40, 200, (48, 64)).astype(np.uint8), chroma, chroma)] * 3
    best, worst = (coder.code(clip, 10, point) for point in (coder.points[0], coder.points[-1]))
    assert best.frame_bytes.shape == (3,)
    assert best.luma_mse.mean() < worst.luma_mse.mean()
    assert best.frame_bytes.sum() > worst.frame_bytes.sum()
