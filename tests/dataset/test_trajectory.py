"""Trajectories are read exactly, interpolated along great circles, and never extrapolated."""

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.camera import Pose
from rfcore.dataset.trajectory import interpolated, read_trajectory, time_ns
from rfcore.errors import DatasetError

LIMIT_NS = 1_000_000_000

angle = st.floats(-3.1, 3.1)
component = st.floats(-1, 1)


def turned(angle_rad: float, axis: tuple[float, float, float] = (0, 0, 1)) -> Pose:
    """A turn about an axis through the origin, placed at (angle, 0, 0)."""
    norm = math.hypot(*axis)
    x, y, z = (math.sin(angle_rad / 2) * a / norm for a in axis)
    return Pose((angle_rad, 0.0, 0.0), (math.cos(angle_rad / 2), x, y, z))


@given(end=st.floats(0.0, 3.0), share=st.floats(0, 1))
def test_a_turn_is_shared_evenly(end: float, share: float) -> None:
    pose = interpolated(turned(0.0), turned(end), share)
    expected = turned(end * share)
    assert pose.rotation == pytest.approx(expected.rotation, abs=1e-12)
    assert pose.translation_m == pytest.approx(expected.translation_m)


@given(a=angle, b=angle, share=st.floats(0, 1), axis=st.tuples(component, component, component))
def test_the_sign_of_a_quaternion_means_nothing(
    a: float, b: float, share: float, axis: tuple[float, float, float]
) -> None:
    if math.hypot(*axis) < 1e-3 or abs(abs(a - b) - math.pi) < 1e-3:
        return
    first, second = turned(a, axis), turned(b, axis)
    w, x, y, z = second.rotation
    flipped = Pose(second.translation_m, (-w, -x, -y, -z))
    one, other = interpolated(first, second, share), interpolated(first, flipped, share)
    for i in range(3):
        unit = [float(i == j) for j in range(3)]
        assert one.apply(unit) == pytest.approx(other.apply(unit), abs=1e-9)


def test_two_turns_that_hardly_differ_are_no_division_by_zero() -> None:
    pose = interpolated(turned(1.0), turned(1.0 + 1e-9), 0.5)
    assert pose.rotation == pytest.approx(turned(1.0).rotation, abs=1e-9)


def test_the_ends_and_the_middle_are_what_they_should_be(tmp_path: Path) -> None:
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
    assert middle.rotation == pytest.approx(turned(math.pi / 4).rotation)
    assert end.translation_m == (1.0, 2.0, 4.0)


@pytest.mark.parametrize("time", [9_999_999_999, 10_500_000_001])
def test_a_time_outside_is_refused(tmp_path: Path, time: int) -> None:
    file = tmp_path / "t.txt"
    file.write_text("10 0 0 0 0 0 0 1\n10.5 0 0 0 0 0 0 1\n")
    with pytest.raises(DatasetError, match=r"^x: time .*outside .*t\.txt.*time_offset_s.*drop"):
        read_trajectory(file).pose_at("x", time, LIMIT_NS)


def test_a_gap_is_not_bridged(tmp_path: Path) -> None:
    file = tmp_path / "t.txt"
    file.write_text("10 0 0 0 0 0 0 1\n12 0 0 0 0 0 0 1\n")
    with pytest.raises(DatasetError, match=r"2\.000 s apart, over max_gap_s = 1"):
        read_trajectory(file).pose_at("x", 11_000_000_000, LIMIT_NS)
    assert read_trajectory(file).pose_at("x", 12_000_000_000, LIMIT_NS) == Pose.identity()


def test_times_are_exact_to_the_nanosecond() -> None:
    """As a float, 1305031102.175304123 s would be off by up to 120 ns."""
    assert time_ns("x", "1305031102.175304123") == 1_305_031_102_175_304_123


def test_csv_columns_come_in_any_order(tmp_path: Path) -> None:
    file = tmp_path / "t.csv"
    file.write_text("qw, qx, qy, qz, note, x_m, y_m, z_m, time_ns\n1,0,0,0,a,4,5,6,123456789\n")
    trajectory = read_trajectory(file)
    assert trajectory.times_ns == (123_456_789,)
    assert trajectory.poses[0].translation_m == (4.0, 5.0, 6.0)


@pytest.mark.parametrize(
    ("name", "text", "named"),
    [
        ("t.txt", "", "holds no poses"),
        ("t.txt", "1 0 0 0 0 0 0\n", r"line 1: has 7 values, TUM has 8"),
        ("t.txt", "1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "line 2: time 1.0* s does not come after"),
        ("t.txt", "1 0 0 0 0 0 0 1\n.5 0 0 0 0 0 0 1\n", "line 2: time 0.50* s does not come"),
        ("t.txt", "1 0 0 nan 0 0 0 1\n", "line 1: nan is not a finite"),
        ("t.txt", "1 0 0 0 0 0 0 2\n", "line 1: quaternion .* has norm 2"),
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
def test_what_is_wrong_is_named(tmp_path: Path, name: str, text: str | bytes, named: str) -> None:
    (tmp_path / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(DatasetError, match=rf"{name}: {named}"):
        read_trajectory(tmp_path / name)


def test_a_missing_trajectory_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"t\.txt: cannot be read"):
        read_trajectory(tmp_path / "t.txt")
