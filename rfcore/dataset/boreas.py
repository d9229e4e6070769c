"""A drive of Boreas or Boreas-RT, whose routes are driven repeatedly, as pyboreas lays it out::

    boreas-YYYY-MM-DD-HH-MM/applanix/camera_poses.csv   a line for each picture
        calib/P_camera.txt                              projection matrix of rectified pictures
        camera/MICROSECONDS.png

A line has the time in microseconds, the place (east, north, up of the set, m) and the angles roll
r, pitch p and heading y (rad). With Rx, Ry, Rz turns about x, y, z the camera's pose is::

    world_from_cam = [Rx(-r) Ry(-p) Rz(-y) | place]

All drives of a route share their world, so that one trains a field and another is coded.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

from rfcore.camera import Pose
from rfcore.dataset.bag_transforms import Edge
from rfcore.dataset.drive_set import US, Shot, pinhole_of_matrix, posed_source
from rfcore.dataset.keys import filled_lines, finite_numbers, text_lines
from rfcore.dataset.picture_header import picture_header
from rfcore.dataset.source import Source
from rfcore.errors import DatasetError

POSES = "camera_poses.csv"
"""The file by which a drive is recognised."""
COLUMNS = ("easting", "northing", "altitude", "roll", "pitch", "heading")


class BoreasDrive:
    """A drive, known by its file of the camera's poses."""

    names: Sequence[str] = ("camera",)

    def __init__(self, file: Path) -> None:
        self.file = file
        self._folder = file.absolute().parent.parent

    def read(self, name: str) -> Source:
        """Read the pictures that have a line of poses."""
        paths = {path.stem: path for path in (self._folder / name).glob("*.png")}
        if not paths:
            raise DatasetError(f"{self._folder / name}: holds no pictures (.png)")
        poses = self._poses()
        shown = [paths[stem] for stem in sorted(paths) if stem in poses]
        if not shown:
            raise DatasetError(
                f"{self.file}: none of its {len(poses)} poses is of one of the {len(paths)} "
                f"pictures in {self._folder / name}"
            )
        file = self._folder / "calib" / "P_camera.txt"
        rows = [finite_numbers(where, line.split()) for where, line in filled_lines(file)]
        if len(rows) not in (3, 4) or any(len(row) != 4 for row in rows):
            raise DatasetError(f"{file}: is not a matrix of 3x4 or 4x4 numbers")
        camera = pinhole_of_matrix(str(file), rows, picture_header(shown[0]).size_px)
        shots = [Shot.of_file(path, int(path.stem) * US, camera, Pose.identity()) for path in shown]
        notes = ["world: Boreas' east, north, up, metres, one for all drives of a route"]
        for count, what in (
            (len(paths) - len(shown), f"pictures have no line in {POSES}"),
            (len(poses) - len(shown), f"lines of {POSES} have no picture"),
        ):
            if count:
                notes.append(f"{count} {what}: left out")
        ego = Edge("world", POSES, False, {int(stem) * US: poses[stem] for stem in poses})
        return posed_source(self.file, shots, ego, notes)

    def _poses(self) -> dict[str, Pose]:
        """Return the poses by their times as printed, which name the pictures."""
        table = csv.DictReader(text_lines(self.file), skipinitialspace=True)
        missing = [name for name in ("GPSTime", *COLUMNS) if name not in (table.fieldnames or ())]
        if missing:
            raise DatasetError(f"{self.file}: line 1: has no column {', '.join(missing)}")
        poses = {}
        for row in table:
            where = f"{self.file}: line {table.line_num}"
            if None in row.values() or None in row:
                raise DatasetError(f"{where}: has not as many values as the header")
            time = row["GPSTime"].strip()
            if not (time.isascii() and time.isdigit() and len(time) < 17):
                raise DatasetError(f"{where}: '{time}' is no time in microseconds")
            x, y, z, *angles = finite_numbers(where, [row[column] for column in COLUMNS])
            poses[time] = Pose((x, y, z), _turn(*angles).rotation)
        return poses


def _turn(roll_rad: float, pitch_rad: float, heading_rad: float) -> Pose:
    """Return Rx(-roll) Ry(-pitch) Rz(-heading)."""
    turned = Pose.identity()
    for axis, angle in enumerate((roll_rad, pitch_rad, heading_rad), start=1):
        parts = [math.cos(angle / 2), 0.0, 0.0, 0.0]
        parts[axis] = -math.sin(angle / 2)
        w, x, y, z = parts
        turned = turned.compose(Pose((0.0, 0.0, 0.0), (w, x, y, z)))
    return turned
