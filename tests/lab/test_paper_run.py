"""The verb ``rfedge-lab paper``: rows whose means are known, and a quick run on the sample."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from lab.paper import EvalPaper
from lab.paper.figures import write_paper_figures, write_views
from lab.paper.report import (
    PaperRow,
    means_of,
    paper_rows,
    paper_tables,
    savings_by_frame,
)
from lab.paper.run import named_path, run_paper, views_of
from rfcore.errors import InvalidInput
from rfedge.results import as_json


def row(frame, crf, savings, **other):
    values = {
        "field": "3dgs",
        "scene": "empty",
        "width": 300,
        "height": 168,
        "render": "downscaled",
        "preset": "medium",
        "i_bytes": 2000,
        "p_bytes": 1000,
        "second_type": "P",
        "header_bytes": 700,
        "i_psnr_db": 40.0,
        "psnr_db": 36.0,
        "ssim": 0.97,
        "camera_i_bytes": 2100,
        "camera_i_psnr_db": 37.0,
        "rf_psnr_db": 27.0,
        "rf_ssim": 0.8,
        "rf_flip": 0.2,
        "rf_residual_bands": (0.1, 0.2, 0.4, 0.8),
    }
    return PaperRow(**values | {"crf": crf, "frame": frame, "savings_percent": savings} | other)


def result_of(rows):
    return {"tables": [as_json(table) for table in paper_tables(rows)]}


ROWS = [row("a", 18, 40.0), row("a", 23, 50.0), row("b", 18, 60.0), row("b", 23, 70.0)]


def test_a_frames_savings_are_its_mean_over_settings_and_the_spread_is_over_frames():
    (mean,) = means_of(ROWS)
    assert (mean.frames, mean.savings_percent) == (2, 55.0)
    assert mean.settings_percent == (50.0, 60.0), "of CRF 18 and of 23"
    assert mean.sd_percent == pytest.approx(np.std([45.0, 65.0], ddof=1))
    assert mean.ci95_percent == pytest.approx(1.96 * mean.sd_percent / 2**0.5)


def test_a_clip_whose_second_picture_is_no_p_picture_is_counted():
    (mean,) = means_of([*ROWS[:3], row("b", 23, 70.0, second_type="I")])
    assert mean.second_not_p == 0.25


def intra_at(crf, db, size, **other):
    return row("a", crf, 60.0, camera_i_psnr_db=db, camera_i_bytes=size, **other)


def test_p_pictures_are_compared_with_i_pictures_of_their_quality():
    """Half way from 37 to 40 dB an I picture takes the geometric mean of 2000 and 4000 bytes."""
    points = [intra_at(18.0, 40.0, 4000), intra_at(28.0, 34.0, 1000)]
    coded = intra_at(23.0, 37.0, 2000, psnr_db=38.5, p_bytes=1000)
    (mean,) = means_of([*points, coded])
    assert mean.against_intra_percent == pytest.approx(100 * (1000 / 8e6**0.5 - 1))
    worse = replace(coded, preset="veryfast", p_bytes=4000)
    (both,) = means_of([*points, coded, *(replace(r, preset="veryfast") for r in points), worse])
    assert both.against_intra_percent == pytest.approx(100 * (2000 / 8e6**0.5 - 1))


@pytest.mark.parametrize("psnr_db", [33.9, 40.1, None])
def test_nothing_is_made_up_outside_the_i_pictures_qualities(psnr_db):
    points = [intra_at(18.0, 40.0, 4000), intra_at(28.0, 34.0, 1000)]
    (mean,) = means_of([*points, intra_at(23.0, 37.0, 2000, psnr_db=psnr_db)])
    assert mean.against_intra_percent is None


def test_tables_hold_what_the_rows_say_to_a_hundredth_of_a_decibel():
    share = 100 * 2000 / 3000
    settings = [(f, crf, size) for size in (300, 500) for f in "ab" for crf in (18.0, 23.0)]
    rows = [row(f, crf, share, width=size, psnr_db=36.0049) for f, crf, size in settings]
    rows += [row("a", 23.0, share, field="3dgs:grey", rf_flip=None, second_type="I", psnr_db=None)]
    tables = as_json(paper_tables(rows))
    assert [len(table["settings"]) for table in tables] == [2, 2, 1]
    read = paper_rows({"tables": tables})
    exact = [replace(each, psnr_db=each.psnr_db and round(each.psnr_db, 2)) for each in rows]
    assert sorted(map(repr, read)) == sorted(
        repr(replace(r, rf_residual_bands=[0.1, 0.2, 0.4, 0.8])) for r in exact
    )


def test_a_table_that_lacks_a_frame_is_refused():
    with pytest.raises(InvalidInput, match=r"\('medium', 23\) of 3dgs has other frames"):
        paper_tables(ROWS[:3])


def test_savings_by_frame_leave_out_what_was_rendered_natively():
    curves = savings_by_frame([*ROWS, row("a", 18, 0.0, render="native")], "3dgs", "empty")
    assert list(curves) == [(300, 168)]
    np.testing.assert_allclose(curves[(300, 168)], [45.0, 65.0])


def test_every_figure_has_its_numbers_beside_it(tmp_path):
    sized = [row("a", 18, 0.0, p_bytes=2000), row("b", 18, 0.0, p_bytes=500)]
    paths = write_paper_figures(result_of(sized), tmp_path, "paper")
    assert {path.name for path in paths} == {
        "fig4_savings_empty_3dgs.svg",
        "fig4_savings_empty_3dgs.csv",
        "residual_by_frequency.svg",
        "residual_by_frequency.csv",
        "savings_by_crf_preset.svg",
        "savings_by_crf_preset.csv",
    }
    assert (tmp_path / "fig4_savings_empty_3dgs.csv").read_text() == (
        "image,300x168\n0,50.00\n1,80.00\n"
    )
    assert "medium,18,65.00" in (tmp_path / "savings_by_crf_preset.csv").read_text()


@pytest.mark.parametrize("text", ["x.rff", "=x", "a="])
def test_a_field_without_a_name_is_refused(text):
    with pytest.raises(InvalidInput, match="NAME=PATH"):
        named_path(text)


@pytest.fixture(scope="module")
def paper(thumbnail, tmp_path_factory):
    folder = tmp_path_factory.mktemp("paper")
    drive = thumbnail.empty.partition("=")[2]
    job = EvalPaper(
        fields=(f"3dgs={thumbnail.field}",),
        drives=(f"wall={drive}",),
        sizes=("96x64", "48x32"),
        out=folder / "paper.json",
        cells=folder / "cells",
        quick=True,
    )
    return job, run_paper(job, Console(quiet=True))


def test_every_frame_is_coded_at_every_setting_with_both_controls_beside_the_smaller_size(paper):
    _, result = paper
    rows = paper_rows(result)
    full = [row for row in rows if row.field == "3dgs" and row.width == 96]
    small = [row for row in rows if row.field == "3dgs" and row.width == 48]
    # Two frames at three presets and three CRFs; at the small size rendered both ways.
    assert (len(full), len(small)) == (2 * 9, 2 * 9 * 2)
    controls = {row.field for row in rows} - {"3dgs"}
    assert controls == {"3dgs:behind", "3dgs:grey"}
    assert len(rows) == len(full) + len(small) + 2 * 2
    assert {row.width for row in rows if row.is_control} == {48}


def test_the_field_saves_more_than_what_knows_nothing(paper):
    _, result = paper
    means = means_of(paper_rows(result))
    means = {(mean.name, mean.size_px[0], mean.making): mean for mean in means}
    field = means["3dgs", 48, "native"].savings_percent
    assert field > means["3dgs:grey", 48, "native"].savings_percent
    assert field > means["3dgs:behind", 48, "native"].savings_percent


def test_the_published_figure_is_that_of_the_bytes_beside_it(paper):
    job, _ = paper
    rows = [row for cell in job.cells.iterdir() for row in json.loads(cell.read_text())["result"]]
    for row in rows:
        expected = 100 * row["i_bytes"] / (row["i_bytes"] + row["p_bytes"])
        assert row["savings_percent"] == pytest.approx(expected)
    assert rows


def test_a_run_stopped_after_a_cell_goes_on_from_it(paper):
    job, result = paper
    cells = sorted(job.cells.iterdir())
    times = [path.stat().st_mtime_ns for path in cells[1:]]
    cells[0].unlink()
    again = run_paper(job, Console(quiet=True))
    assert again["tables"] == result["tables"]
    assert [path.stat().st_mtime_ns for path in cells[1:]] == times
    assert cells[0].exists()


def test_several_processes_code_the_same(paper, tmp_path):
    job, result = paper
    elsewhere = replace(job, processes=2, cells=tmp_path / "cells", out=tmp_path / "b.json")
    assert run_paper(elsewhere, Console(quiet=True))["tables"] == result["tables"]


def test_the_first_frame_of_each_drive_is_shown_as_camera_and_field_see_it(paper):
    job, _ = paper
    views = dict(views_of(job))
    assert list(views) == ["wall: camera", "wall: 3dgs"]
    camera, render = views.values()
    assert camera.shape == render.shape == (64, 96, 3)
    assert np.abs(camera.astype(int) - render).mean() < 6, "the camera has noise of 3 levels"


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"fields": ()}, "at least one field"),
        ({"drives": ()}, "at least one field, one drive"),
        ({"sizes": ()}, "one size"),
        ({"every": 0}, "every"),
        ({"out": Path("x.csv")}, "out"),
    ],
)
def test_a_job_that_cannot_be_done_is_refused_by_name(change, named):
    with pytest.raises(InvalidInput, match=named):
        EvalPaper(**({"fields": ("a=b",), "drives": ("c=d",)} | change))


def test_views_stand_side_by_side(tmp_path):
    pixels = np.zeros((18, 32, 3), np.uint8)
    views = [(f"{scene}: {what}", pixels) for scene in "ab" for what in ("camera", "3dgs")]
    drawing, numbers = write_views(views, tmp_path)
    assert drawing.name == "fig2_views.svg"
    assert "a: camera,32,18" in numbers.read_text()
