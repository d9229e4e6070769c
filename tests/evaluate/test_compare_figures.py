"""Figures of a comparison show every codec asked for, and every marker whole."""

import numpy as np
import pytest

from rfedge.evaluate.compare.figures import (
    _bd_rates,
    _curves,
    _frontier,
    write_compare_figures,
)
from rfedge.evaluate.compare.rows import CompareRow, CurveRow
from rfedge.results import rows_of

OURS, MINE = "rfedge-default-0123456789ab", "my-codec-q"
DRIVE = {"scene": "empty", "hz": 10.0}


def compared(rival: str, setting: str, percent: float) -> dict[str, object]:
    """One of ``compare``'s rows, with the columns that figures do not draw at 1."""
    row = dict.fromkeys(CompareRow.__annotations__, 1.0)
    names = {"method": OURS, "rival": rival, "rival_setting": setting}
    ends = {"window_db": [32.0, 35.0], "ci95": [percent - 2, percent + 1]}
    times = {"both_ends_ms": [9.0] * 3, "rival_both_ends_ms": [9.0] * 3}
    return {**row, **DRIVE, **names, **ends, **times, "bd_rate_percent": percent,
            "saving_percent_at_db": {}}  # fmt: skip


def curve(family: str, setting: str, bytes_at_30_db: float) -> dict[str, object]:
    sizes = bytes_at_30_db * np.geomspace(1, 4, 5)
    row = dict.fromkeys(CurveRow.__annotations__, [1.0] * 5)
    shape = {"psnr_db": [30.0, 32.0, 34.0, 36.0, 38.0], "bytes_per_frame": sizes.tolist()}
    return {**row, **DRIVE, **shape, "family": family, "setting": setting, "both_ends_ms": 9.0}


def test_a_codec_of_ones_own_and_the_anchor_of_a_quick_run_are_drawn(tmp_path):
    curves = [
        curve("", OURS, 500.0),
        curve("x264-lowdelay", "x264-lowdelay-veryfast", 4000.0),
        curve("x264-our-tools-veryfast", "x264-our-tools-veryfast", 3000.0),
        curve(MINE, MINE, 900.0),
    ]
    rows = [compared("x264-our-tools-veryfast", "x264-our-tools-veryfast", -80.0),
            compared(MINE, MINE, -40.0)]  # fmt: skip
    write_compare_figures({"rows": rows, "curves": curves, "quick": True}, tmp_path)
    for name in ("rd_empty_10", "bd_rates"):
        drawn = (tmp_path / f"{name}.svg").read_text()
        assert MINE in drawn, name
        assert "x264-our-tools-veryfast" in drawn, name


def test_a_codec_has_one_colour_in_all_figures():
    settings = [MINE, "another-q", "x264-our-tools-medium"]
    anchor = curve("x264-lowdelay", "x264-lowdelay-veryfast", 4000.0)
    curves = [curve("", OURS, 500.0), anchor, *(curve(each, each, 900.0) for each in settings)]
    rows = [compared("best-comparable", MINE, -9.0), *(compared(s, s, -9.0) for s in settings)]
    figures = [
        *(draw(rows_of(CurveRow, curves))[0] for draw in (_curves, _frontier)),
        _bd_rates(rows_of(CompareRow, rows))[0],
    ]
    drawn = {
        name: [
            line.get_color()
            for figure in figures
            for line in figure.axes[0].lines
            if line.get_label() == name
        ]
        for name in settings[:2]
    }
    assert all(len(found) == 3 for found in drawn.values())
    assert len({colour for found in drawn.values() for colour in found}) == 2


@pytest.mark.parametrize("interval", [[-82.0, -79.0], None])
def test_the_marker_of_the_greatest_saving_is_whole(interval):
    """A quick run has no interval."""
    row = compared("x264-our-tools-medium", "x264-our-tools-medium", -80.0)
    figure, _ = _bd_rates([CompareRow(**{**row, "ci95": interval})])
    low, high = figure.axes[0].get_xlim()
    assert low < -84
    assert high > 3
