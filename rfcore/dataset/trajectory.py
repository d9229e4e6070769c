"""A trajectory: poses over time, from a TUM or CSV file, and the pose between two of them.

TUM (Sturm et al., the RGB-D benchmark's format): lines ``time tx ty tz qx qy qz qw``, seconds and
metres, ``#`` starts a comment. CSV: a header with the columns ``time_s`` or ``time_ns``, ``x_m``,
``y_m``, ``z_m``, ``qw``, ``qx``, ``qy``, ``qz`` in any order. Both are world_from_body. Times are
kept as whole nanoseconds, exactly as printed, and must increase.

Between two poses the position is interpolated linearly and the rotation by SLERP (Shoemake 1985)
along the shorter arc (``rfcore.motion``). Nothing is extrapolated.
"""

from __future__ import annotations

import bisect
import csv
from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from itertools import pairwise
from pathlib import Path

from rfcore.camera import Pose
from rfcore.dataset.keys import finite_numbers, pose_of_quaternion, text_lines
from rfcore.errors import DatasetError
from rfcore.motion import interpolated

NS_PER_S = 1_000_000_000
MAX_TIME_NS = 2**63 - 1

Row = tuple[str, int, Pose]


@dataclass(frozen=True)
class Trajectory:
    """``times_ns`` increase strictly; ``poses`` are world_from_body, one for each time."""

    file: Path
    times_ns: tuple[int, ...]
    poses: tuple[Pose, ...]

    def covers(self, time: int) -> bool:
        """Return whether a time, ns, lies between the first and the last pose."""
        return self.times_ns[0] <= time <= self.times_ns[-1]

    def pose_at(self, where: str, time: int, max_gap_ns: int) -> Pose:
        """Return the pose at a time.

        Raises ``DatasetError`` outside the trajectory, and between two poses further apart than
        ``max_gap_ns``.
        """
        if not self.covers(time):
            raise DatasetError(
                f"{where}: time {time / NS_PER_S:.6f} s is outside {self.file}, "
                f"{self.times_ns[0] / NS_PER_S:.6f}..{self.times_ns[-1] / NS_PER_S:.6f} s; check "
                'time_offset_s, or set outside = "drop"'
            )
        after = bisect.bisect_left(self.times_ns, time)
        if self.times_ns[after] == time:
            return self.poses[after]
        gap_ns = self.times_ns[after] - self.times_ns[after - 1]
        if gap_ns > max_gap_ns:
            raise DatasetError(
                f"{where}: the poses of {self.file} around {time / NS_PER_S:.6f} s are "
                f"{gap_ns / NS_PER_S:.3f} s apart, over max_gap_s = {max_gap_ns / NS_PER_S:g}"
            )
        share = (time - self.times_ns[after - 1]) / gap_ns
        return interpolated(self.poses[after - 1], self.poses[after], share)


def read_trajectory(file: Path) -> Trajectory:
    """Read a TUM file, or CSV if it is named ``.csv``. Raises ``DatasetError`` naming the line."""
    rows = list(_csv_rows(file) if file.suffix.lower() == ".csv" else _tum_rows(file))
    if not rows:
        raise DatasetError(f"{file}: holds no poses")
    for (_, before, _), (where, after, _) in pairwise(rows):
        if after <= before:
            raise DatasetError(
                f"{where}: time {after / NS_PER_S:.9f} s does not come after "
                f"{before / NS_PER_S:.9f} s"
            )
    return Trajectory(file, tuple(row[1] for row in rows), tuple(row[2] for row in rows))


def time_ns(where: str, word: str) -> int:
    """Return printed seconds as whole nanoseconds, without passing through a float."""
    return _whole_ns(where, word, NS_PER_S)


def _whole_ns(where: str, word: str, unit_ns: int) -> int:
    try:
        time = Decimal(word.strip()) * unit_ns
    except InvalidOperation as error:
        raise DatasetError(f"{where}: '{word}' is not a time") from error
    if not time.is_finite() or not 0 <= time <= MAX_TIME_NS:
        raise DatasetError(f"{where}: time {word} must be finite and at least 0")
    return int(time.to_integral_value())


def _tum_rows(file: Path) -> Iterator[Row]:
    for i, line in enumerate(text_lines(file), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        where = f"{file}: line {i}"
        if len(words) != 8:
            raise DatasetError(
                f"{where}: has {len(words)} values, TUM has 8: time tx ty tz qx qy qz qw"
            )
        x, y, z, qx, qy, qz, qw = finite_numbers(where, words[1:])
        time = time_ns(where, words[0])
        yield where, time, pose_of_quaternion(where, (x, y, z), (qw, qx, qy, qz))


def _csv_rows(file: Path) -> Iterator[Row]:
    table = csv.DictReader(text_lines(file), skipinitialspace=True)
    columns = table.fieldnames or ()
    clock = next((name for name in ("time_s", "time_ns") if name in columns), None)
    missing = [n for n in ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz") if n not in columns]
    if clock is None or missing:
        names = ", ".join((["time_s or time_ns"] if clock is None else []) + missing)
        raise DatasetError(f"{file}: line 1: has no column {names}")
    for row in table:
        where = f"{file}: line {table.line_num}"
        if None in row.values() or None in row:
            raise DatasetError(f"{where}: has not as many values as the header")
        unit_ns = 1 if clock == "time_ns" else NS_PER_S
        time = _whole_ns(where, row[clock], unit_ns)
        position = finite_numbers(where, [row[name] for name in ("x_m", "y_m", "z_m")])
        rotation = finite_numbers(where, [row[name] for name in ("qw", "qx", "qy", "qz")])
        yield where, time, pose_of_quaternion(where, position, rotation)
