"""Drives as evaluations take them: named with a rate on the command line, read once, digested."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rfcore.camera import Camera
from rfcore.dataset import read_dataset
from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.native.yuv import i420_from_rgb
from rfcore.views import PosedPicture

__all__ = ["DECIMATION", "DriveFrames", "DriveName", "read_drive"]

DECIMATION = 5
"""Of the frames of a drive that stands for a slow camera: 10 Hz to 2."""


@dataclass(frozen=True)
class DriveName:
    """A drive as it is named on the command line: ``NAME@HZ=DATASET``."""

    scene: str
    rate_hz: float
    dataset: Path

    @staticmethod
    def parse(text: str) -> DriveName:
        """Raise ``InvalidInput`` for text of another form."""
        found = re.fullmatch(r"([\w.-]+)@(\d+(?:\.\d+)?)=(.+)", text)
        if not found or float(found[2]) <= 0:
            raise InvalidInput("drives", f"{text!r} is not NAME@HZ=DATASET, as empty@10=drive.json")
        return DriveName(found[1], float(found[2]), Path(found[3]))


@dataclass(frozen=True)
class DriveFrames:
    """The pictures of a drive, as posed pictures and as the codec takes them."""

    name: DriveName
    pictures: Sequence[PosedPicture]
    frames: Sequence[I420]

    @property
    def cameras(self) -> list[Camera]:
        """Where the frames were taken."""
        return [picture.camera for picture in self.pictures]

    @property
    def digest(self) -> str:
        """The sha256 over the frames' digests."""
        return hashlib.sha256(b"".join(frame.digest() for frame in self.frames)).hexdigest()

    def every(self, step: int) -> DriveFrames:
        """Return each ``step``-th frame, at the rate that makes."""
        name = replace(self.name, rate_hz=self.name.rate_hz / step)
        return DriveFrames(name, self.pictures[::step], self.frames[::step])


def read_drive(text: str, limit: int | None = None) -> DriveFrames:
    """Read at most ``limit`` frames of ``NAME@HZ=DATASET``; raises as ``DriveName.parse`` does."""
    name = DriveName.parse(text)
    pictures = read_dataset(name.dataset).pictures[:limit]
    return DriveFrames(name, pictures, [i420_from_rgb(picture.read()) for picture in pictures])
