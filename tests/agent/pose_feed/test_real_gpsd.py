"""Heights and headings through the real gpsd, and along a minute of a real receiver's fixes."""

from __future__ import annotations

from pathlib import Path

import pytest

from lab.truth.gnss import DRIVES, GPSD_CASES, run_drive, run_gpsd

SEGMENT = Path("../shared/data/comma2k19")
CASES = {case.name: case for case in GPSD_CASES}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_what_gpsd_says_of_a_known_place(name: str) -> None:
    row = run_gpsd(CASES[name])
    assert row["height_error_m"] < row["height_std_m"]
    assert row["height_error_m"] == pytest.approx(0.0, abs=3.0 if "without" in name else 1e-3)
    assert row["heading_error_deg"] == pytest.approx(0.0 if "HDT" in name else 2.0, abs=1e-6)
    assert row["refused"] == ""


@pytest.mark.skipif(not SEGMENT.exists(), reason="comma2k19 is not there")
def test_the_offset_of_a_real_receiver_is_found_and_halves_its_error() -> None:
    """Reference and receiver differ by 1.5 m; at 33 m/s a sixth of a second is 5 m."""
    rows = {drive.name: run_drive(drive, SEGMENT) for drive in DRIVES}
    told = rows["comma2k19, JSON"]
    later = rows["comma2k19, JSON, the offset found added"]
    assert later["position_error_m"] < 0.6 * told["position_error_m"]
    assert abs(later["offset_s"]) < 0.02
    alone = rows["comma2k19, NMEA without separation"]
    assert alone["offset_s"] == pytest.approx(told["offset_s"], abs=0.05)
    assert max(row["heading_error_deg"] for row in rows.values()) < 2.0
