"""A log of Argoverse 2 (sensor data set, or Trust but Verify), as its devkit (MIT) lays it out::

    LOG/city_SE3_egovehicle.feather            poses of the vehicle in the city, by time
        calibration/intrinsics.feather         fx_px ... by the camera's name
        calibration/egovehicle_SE3_sensor.feather   mounting of every sensor
        sensors/cameras/CAMERA/NANOSECONDS.jpg

A pose a_SE3_b is a_from_b: metres and a quaternion w, x, y, z. The vehicle's axes are forward, left
and up, a camera's are OpenCV's. The city's are east, north (UTM) and up from an origin of the
city's own. Pictures are published undistorted: the coefficients k1 to k3 are of the lens before.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rfcore.camera import Intrinsics, Pose
from rfcore.dataset.arrow_file import PLACE, TURN, arrow_rows, pose_of_row
from rfcore.dataset.bag_transforms import Edge
from rfcore.dataset.drive_set import Shot, posed_source
from rfcore.dataset.keys import blamed_on
from rfcore.dataset.source import Source, SourceCamera
from rfcore.errors import DatasetError, named
from rfcore.tables import Table

POSES = "city_SE3_egovehicle.feather"
"""The file by which a log is recognised."""
PINHOLE = ("fx_px", "fy_px", "cx_px", "cy_px")
SIZE = ("width_px", "height_px")
NOTES = (
    "world: Argoverse's city, metres, x east, y north (UTM), z up",
    "pictures are taken as undistorted, as they are published: k1 to k3 are left out",
)


class ArgoverseLog:
    """A log, known by its file of poses."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self._folder = file.parent

    @property
    def names(self) -> Sequence[str]:
        """Cameras that have a folder of pictures."""
        folders = (self._folder / "sensors" / "cameras").glob("*")
        return sorted(folder.name for folder in folders if folder.is_dir())

    def read(self, name: str) -> Source:
        """Read one camera's pictures."""
        where, row = self._row("intrinsics.feather", name, (*PINHOLE, *SIZE))
        size_px, pinhole = (row.whole(key) for key in SIZE), (row.number(key) for key in PINHOLE)
        with blamed_on(where):
            camera = SourceCamera(Intrinsics(*size_px, *pinhole))
        ego_from_cam = pose_of_row(
            *self._row("egovehicle_SE3_sensor.feather", name, (*TURN, *PLACE))
        )
        folder = self._folder / "sensors" / "cameras" / name
        shots = [
            Shot.of_file(path, _time_ns(path), camera, ego_from_cam)
            for path in sorted((*folder.glob("*.jpg"), *folder.glob("*.png")))
        ]
        if not shots:
            raise DatasetError(f"{folder}: holds no pictures (.jpg, .png)")
        return posed_source(self.file, shots, self._ego(), NOTES)

    def _row(self, file_name: str, name: str, columns: Sequence[str]) -> tuple[str, Table]:
        file = self._folder / "calibration" / file_name
        rows = {
            row.text("sensor_name"): (where, row)
            for where, row in arrow_rows(file, ("sensor_name", *columns))
        }
        if name not in rows:
            raise DatasetError(f"{file}: has no sensor '{name}'; it has {named(rows, 'none')}")
        return rows[name]

    def _ego(self) -> Edge:
        poses: dict[int, Pose] = {}
        for where, row in arrow_rows(self.file, ("timestamp_ns", *TURN, *PLACE)):
            poses[row.whole("timestamp_ns")] = pose_of_row(where, row)
        return Edge("city", POSES, False, poses)


def _time_ns(path: Path) -> int:
    if not (path.stem.isascii() and path.stem.isdigit() and len(path.stem) < 20):
        raise DatasetError(f"{path}: is not named by its time in nanoseconds")
    return int(path.stem)
