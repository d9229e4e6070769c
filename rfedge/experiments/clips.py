"""A clip as somebody coded it: bytes, pictures and processor time, and nothing of how.

Drives as evaluations take them: named with a rate on the command line, read once, digested.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera
from rfcore.dataset import read_dataset
from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.native.yuv import i420_from_rgb
from rfcore.views import PosedPicture

__all__ = [
    "DECIMATION",
    "ClipCoder",
    "CodedClip",
    "DriveFrames",
    "DriveName",
    "luma_mse",
    "luma_sse",
    "read_drive",
]


@dataclass(frozen=True)
class CodedClip:
    """What coding a clip at one operating point gave, a value per frame in time order.

    ``frame_bytes`` int64 [N], all that would have to be sent for the frame; ``luma_mse`` float64
    [N], of the decoded luma against the camera's on the true size; ``ssim`` float64 [N], likewise;
    ``cpu_ms`` float64, processor time of the sender over the whole clip, of all its threads.
    """

    point: float
    frame_bytes: NDArray[np.int64]
    luma_mse: NDArray[np.float64]
    ssim: NDArray[np.float64]
    cpu_ms: float
    notes: Mapping[str, tuple[float | str, ...]] = field(default_factory=dict)
    """What the method wants to tell of each frame, by name: modes chosen, bits by kind..."""

    def __post_init__(self) -> None:
        shapes = {self.frame_bytes.shape, self.luma_mse.shape, self.ssim.shape}
        if len(shapes) != 1 or self.frame_bytes.ndim != 1 or not len(self.frame_bytes):
            raise InvalidInput("clip", f"shapes {shapes} must be one value per frame")
        if any(len(values) != len(self.frame_bytes) for values in self.notes.values()):
            raise InvalidInput("clip.notes", "must have one value per frame")


class ClipCoder(Protocol):
    """A codec under test. ``--method package:Class`` names one; it is called without arguments.

    ``name`` labels it in tables. ``points`` are its operating points (CRF, QP or whatever it
    takes), ordered from best to worst quality, and must span the quality window asked about.
    ``version`` names the program behind it: finished pieces of another version are done anew.
    """

    @property
    def name(self) -> str:
        """The label, with every setting that changes the result."""

    @property
    def points(self) -> Sequence[float]:
        """The operating points."""

    @property
    def version(self) -> str:
        """What the result depends on besides name, point and clip."""

    def code(self, frames: Sequence[I420], rate_hz: float, point: float) -> CodedClip:
        """Code and decode ``frames`` with low delay: no frame may wait for a later one."""


def luma_mse(decoded: I420, frame: I420) -> float:
    """Return the mean squared error of the luma planes."""
    difference = decoded.y.astype(np.float64) - frame.y
    return float(np.mean(difference * difference))


def luma_sse(decoded: I420, frame: I420, where: NDArray[np.bool_]) -> float:
    """Return the sum of squared errors of the luma over the pixels ``where`` is true."""
    difference = (decoded.y.astype(np.float64) - frame.y)[where]
    return float(difference @ difference)


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
