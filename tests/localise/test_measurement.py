"""A measurement is checked where it is made: nothing later meets a value that is not finite."""

import math
from typing import Any

import pytest

from rfcore.camera import Pose
from rfcore.errors import InvalidInput
from rfcore.localise.prior import PoseMeasurement

GOOD: dict[str, Any] = {
    "time_ns": 1,
    "position_m": (1.0, 2.0, 3.0),
    "position_std_m": (1.0, 1.0, 2.0),
    "rotation": (1.0, 0.0, 0.0, 0.0),
    "rotation_std_deg": 1.0,
}


def test_a_measurement_with_a_rotation_is_a_pose() -> None:
    assert PoseMeasurement(**GOOD).world_from_cam == Pose((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0))
    assert PoseMeasurement(**{**GOOD, "rotation": None}).world_from_cam is None


@pytest.mark.parametrize(
    ("name", "value", "reported"),
    [
        ("time_ns", -1, "time_ns"),
        ("time_ns", 1 << 64, "time_ns"),
        ("position_m", (math.nan, 0.0, 0.0), "translation_m"),
        ("position_m", (0.0, math.inf, 0.0), "translation_m"),
        ("rotation", (2.0, 0.0, 0.0, 0.0), "rotation"),
        ("rotation", (math.nan, 0.0, 0.0, 0.0), "rotation"),
        ("position_std_m", (1.0, 0.0, 1.0), "position_std_m"),
        ("position_std_m", (1.0, math.nan, 1.0), "position_std_m"),
        ("rotation_std_deg", math.inf, "rotation_std_deg"),
        ("rotation_std_deg", -1.0, "rotation_std_deg"),
    ],
)
def test_what_no_sensor_can_mean_is_refused(name: str, value: object, reported: str) -> None:
    with pytest.raises(InvalidInput, match=reported):
        PoseMeasurement(**{**GOOD, name: value})
