"""Trajectories are read exactly, interpolated along great circles, and never extrapolated."""

import math

import pytest

from rfcore.camera import Pose
from rfcore.dataset.trajectory import read_trajectory, time_ns
from rfcore.errors import DatasetError

LIMIT_NS = 1_000_000_000


def test_the_ends_and_the_middle_are_what_they_should_be(tmp_path):
    file = tmp_path / "t.txt"
    half = math.sqrt(0.5)
    file.write_text(f"# t x y z qx qy qz qw\n10 0 0 0 0 0 0 1\n\n10.5 1 2 4 0 0 {half} {half}\n")
    trajectory = read_trajectory(file)
    start, middle, end = (
        trajectory.pose_at("x", t, LIMIT_NS)
        for t in (10_000_000_000, 10_250_000_000, 10_500_000_000)
    )
    assert start == Pose.identity()
    assert middle.translation_m == (0.5, 1.0, 2.0)
    eighth = math.pi / 8
    assert middle.rotation == pytest.approx((math.cos(eighth), 0, 0, math.sin(eighth)))
    assert end.translation_m == (1.0, 2.0, 4.0)


@pytest.mark.parametrize("time", [9_999_999_999, 10_500_000_001])
def test_a_time_outside_is_refused(tmp_path, time):
    file = tmp_path / "t.txt"
    file.write_text("10 0 0 0 0 0 0 1\n10.5 0 0 0 0 0 0 1\n")
    with pytest.raises(DatasetError, match=r"^x: time .*outside .*t\.txt.*time_offset_s.*drop"):
        read_trajectory(file).pose_at("x", time, LIMIT_NS)


def test_a_gap_is_not_bridged(tmp_path):
    file = tmp_path / "t.txt"
    file.write_text("10 0 0 0 0 0 0 1\n12 0 0 0 0 0 0 1\n")
    with pytest.raises(DatasetError, match=r"2\.000 s apart, over max_gap_s = 1"):
        read_trajectory(file).pose_at("x", 11_000_000_000, LIMIT_NS)
    assert read_trajectory(file).pose_at("x", 12_000_000_000, LIMIT_NS) == Pose.identity()


def test_times_are_exact_to_the_nanosecond():
    """As a float, 1305031102.175304123 s would be off by up to 120 ns."""
    assert time_ns("x", "1305031102.175304123") == 1_305_031_102_175_304_123


def test_csv_columns_come_in_any_order(tmp_path):
    file = tmp_path / "t.csv"
    file.write_text("qw, qx, qy, qz, note, x_m, y_m, z_m, time_ns\n1,0,0,0,a,4,5,6,123456789\n")
    trajectory = read_trajectory(file)
    assert trajectory.times_ns == (123_456_789,)
    assert trajectory.poses[0].translation_m == (4.0, 5.0, 6.0)


@pytest.mark.parametrize(
    ("name", "text", "named"),
    [
        ("t.txt", "", "holds no poses"),
        ("t.txt", "1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "line 2: time 1.0* s does not come after"),
        ("t.txt", "1 0 0 0 0 0 0 1\n.5 0 0 0 0 0 0 1\n", "line 2: time 0.50* s does not come"),
        ("t.txt", "-1 0 0 0 0 0 0 1\n", "line 1: time -1 must be"),
        ("t.txt", "inf 0 0 0 0 0 0 1\n", "line 1: time inf must be"),
        ("t.txt", "now 0 0 0 0 0 0 1\n", "line 1: 'now' is not a time"),
        ("t.txt", b"\xff\xfe\x00", "not a text file"),
        ("t.csv", "time_s,x_m,y_m\n", "line 1: has no column z_m, qw, qx, qy, qz"),
        ("t.csv", "a\n", "line 1: has no column time_s or time_ns"),
        ("t.csv", "time_s,x_m,y_m,z_m,qw,qx,qy,qz\n1,2\n", "line 2: has not as many values"),
        ("t.csv", "time_s,x_m,y_m,z_m,qw,qx,qy,qz\n1,2,3,4,1,0,0,b\n", "line 2: .*'b'"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, name, text, named):
    (tmp_path / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(DatasetError, match=rf"{name}: {named}"):
        read_trajectory(tmp_path / name)
