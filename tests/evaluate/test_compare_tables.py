"""What the field's own bytes leave of a saving, by algebra."""

import numpy as np
import pytest

from rfcore.image import I420
from rfedge.evaluate.clips import Clip, CodedClip
from rfedge.evaluate.compare.measure import break_even_row, curve_rows
from rfedge.evaluate.performance import Performance

PLANE = np.zeros((2, 2), np.uint8)
FRAME = I420(PLANE, PLANE[:1, :1], PLANE[:1, :1])
CLIP = Clip("street", 10.0, [FRAME] * 10, "digest", 27.5)


def performance(name, frame_bytes):
    """The same bytes for every frame at every quality, which leaves rounding out."""
    clips = []
    for point, db in enumerate((40.0, 38.0, 36.0, 34.0, 33.0, 32.0, 30.0)):
        sizes = np.full(10, frame_bytes, np.int64)
        mse = np.full(10, 255.0**2 / 10 ** (db / 10))
        clips.append(CodedClip(point, sizes, mse, np.ones(10), 1.0))
    return Performance(name, tuple(clips), 5.0)


OURS, RIVAL = performance("ours", 400), performance("x264", 1000)


def test_the_field_is_paid_for_by_whole_passes():
    row = break_even_row(CLIP, OURS, RIVAL, field_bytes=20_000)
    assert row.saved_bytes_per_pass == pytest.approx(6000)
    assert row.passes_to_break_even == 4
    after = row.saving_percent_after
    assert after["1"] == pytest.approx(100 * (1 - (4_000 + 20_000) / 10_000))
    assert after["100"] == pytest.approx(100 * (1 - (400_000 + 20_000) / 1_000_000))


def test_a_method_that_saves_nothing_never_pays_for_its_field():
    row = break_even_row(CLIP, RIVAL, OURS, field_bytes=20_000)
    assert row.passes_to_break_even is None


def test_curves_run_from_the_lowest_quality_to_the_highest_with_their_points():
    ours, rival = curve_rows(CLIP, [OURS], {"x264-lowdelay": [RIVAL]})
    assert (ours.family, rival.family) == ("", "x264-lowdelay")
    assert ours.point == [6, 5, 4, 3, 2, 1, 0]
    assert ours.psnr_db == sorted(ours.psnr_db)
