"""Cameras that lose, reorder and change, by RTP and RTSP: no wrong picture is handed on."""

from __future__ import annotations

import pytest

from lab.truth.cameras import (
    CASES,
    SERVED_CASES,
    CameraCase,
    ServedCase,
    run_camera,
    run_rig,
    run_served,
)

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]
REFUSED = {"fields of two instants": "interlaced", "YCgCo": "matrix 8", "other size": "320x180"}


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_no_picture_of_a_camera_is_wrong(case: CameraCase) -> None:
    row = run_camera(case)
    assert row["wrong_pictures"] == 0
    assert REFUSED.get(case.name, "") in row["refused"]
    if case.name in REFUSED:
        assert row["refused"]
    else:
        assert row["pictures"] > 10
    if "lost" in case.name:
        assert row["left_out"] > 0


def test_the_pictures_of_a_rigs_cameras_are_their_own_and_of_one_time() -> None:
    row = run_rig()
    assert row["wrong_pictures"] == 0
    assert row["pictures"] > 20
    assert row["time_error_ms"] < 1.0, "both have the time of their sender reports"


@pytest.mark.parametrize("case", SERVED_CASES, ids=lambda case: case.name)
def test_no_picture_of_gstreamers_server_is_wrong(case: ServedCase) -> None:
    row = run_served(case)
    assert row["wrong_pictures"] == 0
    assert row["pictures"] > 10
