"""The cost of pose errors is measured against the same drive at its own poses."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from rich.console import Console

from lab.localisation import EvalLocalise, measure
from lab.localisation.false_starts import false_starts, row_of
from lab.localisation.given import GivenDrive
from lab.localisation.measure import WantedRow, rows_asked_for, run_localise
from rfcore.dataset import read_dataset
from rfcore.errors import InvalidInput
from rfcore.field import load_field
from rfcore.localise.localiser import Lost
from rfedge.localisation.searches import SearchOutcome, StartError

SAMPLES = Path(__file__).parents[2] / "samples"


@pytest.mark.sample
@pytest.mark.slow
def test_the_sample_gives_a_row_of_starts_and_a_row_of_bits(tmp_path):
    drive = SAMPLES / "street/transforms_drive_empty.json"
    field = SAMPLES / "fields/street.rff"
    EvalLocalise(
        drives=(f"sample={drive},{field}",),
        tries=1,
        false_starts=1,
        starts=("2m:3deg",),
        errors=("offset",),
        frames=4,
        out=tmp_path / "out.json",
        crfs=(25.0, 35.0),
        processes=2,
        cells=tmp_path / "cells",
    ).run()
    starts, bits = json.loads((tmp_path / "out.json").read_text())["rows"]
    assert starts["localised_percent"] == 100
    assert starts["false_percent"] == 0
    assert starts["track_cpu_ms"] > 0
    assert bits["tracked_percent"] == 100
    assert -5 < bits["bits_percent"] < 10


@pytest.mark.sample
def test_a_row_that_is_there_is_not_measured_again_and_any_other_setting_is_another_row(
    tmp_path, monkeypatch
):
    text = f"a={SAMPLES / 'street/transforms_drive_empty.json'},{SAMPLES / 'fields/street.rff'}"
    elsewhere = SAMPLES / "street/transforms_drive_vehicles.json"
    asked = EvalLocalise(
        drives=(text,),
        starts=("2m:3deg",),
        errors=("offset",),
        strangers=(elsewhere,),
        out=tmp_path / "localise.json",
        cells=tmp_path / "cells",
    )
    measured = []

    def rows(wanted: WantedRow) -> list[dict[str, object]]:
        measured.append(wanted)
        return [{"row": len(measured)}]

    monkeypatch.setattr(WantedRow, "rows", rows)
    monkeypatch.setattr(measure, "localise_parts", lambda _: ())

    def run(asked: EvalLocalise) -> list[int]:
        return [row["row"] for row in run_localise(asked, Console(quiet=True))["rows"]]

    assert run(asked) == [1, 2]
    assert run(asked) == [1, 2]
    assert run(replace(asked, tries=7)) == [3, 2]
    assert run(replace(asked, crfs=(20.0, 30.0))) == [1, 4]
    assert run(replace(asked, seed=2)) == [5, 6]
    assert run(replace(asked, strangers=())) == [7, 2]


@pytest.mark.sample
def test_pictures_of_other_places_of_any_size_are_every_second_false_start():
    field = load_field(SAMPLES / "fields/street.rff", threads=1)
    picture = read_dataset(SAMPLES / "street/transforms_drive_empty.json").pictures[0]
    reads = []

    def upside_down() -> NDArray[np.uint8]:
        reads.append(1)
        return np.ascontiguousarray(np.repeat(picture.read()[::-1], 2, axis=0))

    stranger = replace(picture, read=upside_down)
    rng = np.random.default_rng(1)
    done = false_starts(field, [picture], StartError(0.5, 1.0), range(1, 4), rng, [stranger])
    assert [isinstance(one.answer, Lost) for one in done] == [True] * 3
    assert len(reads) == 1


def test_a_row_counts_right_poses_of_tries_and_wrong_ones_of_all():
    def ended(error_m: float | None, right: bool = False) -> SearchOutcome:
        return SearchOutcome(None, None, None, error_m, error_m, right, 300.0, 250.0)

    tries = [ended(0.002, True), ended(0.004, True), ended(1.0), ended(None)]
    row = row_of("drive", StartError(2, 3), tries, [ended(None)] * 3 + [ended(0.001)])
    assert (row.tries, row.false_starts) == (4, 4)
    assert (row.localised_percent, row.false_percent) == (50.0, 25.0)
    assert (row.median_m, row.false_cpu_ms) == (0.004, 250.0)


def test_a_drive_may_ask_for_searches_from_one_start_error_alone():
    asked = EvalLocalise(drives=("a=d.json,f.rff",), starts=("2m:3deg", "4m:8deg"))
    (wanted,) = rows_asked_for(asked, [GivenDrive.parse("a=d.json,f.rff,rows=1m:2deg")])
    assert (wanted.start, wanted.sensor) == (StartError(1, 2), None)


def test_a_drive_without_a_field_is_refused():
    with pytest.raises(InvalidInput, match="NAME=DRIVE,FIELD"):
        EvalLocalise(drives=("sample=here",)).run()
