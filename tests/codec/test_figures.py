"""The two savings figures: as published, and at equal quality."""

import math
from itertools import pairwise

import pytest

from codec.pictures import noise, pair
from rfcore.errors import InvalidInput
from rfcore.metrics import psnr
from rfedge.demo.measure import RatePoint, intra_curve, saving_at_equal_psnr
from rfedge.evaluate.savings import PaperSavings, paper_savings


def curve_of(*points: tuple[float, float]) -> list[RatePoint]:
    return [RatePoint(20.0 + i, b, q) for i, (b, q) in enumerate(points)]


CURVE = curve_of((8000, 44), (4000, 41), (2000, 38), (1000, 35))


def test_equal_sizes_read_fifty_percent():
    assert PaperSavings(i_bytes=700, p_bytes=700, second_type="P").percent == 50.0


@pytest.mark.parametrize("preset", ["veryfast", "medium", "veryslow"])
def test_a_good_render_saves_more_than_an_unrelated_one(preset):
    frame, view = pair(301, 169)
    good = paper_savings(frame, view.render, preset, 23)
    bad = paper_savings(frame, noise(301, 169, 3), preset, 23)
    assert good.second_type == "P"
    assert bad.second_type in ("I", "IDR", "P")
    assert good.p_bytes < 0.7 * bad.p_bytes
    assert good.percent > 50


def test_the_published_figure_needs_pictures_of_one_size():
    with pytest.raises(InvalidInput, match=r"camera: \(32, 32\) px where the render has"):
        paper_savings(pair(32, 32)[0], pair(64, 32)[1].render, "medium", 23)


def test_intra_curves_rise_in_bytes_and_quality():
    frames = [pair(161, 95, 4.0 * i)[0] for i in range(2)]
    curve = intra_curve(frames, "veryfast", [33, 18, 23, 28], lambda a, b: psnr(a.y, b.y))
    assert [point.crf for point in curve] == [18, 23, 28, 33]
    for better, worse in pairwise(curve):
        assert better.mean_bytes > worse.mean_bytes
        assert better.mean_psnr_db > worse.mean_psnr_db
    middle = curve[1]
    saving = saving_at_equal_psnr(curve, middle.mean_bytes / 4, middle.mean_psnr_db)
    assert saving == pytest.approx(75.0)


def test_between_points_bytes_are_interpolated_in_the_logarithm():
    intra_bytes = math.sqrt(4000 * 2000)
    assert saving_at_equal_psnr(CURVE, intra_bytes / 2, 39.5) == pytest.approx(50.0)
    assert saving_at_equal_psnr(CURVE, 4 * intra_bytes, 39.5) == pytest.approx(-300.0)


@pytest.mark.parametrize(
    ("curve", "psnr_db", "problem"),
    [
        (CURVE, 44.1, "44.10 dB at 100 bytes is outside the curve's 35.00..44.00 dB"),
        (CURVE, math.inf, "outside the curve"),
        (CURVE, math.nan, "outside the curve"),
        (CURVE[:3], 39.0, "3 points where 4 are needed"),
        (curve_of((8000, 44), (4000, 41), (4500, 38), (1000, 35)), 39.0, "bytes must rise"),
        (curve_of((9, math.inf), (8, 41), (7, 38), (6, 35)), 39.0, "must be finite"),
    ],
)
def test_a_saving_that_the_curve_cannot_tell_is_refused(curve, psnr_db, problem):
    with pytest.raises(InvalidInput, match=problem):
        saving_at_equal_psnr(curve, 100, psnr_db)
