"""Writes reconstructed pictures to disk: DIR/<vehicle>/<camera>/<sequence>.png and index.jsonl.

The first epoch's pictures are named by their sequence alone (000007.png); later ones have the
epoch in front (e0003-000007.png), since sequences begin again. The index has one line per picture.
A disk that fails ends the recording for good, and never the streaming.
"""

from __future__ import annotations

import json
import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rfcore.image import I420, write_png
from rfcore.native.yuv import rgb_from_i420
from rfcore.wire.messages import Frame

__all__ = ["Recorder", "Recording", "picture_name"]

MAX_WAITING = 32
"""Pictures that may wait for the disk; beyond it decoding waits, and with it the vehicle."""


@dataclass(frozen=True)
class Recording:
    """One picture to keep."""

    vehicle_id: str
    frame: Frame
    picture: I420


class Recorder:
    """Writes pictures on a thread of its own; ``on_failure`` is called with the first error.

    After any error the thread goes on emptying its queue, so that no worker waits for it for ever.
    """

    def __init__(self, directory: Path, on_failure: Callable[[Exception], None]) -> None:
        self._directory = directory
        self._on_failure = on_failure
        self._failed = False
        self._queue: queue.Queue[Recording | None] = queue.Queue(MAX_WAITING)
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def save(self, recording: Recording) -> None:
        """Queue a picture; returns at once unless ``MAX_WAITING`` pictures wait for the disk."""
        if not self._failed:
            self._queue.put(recording)

    def close(self) -> None:
        """Write what is queued, then stop."""
        self._queue.put(None)
        self._thread.join()

    def _run(self) -> None:
        while (recording := self._queue.get()) is not None:
            if self._failed:
                continue
            try:
                self._write(recording)
            except Exception as error:
                self._failed = True
                self._on_failure(error)

    def _write(self, recording: Recording) -> None:
        frame = recording.frame
        folder = self._directory / recording.vehicle_id / frame.camera_id
        folder.mkdir(parents=True, exist_ok=True)
        name = picture_name(frame)
        write_png(folder / name, rgb_from_i420(recording.picture))
        line = {
            "file": name,
            "epoch": frame.packet.epoch,
            "sequence": frame.packet.sequence,
            "capture_time_ns": frame.capture_time_ns,
            "translation_m": frame.pose.translation_m,
            "rotation_wxyz": frame.pose.rotation,
            "digest": recording.picture.digest().hex(),
        }
        with (folder / "index.jsonl").open("a") as index:
            index.write(json.dumps(line) + "\n")


def picture_name(frame: Frame) -> str:
    """Return the file name of a reconstructed frame."""
    epoch, sequence = frame.packet.epoch, frame.packet.sequence
    return f"{sequence:06}.png" if epoch == 0 else f"e{epoch:04}-{sequence:06}.png"
