"""Recordings that a server made of one camera: a folder of pictures and ``recording.jsonl``.

The first line says what is recorded, each further one is a picture that was reconstructed, written
once its file is whole; a last line without an end is one that is being written, and is left out::

    {"recording": 1, "vehicle": "cav-1", "camera": "front", "session": "3f0c...",
     "width_px": 640, "height_px": 360, "fx_px": 455.1, ..., "cx_px": 320.0, "cy_px": 180.0}
    {"file": "000000.png", "capture_time_ns": 1767225600000000000, "epoch": 0, "sequence": 0,
     "field_id": "9b1c...", "translation_m": [3.1, 0.0, 1.5], "rotation_wxyz": [1, 0, 0, 0],
     "digest": "77aa..."}

Poses are world_from_cam with OpenCV camera axes in the world of the fields, their tiles' origins
added in float64; a camera that was lost has ``null`` for both, and its picture is left out of the
dataset. ``digest`` is XXH3-128 of the reconstructed picture (``I420.digest``). Times never go back
within a file.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rfcore.camera import Intrinsics, Pose
from rfcore.dataset.keys import blamed_on, read_file, table_at
from rfcore.dataset.picture_file import PictureFile
from rfcore.dataset.picture_name import find_picture
from rfcore.dataset.source import Source, SourceCamera, SourcePicture
from rfcore.errors import DatasetError
from rfcore.tables import Range, Table

RECORDING_NAME = "recording.jsonl"
VERSION = 1
DEPTH = 3
"""Vehicle, camera and part: how far below a server's folder its recordings lie."""


@dataclass(frozen=True)
class RecordedCamera:
    """The camera whose pictures a recording holds: the first line of its file."""

    vehicle_id: str
    camera_id: str
    session_id: str
    intrinsics: Intrinsics

    def line(self) -> str:
        """Return the line of JSON, with its end."""
        names = {
            "vehicle": self.vehicle_id,
            "camera": self.camera_id,
            "session": self.session_id,
        }
        return _json_line({"recording": VERSION, **names, **asdict(self.intrinsics)})


@dataclass(frozen=True)
class RecordedPicture:
    """A picture of a recording: one line of its file.

    ``world_from_cam`` is None where the camera was lost.
    """

    file: str
    capture_time_ns: int
    epoch: int
    sequence: int
    field_id: str
    world_from_cam: Pose | None
    digest: str

    def line(self) -> str:
        """Return the line of JSON, with its end."""
        values = asdict(self)
        del values["world_from_cam"]
        pose = self.world_from_cam
        values["translation_m"] = None if pose is None else pose.translation_m
        values["rotation_wxyz"] = None if pose is None else pose.rotation
        return _json_line(values)


@dataclass(frozen=True)
class RecordedPart:
    """One recording file: its camera, and its pictures in order of time."""

    file: Path
    camera: RecordedCamera
    pictures: tuple[RecordedPicture, ...]

    def path(self, picture: RecordedPicture) -> Path:
        """Return where a picture's file is; raise ``DatasetError`` for one that is missing."""
        return find_picture(str(self.file), self.file.parent, picture.file)

    def source_pictures(self) -> Iterator[SourcePicture]:
        """Yield the pictures that have a pose, as a dataset's; check the size of each."""
        camera = SourceCamera(self.camera.intrinsics)
        prefix = f"{self.camera.vehicle_id}/{self.camera.camera_id}/{self.file.parent.name}"
        for picture in self.pictures:
            if picture.world_from_cam is not None:
                opened = PictureFile.of(self.path(picture), camera.intrinsics)
                yield SourcePicture(
                    where=f"{self.file}: {picture.file}",
                    name=f"{prefix}/{picture.file}",
                    camera=camera,
                    world_from_cam=picture.world_from_cam,
                    read=opened.read,
                    time_ns=picture.capture_time_ns,
                )


def read_recorded_part(file: Path) -> RecordedPart:
    """Read one ``recording.jsonl``. Raises ``DatasetError`` naming the line and the key."""
    head, *lines = _tables(file)
    pictures = tuple(_picture(f"{file}: line {n}", line) for n, line in enumerate(lines, 2))
    return RecordedPart(file, _camera(file, head), pictures)


def read_recorded_source(*files: Path) -> Source:
    """Read recordings as one dataset in order of time; raises as ``read_recorded_part``."""
    parts = [read_recorded_part(file) for file in files]
    posed = [picture for part in parts for picture in part.source_pictures()]
    posed.sort(key=lambda picture: picture.time_ns or 0)
    lost = sum(len(part.pictures) for part in parts) - len(posed)
    return Source(files[0], tuple(posed), None, lost)


def recordings_under(folder: Path) -> Sequence[Path]:
    """Return the recordings in and below a folder that a server records to, by name."""
    steps = ("*/" * depth for depth in range(DEPTH + 1))
    return sorted(path for step in steps for path in folder.glob(step + RECORDING_NAME))


def _tables(file: Path) -> list[Table]:
    *whole, _ = read_file(file).split(b"\n")
    if not whole:
        raise DatasetError(f"{file}: has no first line that says what is recorded")
    return [_table(f"{file}: line {number}", line) for number, line in enumerate(whole, 1)]


def _table(where: str, line: bytes) -> Table:
    try:
        return table_at(where, json.loads(line))
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{where}: not JSON ({error})") from error


def _camera(file: Path, head: Table) -> RecordedCamera:
    version = head.whole("recording")
    if version != VERSION:
        raise head.error("recording", f"is version {version}; this release reads {VERSION}")
    width_px, height_px = head.whole("width_px"), head.whole("height_px")
    numbers = [head.number(key) for key in ("fx_px", "fy_px", "cx_px", "cy_px")]
    with blamed_on(f"{file}: line 1"):
        intrinsics = Intrinsics(width_px, height_px, *numbers)
    return RecordedCamera(
        head.text("vehicle"), head.text("camera"), head.text("session"), intrinsics
    )


def _picture(where: str, line: Table) -> RecordedPicture:
    return RecordedPicture(
        file=line.text("file"),
        capture_time_ns=line.whole("capture_time_ns", Range(0)),
        epoch=line.whole("epoch", Range(0)),
        sequence=line.whole("sequence", Range(0)),
        field_id=line.text("field_id"),
        world_from_cam=_pose(where, line),
        digest=line.text("digest"),
    )


def _pose(where: str, line: Table) -> Pose | None:
    if line.value("translation_m") is None:
        return None
    x, y, z = line.numbers("translation_m", 3)
    w, i, j, k = line.numbers("rotation_wxyz", 4)
    with blamed_on(where):
        return Pose((x, y, z), (w, i, j, k))  # as it was sent: to normalise it would change it


def _json_line(values: dict[str, Any]) -> str:
    return json.dumps(values, allow_nan=False) + "\n"
