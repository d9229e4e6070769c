"""``rfedge eval robust``, from files to a result file, a figure and a section."""

import json
from pathlib import Path

import pytest
from rich.console import Console

from rfcore.errors import InvalidInput
from rfedge.experiments.robust.report import robust_section, write_robust_figure
from rfedge.experiments.robust.run import RobustJob, run_robust

SAMPLES = Path(__file__).parents[2] / "samples"


@pytest.mark.slow
@pytest.mark.sample
def test_a_quick_run_writes_rows_a_figure_and_a_section_and_goes_on(tmp_path):
    drive = SAMPLES / "street/transforms_drive_empty.json"
    job = RobustJob(
        SAMPLES / "fields/street.rff",
        f"empty@10={drive}",
        None,
        None,
        "ultrafast",
        33.0,
        8,
        tmp_path / "robust.json",
        tmp_path / "cells",
        quick=True,
    )
    result = run_robust(job, Console(quiet=True))
    assert json.loads(job.out.read_text()) == result
    at = {(r["method"], r["rtt_ms"], r["loss_percent"]): r["ssim"] for r in result["rows"]}
    assert at["last-sent", 20, 0] == pytest.approx(at["last-acked", 20, 0], abs=1e-3)
    for method in ("last-sent", "last-acked", "render-only", "x264-idr-on-nack"):
        assert at[method, 20, 0] > 0.7
    noise = [r for r in result["disturbances"] if r["condition"] == "pose noise"]
    assert noise[0]["more_percent"] == 0
    assert noise[-1]["more_percent"] > 5, "10 cm and 0.1 degrees cost bits"
    (refined,) = (r for r in result["disturbances"] if r["condition"] == "refined pose noise")
    assert refined["level"] == noise[-1]["level"]
    assert refined["more_percent"] < noise[-1]["more_percent"] / 2
    reasons = [r["reason"] for r in result["disturbances"] if "reason" in r]
    assert ["--lane" in reasons[0], "--dusk" in reasons[1]] == [True, True]
    assert len(write_robust_figure(result, tmp_path / "figures")) == 2
    assert "| render-only | 0 | 20 |" in robust_section(job.out, result)
    assert run_robust(job, Console(quiet=True))["rows"] == result["rows"]


@pytest.mark.parametrize(
    ("change", "named"), [({"out": Path("x")}, "out"), ({"frames": 1}, "frames")]
)
def test_a_job_that_cannot_be_done_is_refused_by_name(change, named):
    given = {
        "field": Path("a"),
        "drive": "a@1=b",
        "dusk": None,
        "lane": None,
        "preset": "medium",
        "quality_db": 33.0,
        "frames": 24,
        "out": Path("c.json"),
        "cells": Path("d"),
    }
    with pytest.raises(InvalidInput, match=named):
        RobustJob(**(given | change))
