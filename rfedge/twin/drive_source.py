"""One field without a server: its splats and, where a drive is given, the camera's own pictures.

The field may be a file that is written again and again, by a training that is looked at.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from rfcore.field import RadianceField, load_field
from rfcore.image import jpeg_bytes
from rfcore.views import PosedPicture
from rfcore.wire.twin import PictureEncoding
from rfedge.twin.scene import DrivePicture, PlacedField, TwinScene

LOOK_EVERY_S = 0.5
TILE = "field"


class FollowedFile:
    """The field archive at ``path``, each time that another takes its place; it may yet be missing.

    ``threads`` render it. An archive is replaced whole (``save_field``), so that none is read that
    is half written.
    """

    def __init__(self, path: Path, threads: int = 1) -> None:
        self._path = path
        self._threads = threads
        self._seen: tuple[int, int] | None = None

    def newer(self) -> RadianceField | None:
        """Return the field of a file that is new; raise ``FieldError`` for one that is none."""
        try:
            status = self._path.stat()
        except FileNotFoundError:
            return None
        seen = (status.st_ino, status.st_mtime_ns)
        if seen == self._seen:
            return None
        self._seen = seen
        return load_field(self._path, threads=self._threads)


class DriveSource:
    """Shows ``field``, or the newest field of a file, and ``pictures`` again and again.

    ``rate_hz``: pictures a second; ``name`` is what the page calls the field.
    """

    def __init__(
        self,
        name: str,
        field: RadianceField | FollowedFile,
        pictures: Sequence[PosedPicture],
        rate_hz: float,
        scene: TwinScene,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._name = name
        self._field = field
        self._pictures = pictures
        self._interval_s = 1.0 / rate_hz
        self._scene = scene
        self._clock = clock
        self._field_id = ""

    @property
    def pictures(self) -> Sequence[PosedPicture]:
        """The drive's pictures."""
        return self._pictures

    @property
    def live(self) -> None:
        """None: a drive shows neither objects nor views."""

    async def run(self) -> None:
        """Show until cancelled; raises ``DatasetError`` for a picture that cannot be read."""
        self._scene.connection("waiting", f"{self._name} is being read", self._clock())
        await asyncio.gather(self._show_fields(), self._show_pictures())
        await asyncio.Event().wait()  # one field without pictures is shown for good

    async def _show_fields(self) -> None:
        if not isinstance(self._field, FollowedFile):
            await self._show_field(self._field, self._name)
            return
        count = 0
        while True:
            field = await asyncio.to_thread(self._field.newer)
            if field is not None:
                count += 1
                said = self._name if count == 1 else f"{self._name}, version {count}"
                await self._show_field(field, said)
            await asyncio.sleep(LOOK_EVERY_S)

    async def _show_field(self, field: RadianceField, said: str) -> None:
        placed = await asyncio.to_thread(PlacedField.of, field, TILE)
        self._field_id = field.field_id
        self._scene.place(placed, self._clock())
        self._scene.connection("offline", said, self._clock())

    async def _show_pictures(self) -> None:
        if not self._pictures:
            return
        due_s, sequence = self._clock(), 0
        while True:
            picture = self._pictures[sequence % len(self._pictures)]
            shown = await asyncio.to_thread(self._picture, picture, sequence)
            self._scene.show(shown, self._clock())
            sequence, due_s = sequence + 1, max(due_s + self._interval_s, self._clock())
            await asyncio.sleep(due_s - self._clock())

    def _picture(self, picture: PosedPicture, sequence: int) -> DrivePicture:
        return DrivePicture(
            vehicle_id="drive",
            camera_id="camera",
            session_id="",
            epoch=0,
            sequence=sequence,
            capture_time_ns=0,
            age_ns=0,
            pose=picture.camera.world_from_cam,
            intrinsics=picture.camera.intrinsics,
            field_id=self._field_id,
            reconstruction_digest=b"",
            encoding=PictureEncoding.JPEG,
            picture=jpeg_bytes(picture.read()),
            file=picture.name,
        )
