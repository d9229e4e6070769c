"""A user's codec is checked, named in every error, and coded anew once its module is edited."""

import sys

import numpy as np
import pytest

from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfedge.evaluate.clips import Clip
from rfedge.evaluate.own_coder import own_coder
from rfedge.evaluate.runner import clip_key

FRAMES = [I420(np.zeros((48, 64), np.uint8), *[np.zeros((24, 32), np.uint8)] * 2)] * 24
MODULE = """
import numpy as np
from rfedge.evaluate.clips import CodedClip

class Mine:
    name, points, version = "mine", (2.0, 8.0), "1"

    def code(self, frames, rate_hz, point):
        n = len(frames)
        {line}
        return CodedClip(point, np.full(n, 9), mse, np.ones(n), 1.0, receiver_cpu_ms=2.0)
"""
WHOLE = "mse = np.ones(n)"


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """Write the module with one line changed, and return the codec of it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)

    def made(line):
        (tmp_path / "mine_here.py").write_text(MODULE.format(line=line))
        sys.modules.pop("mine_here", None)
        return own_coder("mine_here:Mine")

    yield made
    sys.modules.pop("mine_here", None)


def test_what_a_whole_codec_returns_is_passed_on(mine):
    coded = mine(WHOLE).code(FRAMES, 10.0, 2.0)
    assert coded.frame_bytes.tolist() == [9] * 24
    assert (coded.cpu_ms, coded.receiver_cpu_ms) == (1.0, 2.0)


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("n = 3; mse = np.ones(n)", "returned 3 frames of 24"),
        ("n = 23; mse = np.ones(n)", "returned 23 frames of 24"),
        ("mse = np.full(n, np.nan)", "returned luma_mse with values that are not finite"),
        ("mse = np.full(n, -1)", "returned luma_mse with values that are .* below 0"),
        ("return None", "returned NoneType, not a CodedClip"),
        ("return CodedClip(point, *[np.ones(n)] * 3, 1.0)", "returned no receiver_cpu_ms"),
        ("mse = np.ones(n - 1)", r"raised InvalidInput: clip: shapes .*mine_here\.py:11\)"),
        ("raise KeyError('a\\nb')", r"raised KeyError: .*mine_here\.py:10\)"),
    ],
)
def test_a_fault_of_a_codec_is_one_line_that_names_it(mine, line, said):
    with pytest.raises(InvalidInput, match=rf"method: mine_here:Mine: code at point 2 {said}") as e:
        mine(line).code(FRAMES, 10.0, 2.0)
    assert "\n" not in str(e.value)


def test_a_module_with_a_fault_is_one_line_that_names_its_place(mine):
    with pytest.raises(InvalidInput, match=r"SyntaxError: .*mine_here\.py, line 10") as e:
        mine("mse = = 1")
    assert "\n" not in str(e.value)


def test_an_edited_module_is_another_coder_of_the_same_name(mine):
    clip = Clip("street", 10.0, FRAMES, "digest", None)
    first, same, edited = (clip_key(clip, mine(t), 2.0) for t in (WHOLE, WHOLE, f"{WHOLE} * 2"))
    assert first == same
    assert {k for k in first if first[k] != edited[k]} == {"version"}
