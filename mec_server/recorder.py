"""Records pictures of vehicles that agreed to it, as datasets:
FOLDER/<vehicle>/<camera>/<start>-<session>/.

Each such part is a ``recording.jsonl`` and its pictures (``rfcore.dataset.recorded_session``). The
first epoch's pictures are named by their sequence alone (000007.png); later ones have the epoch in
front (e0003-000007.png), since sequences begin again. A disk that is too slow loses pictures of the
recording, which are counted; an error of the disk ends the recording for good. Neither touches the
streaming.

Parts are deleted by age, and where there are too many bytes: then the tile that has most loses the
oldest part of a vehicle that has more than a quarter of the tile's bytes, or else its oldest part.
So one busy vehicle or tile evicts no other. ``start`` is when a part was begun, milliseconds of the
Unix epoch; a step of the clock while the server runs changes no age. A part is closed early enough
that whole parts can be deleted to keep both bounds; a part that is still written is deleted, too,
when it must be.
"""

from __future__ import annotations

import queue
import shutil
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from mec_server.config import RecordSettings
from rfcore.camera import Pose, TileOrigin
from rfcore.dataset.recorded_session import (
    RECORDING_NAME,
    RecordedCamera,
    RecordedPicture,
    read_recorded_part,
)
from rfcore.errors import DatasetError
from rfcore.files import write_whole
from rfcore.image import I420, png_bytes
from rfcore.native.yuv import rgb_from_i420
from rfcore.wire.messages import Frame, Hello

MAX_WAITING = 32
"""Pictures that may wait for the disk; those beyond are not recorded."""
TIDY_EVERY_S = 60.0
"""Period of checks for old parts while nothing is written."""
PARTS = 16
"""Parts are closed at this fraction of either bound, so that at least so many fill it."""
VEHICLE_SHARE = 0.25
"""Share of a tile's bytes; a vehicle with more loses its own pictures first."""


@dataclass(frozen=True)
class KeepLimits:
    """Limits of a recording: bytes of all files, and seconds since a picture was written."""

    max_bytes: int
    max_age_s: float


@dataclass(frozen=True)
class FieldTiles:
    """Functions that return the origin and the name of the tile of a field, by the field's id."""

    origin_of: Callable[[str], TileOrigin]
    """Raises ``UnknownField`` for a field that is not held."""
    name_of: Callable[[str], str]
    """Empty for a field of no published tile."""


def open_recorder(
    settings: RecordSettings,
    tiles: FieldTiles,
    failed: Callable[[Exception], None],
    dropped: Callable[[], None],
) -> Recorder | None:
    """Return the recorder that ``settings`` ask for, if they do; see ``Recorder``."""
    if settings.folder is None:
        return None
    limits = KeepLimits(round(settings.max_gb * 1e9), settings.max_age_h * 3600)
    offset_ns = time.time_ns() - time.monotonic_ns()

    def now_ms() -> int:
        return (offset_ns + time.monotonic_ns()) // 1_000_000

    return Recorder(settings.folder, limits, tiles, now_ms, failed, dropped)


class RecordingQuota:
    """Counts the bytes of every part under ``root``, also those of earlier runs, and deletes.

    Used by one thread. What is in the folder and no part is neither counted nor deleted.
    ``tile_of`` names the tile of a field: that of a part's first picture is the part's.
    """

    def __init__(self, root: Path, limits: KeepLimits, tile_of: Callable[[str], str]) -> None:
        self._root = root
        self._limits = limits
        self._tile_of = tile_of
        self._begun_ms = 0
        self._bytes: dict[Path, int] = {part: _bytes_of(part) for part in _parts(root)}
        self._tiles = {part: tile_of(_field_of(part)) for part in self._bytes}

    def begin(self, camera: RecordedCamera, field_id: str, now_ms: int) -> Path:
        """Make the folder of a new part; no two of this run have the same start."""
        self._begun_ms = max(now_ms, self._begun_ms + 1)
        name = f"{self._begun_ms:013}-{camera.session_id}"
        part = self._root / camera.vehicle_id / camera.camera_id / name
        part.mkdir(parents=True)
        self._bytes[part] = 0
        self._tiles[part] = self._tile_of(field_id)
        return part

    def is_full(self, part: Path, now_ms: int) -> bool:
        """Tell whether a part has its share of the bytes or of the time, or was deleted, maybe by
        somebody else."""
        size_bytes = self._bytes.get(part)
        if size_bytes is None or size_bytes >= self._limits.max_bytes / PARTS:
            return True
        if not part.is_dir():
            self._forget(part)
            return True
        return now_ms - _start_ms(part) >= 1e3 * self._limits.max_age_s / PARTS

    def make(self, wanted_bytes: int, now_ms: int) -> None:
        """Delete parts that are too old, then those of the largest share, until the bytes fit.

        Raises ``OSError`` where one cannot be deleted.
        """
        oldest_ms = now_ms - 1e3 * self._limits.max_age_s
        for part in [part for part in self._bytes if _start_ms(part) <= oldest_ms]:
            self._delete(part)
        while self._bytes and sum(self._bytes.values()) + wanted_bytes > self._limits.max_bytes:
            self._delete(self._most_dispensable())

    def _most_dispensable(self) -> Path:
        """Return the oldest part of the tile with most bytes, or of a vehicle that has too many of
        them."""
        tile, _ = _largest(self._bytes, self._tiles.__getitem__)
        parts = {part: n for part, n in self._bytes.items() if self._tiles[part] == tile}
        vehicle, size_bytes = _largest(parts, _vehicle_of)
        if size_bytes > VEHICLE_SHARE * sum(parts.values()):
            parts = {part: n for part, n in parts.items() if _vehicle_of(part) == vehicle}
        return min(parts, key=_start_ms)

    def _delete(self, part: Path) -> None:
        if part.is_dir():
            shutil.rmtree(part)
        self._forget(part)

    def _forget(self, part: Path) -> None:
        """Count a part no more that was deleted, and remove its vehicle's folders if empty."""
        del self._bytes[part], self._tiles[part]
        for folder in (part.parent, part.parent.parent):
            if folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()

    def add(self, part: Path, written_bytes: int) -> None:
        """Count the bytes written to a part."""
        self._bytes[part] += written_bytes


@dataclass(frozen=True)
class QueuedPicture:
    """One picture to keep; ``world_from_cam`` is None where the camera was lost."""

    camera: RecordedCamera
    frame: Frame
    field_id: str
    world_from_cam: Pose | None
    picture: I420


@dataclass(frozen=True)
class OpenPart:
    """A part that is written, and the capture time of its last picture."""

    folder: Path
    last_ns: int


class Recorder:
    """Writes pictures on a thread of its own; ``on_failure`` is called with the first error, and
    ``on_dropped`` for each picture that the disk was too slow for.

    ``now_ms``: the time of the Unix epoch.
    """

    def __init__(
        self,
        root: Path,
        limits: KeepLimits,
        tiles: FieldTiles,
        now_ms: Callable[[], int],
        on_failure: Callable[[Exception], None],
        on_dropped: Callable[[], None],
    ) -> None:
        self._root = root
        self._limits = limits
        self._tiles = tiles
        self._now_ms = now_ms
        self._on_failure = on_failure
        self._on_dropped = on_dropped
        self._failed = False
        self._room: RecordingQuota | None = None
        self._open: dict[RecordedCamera, OpenPart] = {}
        self._queue: queue.Queue[QueuedPicture | None] = queue.Queue(MAX_WAITING)
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def session(self, session_id: str, hello: Hello) -> SessionRecording | None:
        """Return what records a vehicle's session; None for a vehicle that did not agree to it.

        Raises what ``tiles.origin_of`` raises for a field.
        """
        if not hello.allow_recording:
            return None
        origins = {field_id: self._tiles.origin_of(field_id) for field_id in hello.field_ids}
        return SessionRecording(session_id, hello, origins, self._put)

    def close(self) -> None:
        """Write the queued pictures, then stop."""
        self._queue.put(None)
        self._thread.join()

    def _put(self, waiting: QueuedPicture) -> None:
        if self._failed:
            return
        try:
            self._queue.put_nowait(waiting)
        except queue.Full:
            self._on_dropped()

    def _run(self) -> None:
        while True:
            try:
                waiting = self._queue.get(timeout=TIDY_EVERY_S)
            except queue.Empty:
                self._attempt(lambda room: room.make(0, self._now_ms()))
                continue
            if waiting is None:
                return
            self._attempt(lambda room, one=waiting: self._write(room, one))  # type: ignore[misc]

    def _attempt(self, work: Callable[[RecordingQuota], object]) -> None:
        if self._failed:
            return
        try:
            if self._room is None:
                self._room = RecordingQuota(self._root, self._limits, self._tiles.name_of)
            work(self._room)
        except Exception as error:
            self._failed = True
            self._on_failure(error)

    def _write(self, room: RecordingQuota, waiting: QueuedPicture) -> None:
        png = png_bytes(rgb_from_i420(waiting.picture))
        line = _line(waiting)
        room.make(len(png) + len(line), self._now_ms())
        part = self._part(room, waiting)
        write_whole(part / picture_name(waiting.frame), png)
        with (part / RECORDING_NAME).open("a") as file:
            file.write(line)
        room.add(part, len(png) + len(line))
        self._open[waiting.camera] = OpenPart(part, waiting.frame.capture_time_ns)

    def _part(self, room: RecordingQuota, waiting: QueuedPicture) -> Path:
        """Return the folder to write to: a new one where the last is full or time went back."""
        camera, now_ms = waiting.camera, self._now_ms()
        part = self._open.get(camera)
        if (
            part is not None
            and part.last_ns <= waiting.frame.capture_time_ns
            and not room.is_full(part.folder, now_ms)
        ):
            return part.folder
        self._open = {
            other: part
            for other, part in self._open.items()
            if not room.is_full(part.folder, now_ms)
        }
        folder = room.begin(camera, waiting.field_id, now_ms)
        write_whole(folder / RECORDING_NAME, camera.line())
        room.add(folder, len(camera.line()))
        return folder


class SessionRecording:
    """Records the pictures of one session; used by the server's workers."""

    def __init__(
        self,
        session_id: str,
        hello: Hello,
        origins: Mapping[str, TileOrigin],
        put: Callable[[QueuedPicture], None],
    ) -> None:
        self._cameras = {
            camera.camera_id: RecordedCamera(
                hello.vehicle_id, camera.camera_id, session_id, camera.intrinsics
            )
            for camera in hello.cameras
        }
        self._origins = origins
        self._put = put

    def save(self, frame: Frame, field_id: str, picture: I420) -> None:
        """Queue a picture; it is not recorded if ``MAX_WAITING`` others wait for the disk."""
        pose = frame.pose
        world_from_cam = None if pose is None else self._origins[field_id].globalise(pose)
        self._put(
            QueuedPicture(self._cameras[frame.camera_id], frame, field_id, world_from_cam, picture)
        )


def picture_name(frame: Frame) -> str:
    """Return the file name of a reconstructed frame."""
    epoch, sequence = frame.packet.epoch, frame.packet.sequence
    return f"{sequence:06}.png" if epoch == 0 else f"e{epoch:04}-{sequence:06}.png"


def _line(waiting: QueuedPicture) -> str:
    frame = waiting.frame
    return RecordedPicture(
        file=picture_name(frame),
        capture_time_ns=frame.capture_time_ns,
        epoch=frame.packet.epoch,
        sequence=frame.packet.sequence,
        field_id=waiting.field_id,
        world_from_cam=waiting.world_from_cam,
        digest=waiting.picture.digest().hex(),
    ).line()


def _parts(root: Path) -> list[Path]:
    return [path for path in root.glob("*/*/*-*") if path.is_dir() and _is_start(path)]


def _is_start(part: Path) -> bool:
    start = part.name.partition("-")[0]
    return len(start) >= 13 and start.isascii() and start.isdigit()


def _start_ms(part: Path) -> int:
    return int(part.name.partition("-")[0])


def _vehicle_of(part: Path) -> str:
    return part.parent.parent.name


def _field_of(part: Path) -> str:
    """Return the field of a part's first picture; empty for one that has none or is damaged."""
    try:
        pictures = read_recorded_part(part / RECORDING_NAME).pictures
    except DatasetError:
        return ""
    return pictures[0].field_id if pictures else ""


def _largest(bytes_of: Mapping[Path, int], share_of: Callable[[Path], str]) -> tuple[str, int]:
    """Return the share that has most bytes, and how many."""
    totals: dict[str, int] = {}
    for part, size_bytes in bytes_of.items():
        totals[share_of(part)] = totals.get(share_of(part), 0) + size_bytes
    return max(totals.items(), key=lambda total: total[1])


def _bytes_of(part: Path) -> int:
    return sum(path.stat().st_size for path in part.iterdir() if path.is_file())
