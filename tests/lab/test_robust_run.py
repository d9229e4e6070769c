"""``rfedge-lab robust``, from files to a result file, a figure and a section."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from lab.robust import EvalRobust
from lab.robust.report import CrossingRow
from lab.robust.run import _at_equal_rate, _interval, run_robust
from rfcore.errors import InvalidInput
from rfedge.results import rows_of

QUALITY_DB = 40.0


@pytest.fixture(scope="module")
def robust(thumbnail, tmp_path_factory):
    """A quick run on the thumbnail, its own drive standing for those of another lane and light."""
    folder = tmp_path_factory.mktemp("robust")
    job = EvalRobust(
        field=thumbnail.field,
        drive=thumbnail.drive,
        dusk=thumbnail.drive.replace("wall@", "dusk@"),
        lane=thumbnail.drive.replace("wall@", "lane@"),
        effort="fast",
        preset="ultrafast",
        quality_db=QUALITY_DB,
        frames=5,
        out=folder / "robust.json",
        cells=folder / "cells",
        quick=True,
    )
    return job, run_robust(job, Console(quiet=True))


def test_several_processes_cross_the_same(robust):
    job, result = robust
    elsewhere = replace(job, processes=2, out=job.out.with_name("b.json"))
    for path in job.cells.iterdir():
        if '"verb": "robust"' in path.read_text():
            path.unlink()
    again = run_robust(elsewhere, Console(quiet=True))
    assert again["crossings"] == result["crossings"]
    assert again["rows"] == result["rows"]


def test_every_method_crosses_every_link_at_every_rate_factor(robust):
    _, result = robust
    crossed = [(r["method"], r["rtt_ms"], r["loss_percent"], r["crf"]) for r in result["crossings"]]
    assert len(set(crossed)) == len(crossed) == (2 * 3 + 5 * 2) * 2 * 2
    for row in result["crossings"]:
        assert row["frames"] == 4
        assert 0 <= row["not_new"] <= 4
        assert row["ssim_p5"] <= row["ssim"] <= 1


def test_without_loss_every_frame_of_ours_is_new(robust):
    _, result = robust
    lossless = [r for r in result["crossings"] if r["loss_percent"] == 0]
    assert [r["not_new"] for r in lossless] == [0] * len(lossless)


def test_a_finer_rate_factor_takes_more_and_shows_more(robust):
    _, result = robust
    for method in ("last-sent", "x264-intra-refresh"):
        rows = sorted(
            (
                r
                for r in result["crossings"]
                if (r["method"], r["rtt_ms"], r["loss_percent"]) == (method, 20, 0)
            ),
            key=lambda r: r["crf"],
        )
        rates = [r["kbps"] for r in rows]
        assert rates == sorted(rates, reverse=True)
        assert rows[0]["ssim"] > rows[-1]["ssim"]


def test_methods_are_compared_at_a_rate_that_all_of_them_reach(robust):
    _, result = robust
    for row in result["rows"]:
        rates = [
            r["kbps"]
            for r in result["crossings"]
            if all(r[key] == row[key] for key in ("method", "rtt_ms", "loss_percent"))
        ]
        assert min(rates) <= result["equal_rate_kbps"] <= max(rates)
    assert len(result["rows"]) == 5 * 2 * 2


def test_what_disturbs_is_compared_with_what_does_not(robust):
    _, result = robust
    rows = {(r["condition"], r["level"]): r for r in result["disturbances"]}
    noise = [r for r in result["disturbances"] if r["condition"] == "pose noise"]
    assert noise[0]["more_percent"] == 0
    assert noise[1]["more_percent"] > 5, "10 cm and 0.1 degrees of 4 m"
    lane = rows["lane offset", "lane"]
    assert lane["kbit"] == pytest.approx(noise[0]["kbit"]), "it is the same drive here"
    assert lane["against_x264_percent"] == pytest.approx(
        100 * (lane["kbit"] / lane["x264_kbit"] - 1)
    )
    assert {("light", "uncorrected"), ("light", "adapted")} <= rows.keys()


def test_a_run_that_is_finished_gives_the_same_rows_from_its_cells(robust):
    job, result = robust
    again = run_robust(job, Console(quiet=True))
    assert {key: again[key] for key in ("rows", "crossings", "disturbances")} == {
        key: result[key] for key in ("rows", "crossings", "disturbances")
    }
    assert json.loads(job.out.read_text())["crossings"] == result["crossings"]


def test_more_seeds_give_means_with_intervals_and_the_first_seed_is_the_one_of_before(robust):
    job, one = robust
    seeds = 16
    several = replace(job, seeds=seeds, out=job.out.with_name("seeds.json"))
    result = run_robust(several, Console(quiet=True))
    first = one["crossings"][0]["seed"]
    kept = [r for r in result["crossings"] if r["seed"] == first]
    assert kept == one["crossings"]
    assert not any("ssim_ci95" in row for row in result["rows"]), "it was quick"
    crossed = rows_of(CrossingRow, result["crossings"])
    rows = _at_equal_rate(crossed, intervals=True)["rows"]
    lossy = [row for row in rows if row.loss_percent]
    assert len(lossy) == 5 * 2
    for row in lossy:
        low, high = row.ssim_ci95
        assert row.seeds == seeds
        assert low <= row.ssim <= high
    assert any(row.ssim_ci95[0] < row.ssim_ci95[1] for row in lossy)
    lossless = [row for row in rows if not row.loss_percent]
    assert [(row.seeds, row.ssim_ci95) for row in lossless] == [(1, None)] * 5 * 2


def test_the_interval_of_a_mean_is_near_what_a_normal_distribution_has():
    values = np.random.default_rng(2).normal(0.9, 0.02, 400)
    low, high = _interval(values)
    assert (low + high) / 2 == pytest.approx(values.mean(), abs=2e-4)
    assert high - low == pytest.approx(2 * 1.96 * values.std() / np.sqrt(400), rel=0.1)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"out": Path("x")}, "out"),
        ({"frames": 1}, "frames"),
        ({"seeds": 0}, "seeds"),
        ({"processes": 0}, "processes"),
        ({"rtts_ms": ()}, "rtts_ms"),
        ({"rtts_ms": (20.0, -1.0)}, "rtts_ms"),
    ],
)
def test_a_job_that_cannot_be_done_is_refused_by_name(change, named):
    with pytest.raises(InvalidInput, match=named):
        EvalRobust(**change)
