"""Planned loads: laws of the plan, refused plans, and one small comparison."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from lab.city.flow import Costs
from lab.city.planned_load import (
    FIT_VEHICLES,
    LoadFigures,
    PlannedLoad,
    fitted_costs,
    planned_figures,
)
from lab.servers import EvalScale
from lab.servers.cases import ScaleRow
from lab.servers.scale import run_scale
from rfcore.errors import InvalidInput, RfedgeError
from rfedge.datasets.convert import convert_dataset
from rfedge.loadtest.run import TestBed
from rfedge.results import read_result, rows_of
from rfedge.samples import sample_path

COSTS = Costs(1, 3.0, 800.0, (0.9, 1.0, 1.1), 0.0, 0.004, 0.02, 100.0, unexplained_s=(0.03, 0.05))


def planned(folder: Path, **changes: Any) -> PlannedLoad:
    bed = TestBed(folder / "field.rff", folder / "drive", 2, folder, folder)
    job = PlannedLoad((12, 24), 3.0, 5.0, sample_path("links/steady.toml"), bed)
    return replace(job, **changes)


def test_cores_and_bytes_are_those_of_the_frames(tmp_path):
    twelve, more = (planned_figures(planned(tmp_path), COSTS, 0.01, n) for n in (12, 48))
    assert twelve.cores == pytest.approx(0.01 + 12 * 3 * 0.004)
    assert twelve.uplink_mbps == pytest.approx(12 * 3 * 800 * 8e-6)
    assert more.uplink_mbps == pytest.approx(4 * twelve.uplink_mbps)
    assert more.age_p99_ms >= twelve.age_p99_ms >= 1e3 * (0.02 + 0.004 + 8 * 880 / 4e6 + 0.045)


@pytest.mark.parametrize("vehicles", [(), (0,), (12, 1001), (FIT_VEHICLES[0],)])
def test_numbers_that_cannot_be_planned_are_refused(tmp_path, vehicles):
    with pytest.raises(InvalidInput, match="planned"):
        planned(tmp_path, vehicles=vehicles)


def test_a_load_without_a_cost_is_refused(tmp_path):
    few, more = (LoadFigures(n, 0.5, 1.0, 60.0, (60.0,)) for n in FIT_VEHICLES)
    with pytest.raises(InvalidInput, match="measure again"):
        fitted_costs(planned(tmp_path), few, more)


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.timeout(300)
def test_a_small_load_is_compared_with_its_plan(tmp_path):
    """Bytes do not depend on the machine; cores and ages do, so that only their rows are asked
    for."""
    fields = tmp_path / "fields"
    fields.mkdir()
    (fields / "street.rff").symlink_to(Path(sample_path("fields/street.rff")).resolve())
    drive = tmp_path / "small"
    pictures = sample_path("street/transforms_drive_vehicles.json")
    convert_dataset(pictures, drive, (160, 90), slice(None, 6))
    job = EvalScale(
        vehicles=2, servers=2, rounds=1, hz=1.0, size=None, pairs=0, seconds=3.0,
        field=fields / "street.rff", drive=drive, config=tmp_path, work=tmp_path / "work",
        out=tmp_path / "scale.json", planned=(12,), planned_hz=2.0, no_envoy=True,
        planned_warm_up_s=1.0, planned_runs=1,
    )  # fmt: skip
    try:
        run_scale(job, Console(quiet=True))
    except RfedgeError as error:
        if not str(error).startswith("not held: "):  # a bound in time, on a busy machine
            raise
    result = read_result(job.out)
    rows = {row.case: row for row in rows_of(ScaleRow, result["rows"])}
    assert [row["figure"] for row in result["planning"]] == ["cores", "uplink_mbps", "age_p99_ms"]
    assert all(row["measured"] > 0 for row in result["planning"])
    assert len(rows) == 3
    assert rows["planned 12 vehicles: uplink_mbps, % off"].held


def test_nothing_to_measure_is_refused(tmp_path):
    with pytest.raises(InvalidInput, match="nothing is to be measured"):
        run_scale(EvalScale(no_envoy=True, work=tmp_path / "work"), Console(quiet=True))
