"""A drive over a link that loses packets: late, never damaged, the same each time."""

from dataclasses import replace

import pytest
from rich.console import Console

from rfcore.errors import InvalidInput
from rfedge.evaluate.lossy_link import EvalLossyLink
from rfedge.evaluate.lossy_link.measure import (
    LossyLinkRow,
    frozen_s,
    lossy_link_parts,
    run_lossy_link,
)
from rfedge.results import as_json, rows_of

COMPUTING_MS = 40.0 + 25.0


@pytest.fixture(scope="module")
def job(thumbnail, tmp_path_factory):
    """Five seconds over two links."""
    folder = tmp_path_factory.mktemp("lossy-link")
    return EvalLossyLink(
        field=thumbnail.field,
        drive=thumbnail.drive,
        rates_mbps=(8.0,),
        losses=(0.0, 10.0),
        seconds=6.0,
        seeds=2,
        out=folder / "lossy-link.json",
        cells=folder / "cells",
    )


@pytest.fixture(scope="module")
def rows(job):
    return rows_of(LossyLinkRow, run_lossy_link(job, Console(quiet=True))["rows"])


def test_without_loss_a_picture_takes_the_link_and_both_ends(job, rows):
    clean = rows[0]
    assert clean.age_p50_ms == pytest.approx(COMPUTING_MS + job.rtt_ms / 2, abs=10.0)
    assert clean.age_p99_ms < clean.age_p50_ms + 20.0
    assert clean.frozen_percent == clean.streams_lost == 0.0


def test_loss_makes_pictures_late_and_damages_none(rows):
    clean, lossy, _ = rows
    assert lossy.age_p99_ms > clean.age_p99_ms + 60.0, "a probe or a timeout"
    assert lossy.shown_hz <= clean.shown_hz
    assert lossy.psnr_db > clean.psnr_db - 6.0


def test_the_same_drive_has_the_same_figures(job, rows, tmp_path):
    again = replace(job, losses=job.losses[1:], cells=tmp_path, out=tmp_path / "again.json")
    assert rows_of(LossyLinkRow, run_lossy_link(again, Console(quiet=True))["rows"]) == rows[1:]


def test_each_seed_loses_other_packets_and_the_table_has_median_and_range(rows):
    clean, *lossy = rows
    assert (clean.seed, [row.seed for row in lossy]) == (1, [1, 2])
    assert lossy[0].age_p99_ms != lossy[1].age_p99_ms
    three = [replace(clean, loss_percent=5.0, age_p99_ms=ms) for ms in (300.0, 900.0, 400.0)]
    head = {
        "frames": {"drive": "d", "hz": 10.0, "size_px": [640, 360]},
        "link": {"rtt_ms": 40.0, "seeds": 3},
        "seconds": 20.0,
        "max_delay_ms": 500.0,
        "vehicle_ms": 40.0,
        "server_ms": 25.0,
    }
    _, table = lossy_link_parts({**head, "rows": as_json([clean, *three])})
    assert [row[3] for row in table.cells] == [f"{clean.age_p99_ms:.0f}", "400 (300..900)"]
    assert "1 camera of 640x360 px at 10 Hz" in table.title


def test_a_gap_of_three_mean_distances_is_a_freeze():
    every_100_ms = [0.1 * k for k in range(20)]
    assert frozen_s(every_100_ms, 2.0) == 0.0
    assert frozen_s([*every_100_ms, 2.9], 3.0) == pytest.approx(1.0)
    assert frozen_s([], 3.0) == 3.0


@pytest.mark.parametrize("change", [{"losses": (40.0,)}, {"rates_mbps": ()}, {"seconds": 1.0}])
def test_links_that_cannot_be_are_refused_by_their_option(change):
    with pytest.raises(InvalidInput, match=next(iter(change))):
        EvalLossyLink(**change)
