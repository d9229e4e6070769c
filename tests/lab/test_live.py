"""Live measurements: what is asked for is checked before anything starts."""

from pathlib import Path

import pytest

from lab.live import EvalLive
from lab.live.showing import percentiles
from rfcore.errors import InvalidInput


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"cameras": (0,)}, "not all within 1..64"),
        ({"hz": 0.0}, "hz: 0 is outside"),
        ({"source_seconds": float("nan")}, "source_seconds: nan"),
        ({"sources": ("v4l2",)}, "'v4l2' is none of rtsp, rtp"),
        ({"consumers": 51}, "51 is outside 0..50"),
        ({"out": Path("live.txt")}, "must end in .json"),
    ],
)
def test_what_cannot_be_measured_is_refused_before_anything_starts(change, problem):
    with pytest.raises(InvalidInput, match=problem):
        EvalLive(**change)


def test_percentiles_of_nothing_are_none():
    assert percentiles([]) == (None, None)
    assert percentiles([float(ms) for ms in range(101)]) == (50.0, 99.0)
