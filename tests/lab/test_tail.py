"""Many different frames: drives that differ and come again, their sizes, what may be claimed."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from lab.latency.tail import (
    LANE_M,
    SWAY_M,
    FieldStreet,
    TailJob,
    TailRow,
    run_tail,
    tail_section,
)
from rfcore.errors import InvalidInput
from rfcore.metrics import psnr
from rfedge.results import rows_of

SIZE_PX = (96, 64)


@pytest.fixture(scope="module")
def street(thumbnail: Any) -> FieldStreet:
    """The thumbnail, past which a camera moves by 0.2 m: at 120 Hz that is some frames."""
    path = Path(thumbnail.drive.partition("=")[2])
    return FieldStreet(thumbnail.field, path, SIZE_PX, 120.0, 0.5, 2.0, seed=3)


def test_a_drive_comes_again_and_no_two_pictures_are_the_same(street: FieldStreet) -> None:
    seen = set()
    for number in range(6):
        first, again = (replace(street).drive(number) for _ in range(2))
        assert first.cameras == again.cameras
        digests = [frame.digest() for frame in first.frames]
        assert digests == [frame.digest() for frame in again.frames]
        assert len(first.frames) == street.frame_count(number) >= 2
        seen |= set(digests)
    assert len(seen) == sum(street.frame_count(number) for number in range(6))
    other = replace(street, seed=4).drive(0)
    assert not {frame.digest() for frame in other.frames} & seen


def test_a_drive_goes_along_the_recorded_path_in_a_lane_of_its_own(street: FieldStreet) -> None:
    recorded = np.array([c.world_from_cam.translation_m for c in street.recorded])
    lanes = []
    for number in range(20):
        cameras = street.drive(number).cameras
        places = np.array([camera.world_from_cam.translation_m for camera in cameras])
        aside = np.abs(places[:, None] - recorded).min(axis=1)  # of the axes, to the nearest
        assert aside.max() <= LANE_M + 2 * SWAY_M + 0.06
        lanes.append(places.mean(axis=0))
        assert all((c.intrinsics.width_px, c.intrinsics.height_px) == SIZE_PX for c in cameras)
    assert np.ptp(np.array(lanes), axis=0).max() > LANE_M


def test_what_a_camera_sees_is_the_field_with_noise_of_the_size_asked_for(
    street: FieldStreet,
) -> None:
    noisy, clean = street.drive(1), replace(street, noise_sigma=0.0).drive(1)
    assert noisy.cameras == clean.cameras
    difference = np.float64(noisy.frames[0].y) - clean.frames[0].y
    assert difference.std() == pytest.approx(2.0, rel=0.1)
    assert psnr(noisy.frames[0].y, clean.frames[0].y) < 45


@pytest.fixture(scope="module")
def tail(street: FieldStreet, tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("tail")
    job = TailJob(
        replace(street), 60, 34.0, "fast", "ultrafast", 1, folder / "tail.json", folder / "cells"
    )
    return job, run_tail(job, Console(quiet=True))


def test_both_methods_have_a_row_of_as_many_frames_as_asked_for(tail: Any) -> None:
    job, result = tail
    assert json.loads(job.out.read_text()) == result
    ours, theirs = rows_of(TailRow, result["rows"])
    assert (ours.method, theirs.method) == ("rfedge-fast", "x264-lowdelay-ultrafast")
    assert ours.frames == theirs.frames >= 60
    for row in (ours, theirs):
        sizes = list(row.quantile_bytes.values())
        assert sizes == sorted(sizes)
        assert sizes[-1] == row.largest_bytes > row.mean_bytes
        assert abs(row.psnr_db - 34) < 1.5
        assert row.late_share_below == pytest.approx(1 - 0.05 ** (1 / row.frames))
        uplink = row.uplink_bps_all_within
        assert uplink["5"] >= 0.99 * 8 * row.largest_bytes / 0.005
        assert uplink["10"] < uplink["5"]


def test_finished_pieces_are_not_coded_again_and_other_processes_make_the_same(tail: Any) -> None:
    job, result = tail
    again = run_tail(job, Console(quiet=True))
    assert again["rows"] == result["rows"]
    elsewhere = replace(
        job, street=replace(job.street), processes=2, out=job.out.with_name("b.json")
    )
    for path in job.cells.iterdir():
        if '"verb": "tail"' in path.read_text():
            path.unlink()
    assert run_tail(elsewhere, Console(quiet=True))["rows"] == result["rows"]


def test_a_section_has_what_was_measured(tail: Any) -> None:
    job, result = tail
    section = tail_section(job.out, result)
    assert "| rfedge-fast | 96x64 | 120 |" in section
    assert "noise of 2 levels" in section


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"rate_hz": 0.0}, "hz"),
        ({"noise_sigma": -1.0}, "noise"),
        ({"size_px": (97, 64)}, "size"),
        ({"detail": 0.3}, "detail"),
    ],
)
def test_a_street_that_cannot_be_is_refused_by_name(
    change: dict[str, Any], named: str, street: FieldStreet
) -> None:
    with pytest.raises(InvalidInput, match=named):
        replace(street, **change)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"frames": 0}, "frames"),
        ({"processes": 0}, "processes"),
        ({"quality_db": 5.0}, "quality_db"),
        ({"out": Path("x.txt")}, "out"),
    ],
)
def test_a_job_that_cannot_be_done_is_refused_by_name(
    change: dict[str, Any], named: str, tail: Any
) -> None:
    with pytest.raises(InvalidInput, match=named):
        replace(tail[0], **change)
