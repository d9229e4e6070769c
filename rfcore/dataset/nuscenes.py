"""Scenes of nuScenes, as its devkit (Apache-2.0) lays them out: tables of JSON beside pictures.

``VERSION/TABLE.json`` is a list of rows with a ``token`` each, which others name. A ``sample_data``
of a camera (``sensor``, ``calibrated_sensor``) has a picture, its time in microseconds, and its
``ego_pose``; its ``sample`` leads to the ``scene``. Quaternions are w, x, y, z; ``ego_pose`` is
global_from_ego, ``calibrated_sensor`` ego_from_sensor. The global axes are metres, x east, y north
and z up from the map's south-west corner. Pictures are rectified. Key frames (2 Hz) and the sweeps
between them (12 Hz) are both read.

Tables are read row by row, since a whole set's take gigabytes.
"""

from __future__ import annotations

import json
from collections.abc import Container, Iterator, Mapping, Sequence
from pathlib import Path

from rfcore.camera import Pose
from rfcore.dataset.bag_transforms import Edge
from rfcore.dataset.drive_set import US, Shot, pinhole_of_matrix, posed_source
from rfcore.dataset.keys import pose_of_quaternion, table_at
from rfcore.dataset.picture_name import file_inside
from rfcore.dataset.source import Source
from rfcore.errors import DatasetError, named
from rfcore.tables import Table

TABLE = "sample_data.json"
"""The table by which a set is recognised."""
CHUNK = 1 << 20
MAX_ROW = 1 << 24
NOTES = ("world: nuScenes' global map, metres, x east, y north, z up",)


class NuScenes:
    """The scenes of one version, known by its table of ``sample_data``."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self._tables = file.parent
        self._scenes = {row.text("name"): row.text("token") for row in self._rows("scene")}
        self._channels = {
            row.text("channel"): row.text("token")
            for row in self._rows("sensor")
            if row.text("modality") == "camera"
        }

    @property
    def names(self) -> Sequence[str]:
        """``SCENE/CAMERA`` for every scene and camera of the set."""
        return [f"{scene}/{camera}" for scene in self._scenes for camera in sorted(self._channels)]

    def read(self, name: str) -> Source:
        """Read one camera's pictures of a scene."""
        scene, _, channel = name.partition("/")
        samples = {
            row.text("token")
            for row in self._rows("sample")
            if row.text("scene_token") == self._scenes[scene]
        }
        sensors = {row.text("token"): row for row in self._rows("calibrated_sensor")}
        shown: dict[str, list[Table]] = {}
        for row in self._rows("sample_data", "sample_token", samples):
            sensor = sensors.get(row.text("calibrated_sensor_token"))
            if sensor is None:
                raise row.error("calibrated_sensor_token", "is in no row of calibrated_sensor.json")
            shown.setdefault(sensor.text("sensor_token"), []).append(row)
        rows = shown.get(self._channels[channel], [])
        if not rows:
            there = [c for c, token in self._channels.items() if token in shown]
            raise DatasetError(
                f"{self.file}: {scene} has no pictures of {channel}; it has {named(there, 'none')}"
            )
        shots = self._shots(scene, channel, rows, sensors)
        notes = list(NOTES)
        if len(shots) < len(rows):
            notes.append(
                f"{len(rows) - len(shots)} of {len(rows)} pictures of {channel} are listed but not "
                "there: left out"
            )
        return posed_source(self.file, shots, self._ego(rows), notes)

    def _shots(
        self, scene: str, channel: str, rows: Sequence[Table], sensors: Mapping[str, Table]
    ) -> list[Shot]:
        shots = []
        for row in rows:
            where = f"{self.file}: {row.text('filename')}"
            path = file_inside(where, self._tables.parent, row.text("filename"))
            if path is None:
                continue
            sensor = sensors[row.text("calibrated_sensor_token")]
            k = sensor.matrix("camera_intrinsic", ((3, 3),))
            camera = pinhole_of_matrix(where, k, (row.whole("width"), row.whole("height")))
            time_ns = row.whole("timestamp") * US
            shots.append(Shot.of_file(path, time_ns, camera, _pose("calibrated_sensor", sensor)))
        if not shots:
            raise DatasetError(
                f"{self.file}: none of the {len(rows)} pictures of {channel} in {scene} is there; "
                f"the first would be {self._tables.parent / rows[0].text('filename')}"
            )
        return shots

    def _ego(self, rows: Sequence[Table]) -> Edge:
        tokens = {row.text("ego_pose_token") for row in rows}
        poses = {
            row.whole("timestamp") * US: _pose("ego_pose", row)
            for row in self._rows("ego_pose", "token", tokens)
        }
        return Edge("global", "ego_pose.json", False, poses)

    def _rows(self, table: str, key: str = "", wanted: Container[str] = ()) -> Iterator[Table]:
        """Yield a table's rows; with ``key``, those whose value is ``wanted``."""
        file = self._tables / f"{table}.json"
        for i, row in enumerate(json_rows(file)):
            keys = table_at(f"{file}: row {i}", row)
            if not key or keys.text(key) in wanted:
                yield keys


def _pose(table: str, row: Table) -> Pose:
    where = f"{table}.json: {row.text('token')}"
    return pose_of_quaternion(where, row.numbers("translation", 3), row.numbers("rotation", 4))


def json_rows(file: Path) -> Iterator[object]:
    """Yield the entries of a list in a JSON file, one after the other, from its beginning.

    Raises ``DatasetError`` naming the file when it is cut or is no list.
    """
    decoder = json.JSONDecoder()
    try:
        with file.open(encoding="utf-8") as content:
            text = content.read(CHUNK).lstrip()
            if not text.startswith("["):
                raise DatasetError(f"{file}: is no list of rows")
            at = 1
            while True:
                while at < len(text) and text[at] in " \t\r\n,":
                    at += 1
                if text[at : at + 1] == "]":
                    return
                try:
                    row, at = decoder.raw_decode(text, at)
                except (ValueError, RecursionError) as error:
                    more = content.read(CHUNK) if len(text) - at < MAX_ROW else ""
                    if not more:
                        raise DatasetError(f"{file}: is cut or not JSON ({error})") from error
                    text, at = text[at:] + more, 0
                    continue
                yield row
    except OSError as error:
        raise DatasetError(f"{file}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise DatasetError(f"{file}: is no text ({error.reason})") from error
