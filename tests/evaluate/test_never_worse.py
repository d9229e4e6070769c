"""The never-worse table: its controls are what they say, and a useless field is noticed."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfcore.native.yuv import i420_from_colour
from rfcore.views import PosedPicture
from rfedge.evaluate.clips import Drive, DriveName
from rfedge.evaluate.never_worse import EvalNeverWorse
from rfedge.evaluate.never_worse.measure import (
    CONTROLS,
    NeverWorse,
    controls_of,
    run_never_worse,
)
from rfedge.jobs import CellStore
from tests.clouds import cloud

SAMPLES = Path(__file__).parents[2] / "samples"
INTRINSICS = Intrinsics(160, 96, 120.0, 120.0, 80.0, 48.0)
CAMERAS = [Camera(INTRINSICS, Pose((0.02 * k, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))) for k in range(4)]


FIELD = cloud(1, 4000, [-3, -2, 4], [3, 2, 4.2], 0.06)
"A wall of small splats 4 m ahead; to the left there is nothing."


def drive():
    frames = [i420_from_colour(FIELD.render_colour(camera)) for camera in CAMERAS]
    pictures = [
        PosedPicture(str(k), camera, lambda: np.zeros((96, 160, 3), np.uint8))
        for k, camera in enumerate(CAMERAS)
    ]
    return Drive(DriveName("wall", 10.0, Path("wall.json")), pictures, frames)


@pytest.fixture(scope="module")
def seen():
    return controls_of(FIELD, drive())


def test_the_controls_are_another_place_and_nothing_at_the_same_poses(seen):
    assert tuple(seen) == CONTROLS
    right, wrong, black = seen.values()
    assert right.cameras == wrong.cameras == black.cameras
    assert wrong.cameras == right.cameras
    assert not np.array_equal(right.renders[0].y, wrong.renders[0].y)
    assert not np.array_equal(right.views[0].depth, wrong.views[0].depth)
    assert {int(plane.max()) for plane in black.renders[0].planes} == {16, 128}
    assert black.views[0].depth.max() == 0
    assert not any(mask.any() for mask in black.covered)


def test_a_row_tells_excess_without_header_and_whether_it_holds(tmp_path, seen):
    noise = np.random.default_rng(2)
    noisy = [
        type(f)(
            np.clip(f.y + noise.integers(-40, 41, f.y.shape), 1, 255).astype(np.uint8), f.u, f.v
        )
        for f in drive().frames
    ]
    table = NeverWorse(
        Drive(drive().name, drive().pictures, noisy), seen, "fast", "veryfast", "test"
    )
    rows = list(table.rows(CellStore(tmp_path)))
    assert [(row.control, row.at_db) for row in rows] == [
        (control, db) for control in CONTROLS for db in (31.0, 33.0, 35.0)
    ]
    by_control = {row.control: row for row in rows if row.at_db == 33.0}
    assert by_control["right"].excess_percent < by_control["black"].excess_percent
    for row in rows:
        slice_bytes = row.bytes - row.header_bytes
        expected = 100 * (slice_bytes / row.rival_bytes - 1)
        assert row.excess_percent == pytest.approx(expected)
        assert row.holds == (row.excess_percent <= 2)
        assert 15 < row.header_bytes < 300


def test_a_job_without_drives_is_refused():
    with pytest.raises(InvalidInput, match="drives"):
        EvalNeverWorse(field=Path("f.rff"))


@pytest.fixture(scope="module")
def on_the_thumbnail(thumbnail, tmp_path_factory):
    folder = tmp_path_factory.mktemp("never-worse")
    job = EvalNeverWorse(
        field=thumbnail.field,
        drives=(thumbnail.drive,),
        effort="fast",
        preset="ultrafast",
        out=folder / "never.json",
        cells=folder / "cells",
        quick=True,
    )
    console = Console(record=True, file=io.StringIO(), width=160)
    return job, run_never_worse(job, console), console.export_text()


def test_a_run_has_a_row_for_every_control_and_quality(on_the_thumbnail):
    job, result, printed = on_the_thumbnail
    rows = result["rows"]
    assert [(row["control"], row["at_db"]) for row in rows] == [
        (control, db) for control in CONTROLS for db in (31.0, 33.0, 35.0)
    ]
    assert json.loads(job.out.read_text())["rows"] == rows
    assert printed.startswith("1 drives, about ")
    assert all(f"{row['excess_percent']:.1f}" in printed for row in rows)


def test_only_the_right_field_is_predicted_from(on_the_thumbnail):
    _, result, _ = on_the_thumbnail
    for row in result["rows"]:
        assert ("render" in row["references"]) == (row["control"] == "right")


def test_the_right_field_costs_less_than_none(on_the_thumbnail):
    _, result, _ = on_the_thumbnail
    at = {(row["control"], row["at_db"]): row["bytes"] for row in result["rows"]}
    for db in (31.0, 33.0, 35.0):
        assert at["right", db] < at["black", db]


def test_a_run_that_is_finished_is_taken_from_its_cells(on_the_thumbnail):
    job, result, _ = on_the_thumbnail
    cells = {path: path.read_bytes() for path in job.cells.iterdir()}
    assert run_never_worse(job, Console(quiet=True))["rows"] == result["rows"]
    assert {path: path.read_bytes() for path in job.cells.iterdir()} == cells


@pytest.mark.slow
@pytest.mark.sample
def test_on_the_sample_no_field_makes_it_worse(tmp_path):
    job = EvalNeverWorse(
        field=SAMPLES / "fields" / "street.rff",
        drives=(f"empty@10={SAMPLES / 'street' / 'transforms_drive_empty.json'}",),
        effort="fast",
        preset="veryfast",
        out=tmp_path / "never.json",
        cells=tmp_path / "cells",
        quick=True,
    )
    result = run_never_worse(job, Console(quiet=True))
    assert json.loads(job.out.read_text())["rows"] == result["rows"]
    assert all(row["holds"] for row in result["rows"])
