"""A segment of comma2k19 (MIT): a minute of a windscreen camera with poses and GNSS::

    SEGMENT/video.hevc
        global_pose/frame_times            s since the device started, one for each frame
                    frame_positions        of the camera, ECEF, m
                    frame_orientations     quaternions w, x, y, z
        processed_log/GNSS/live_gnss_*/t, value    latitude, longitude, speed, time, height, bearing

Files without a suffix are numpy's. The quaternion is ecef_from_device, whose axes are forward,
right and down: so it is in the data (the motion is along its x axis), while the readme calls it the
rotation from ECEF. The camera is that of its ``utils/camera.py``: 1164x874 px, focal length 910 px,
no lens.

The world is ECEF, the same for all segments; an anchor says where east, north and up are.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Intrinsics, Pose
from rfcore.dataset.bag_transforms import NS
from rfcore.dataset.keys import blamed_on, pose_of_quaternion, read_file
from rfcore.dataset.source import Source, SourceCamera, SourcePicture
from rfcore.dataset.video import Video
from rfcore.errors import DatasetError
from rfcore.geodesy import Anchor

POSITIONS = "frame_positions"
"""The file by which a segment is recognised."""
CAMERA = SourceCamera(Intrinsics(1164, 874, 910.0, 910.0, 582.0, 437.0))
DEVICE_FROM_CAM = Pose.from_matrix([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0]])
F64 = NDArray[np.float64]


class CommaSegment:
    """A segment, known by its file of positions."""

    names: Sequence[str] = ("video",)

    def __init__(self, file: Path) -> None:
        self.file = file
        self._folder = file.absolute().parent.parent

    def read(self, name: str) -> Source:
        """Read the frames of ``video.hevc`` at their poses, and the GNSS fixes as pose feeds."""
        places = _array(self.file, 3)
        turns = _array(self.file.with_name("frame_orientations"), 4, len(places))
        times_s = _array(self.file.with_name("frame_times"), 1, len(places))[:, 0]
        video = Video(self._folder / f"{name}.hevc")
        k = CAMERA.intrinsics
        if video.size_px != (k.width_px, k.height_px):
            raise DatasetError(
                f"{video.file}: is {video.size_px[0]}x{video.size_px[1]} px; the set's camera has "
                f"{k.width_px}x{k.height_px}"
            )
        frames = len(video.index.times_ns)
        pictures = []
        for i in range(min(frames, len(places))):
            where = f"{self.file}: row {i}"
            world_from_device = pose_of_quaternion(where, places[i].tolist(), turns[i].tolist())
            pictures.append(
                SourcePicture(
                    where=where,
                    name=f"{name}_{i:06d}",
                    camera=CAMERA,
                    world_from_cam=world_from_device.compose(DEVICE_FROM_CAM),
                    read=partial(video.read, i),
                    time_ns=round(times_s[i] * NS),
                )
            )
        notes = [
            "world: ECEF, metres; times: since the device started",
            "camera: that of comma2k19's code, focal length 910 px, no lens",
            *(note for note in video.index.notes if "state no times" not in note),
        ]
        if frames != len(places):
            notes.append(f"{video.file.name} has {frames} frames, {len(places)} have poses")
        with blamed_on(self.file):
            anchor = Anchor.of_ecef(pictures[0].world_from_cam.translation_m)
        return Source(
            self.file, tuple(pictures), anchor=anchor, notes=tuple(notes), feeds=self._feeds()
        )

    def _feeds(self) -> dict[str, list[str]]:
        feeds = {}
        for folder in sorted((self._folder / "processed_log" / "GNSS").glob("live_gnss_*")):
            values = _array(folder / "value", 6)
            times_s = _array(folder / "t", 1, len(values))[:, 0]
            feeds[folder.name] = [
                json.dumps(
                    {
                        "time_s": time_s,
                        "latitude_deg": value[0],
                        "longitude_deg": value[1],
                        "height_m": value[4],
                    }
                )
                for time_s, value in zip(times_s.tolist(), values.tolist(), strict=True)
            ]
        return {name: lines for name, lines in feeds.items() if lines}


def _array(file: Path, columns: int, rows: int | None = None) -> F64:
    """Return the numbers of a file [rows, columns]; refuse other shapes and what is not finite."""
    try:
        found: NDArray[Any] = np.load(BytesIO(read_file(file)), allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise DatasetError(f"{file}: is no array of numpy ({error})") from error
    if not isinstance(found, np.ndarray) or found.dtype.kind not in "fiu":
        raise DatasetError(f"{file}: holds no numbers")
    if columns == 1 and found.ndim == 1:
        found = found[:, None]
    if found.ndim != 2 or found.shape[1] != columns or not len(found):
        raise DatasetError(f"{file}: has shape {found.shape}, must be rows of {columns}")
    if rows is not None and len(found) != rows:
        raise DatasetError(f"{file}: has {len(found)} rows, the positions have {rows}")
    if not np.isfinite(found).all():
        row = int(np.flatnonzero(~np.isfinite(found).all(axis=1))[0])
        raise DatasetError(f"{file}: row {row} is not finite: {found[row].tolist()}")
    return found.astype(np.float64)
