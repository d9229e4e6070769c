"""The material of experiments: drives, clips of them, and a clip as some codec coded it.

A ``Drive`` is a data set in time order, named with its rate on the command line (``NAME@HZ=
DATASET``, with ``,noise=SIGMA`` for frames of a noisy camera) and read once. A ``Clip`` is what a
codec gets of it, a ``ClipCoder`` a codec under test, and a ``CodedClip`` what it made: bytes,
errors and processor time a frame, and nothing of how.
"""

from __future__ import annotations

import hashlib
import math
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
from rfcore.field import RadianceField
from rfcore.image import I420
from rfcore.native.yuv import i420_from_rgb
from rfcore.views import PosedPicture
from rfedge.arguments import open_field

PEAK = 255.0
STEADY = slice(1, None)
"""Every frame but the first, which a stream sends once and a clip of 24 frames counts too much."""


@dataclass(frozen=True)
class CodedClip:
    """A clip coded at one operating point, a value per frame in time order.

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
    """Notes of the method on each frame, by name: references chosen, bits by kind..."""
    receiver_cpu_ms: float | None = None
    """Processor time of the receiver over the whole clip; None if the method does not tell."""

    def __post_init__(self) -> None:
        shapes = {self.frame_bytes.shape, self.luma_mse.shape, self.ssim.shape}
        if len(shapes) != 1 or self.frame_bytes.ndim != 1 or not len(self.frame_bytes):
            raise InvalidInput("clip", f"shapes {shapes} must be one value per frame")
        if any(len(values) != len(self.frame_bytes) for values in self.notes.values()):
            raise InvalidInput("clip.notes", "must have one value per frame")

    def psnr_db(self, frames: slice = STEADY) -> float:
        """Return the luma PSNR of the mean squared error over ``frames``; inf if that is 0."""
        return psnr_of_mse(float(self.luma_mse[frames].mean()))

    def bytes_per_frame(self, frames: slice = STEADY) -> float:
        """Return the mean size of a frame of ``frames``."""
        return float(self.frame_bytes[frames].mean())


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
        """Everything that the result depends on besides name, point and clip."""

    def code(self, frames: Sequence[I420], rate_hz: float, point: float) -> CodedClip:
        """Code and decode ``frames`` with low delay: no frame may wait for a later one."""


def psnr_of_mse(mse: float) -> float:
    """Return the PSNR in dB of a mean squared error of 8-bit samples; infinite for 0."""
    return 10 * math.log10(PEAK * PEAK / mse) if mse else math.inf


def luma_mse(decoded: I420, frame: I420) -> float:
    """Return the mean squared error of the luma planes."""
    difference = decoded.y.astype(np.float64) - frame.y
    return float(np.mean(difference * difference))


def luma_sse(decoded: I420, frame: I420, where: NDArray[np.bool_]) -> float:
    """Return the sum of squared errors of the luma over the pixels ``where`` is true."""
    difference = (decoded.y.astype(np.float64) - frame.y)[where]
    return float(difference @ difference)


NOISE_SEED = 1
MAX_NOISE_SIGMA = 64.0
"""Levels; nothing of a picture is left."""

DECIMATION = 5
"""Every so-manieth frame stands for a slow camera: 2 Hz of 10."""


@dataclass(frozen=True)
class DriveName:
    """A drive as it is named on the command line: ``NAME@HZ=DATASET[,noise=SIGMA]``.

    ``noise_sigma``: of Gaussian noise on every sample of the frames, in levels; the scene of such a
    drive is named with it.
    """

    scene: str
    rate_hz: float
    dataset: Path
    noise_sigma: float = 0.0

    @staticmethod
    def parse(text: str) -> DriveName:
        """Raise ``InvalidInput`` for text of another form."""
        found = re.fullmatch(r"([\w.-]+)@(\d+(?:\.\d+)?)=(.+?)(?:,noise=([^,]*))?", text)
        if not found or float(found[2]) <= 0:
            raise InvalidInput("drives", f"{text!r} is not NAME@HZ=DATASET, as empty@10=drive.json")
        sigma = 0.0 if found[4] is None else _noise_sigma(found[4])
        scene = f"{found[1]} noise {sigma:g}" if sigma else found[1]
        return DriveName(scene, float(found[2]), Path(found[3]), sigma)


def _noise_sigma(text: str) -> float:
    number = float(text) if re.fullmatch(r"\d+(\.\d+)?", text) else math.nan
    if not number <= MAX_NOISE_SIGMA:
        raise InvalidInput("drives", f"noise={text} is not a number of 0..{MAX_NOISE_SIGMA:g}")
    return number


@dataclass(frozen=True)
class DriveOfField:
    """A drive and the field that it is rendered with:
    ``NAME@HZ=DATASET[,FIELD][,noise=SIGMA]``; ``FIELD`` is an archive (.rff) or MODULE:CLASS."""

    name: DriveName
    field: Path

    @staticmethod
    def parse(text: str, field: Path) -> DriveOfField:
        """Take ``field`` where the text names none; raises as ``DriveName.parse``."""
        found = re.fullmatch(r"(.+),([^,]+\.rff|[\w.]+:\w+)(,noise=[^,]*)?", text)
        if not found:
            return DriveOfField(DriveName.parse(text), field)
        return DriveOfField(DriveName.parse(found[1] + (found[3] or "")), Path(found[2]))

    def read(self, limit: int | None) -> tuple[Drive, RadianceField]:
        """Read the frames and the field."""
        return read_drive(self.name, limit), open_field(self.field)


@dataclass(frozen=True)
class Clip:
    """Frames to code: their rate, the scene's name, their digest, and the field's own quality."""

    scene: str
    rate_hz: float
    frames: Sequence[I420]
    frames_digest: str
    field_psnr_db: float | None


@dataclass(frozen=True)
class Drive:
    """The frames of a drive: as posed pictures, read again when asked for, and as the codec takes
    them, in memory. Noise is in the latter alone."""

    name: DriveName
    pictures: Sequence[PosedPicture]
    frames: Sequence[I420]

    @property
    def cameras(self) -> list[Camera]:
        """The cameras of the frames, the poses rounded as a vehicle sends them."""
        return [picture.camera.rounded() for picture in self.pictures]

    @property
    def digest(self) -> str:
        """The sha256 over the frames' digests."""
        return frames_digest(self.frames)

    def every(self, step: int) -> Drive:
        """Return each ``step``-th frame, at the rate that makes."""
        name = replace(self.name, rate_hz=self.name.rate_hz / step)
        return Drive(name, self.pictures[::step], self.frames[::step])

    def first(self, count: int) -> Drive:
        """Return the first ``count`` frames."""
        return Drive(self.name, self.pictures[:count], self.frames[:count])

    def clip(self, condition: str = "", field_psnr_db: float | None = None) -> Clip:
        """Return what a codec gets, its scene named with the ``condition`` it is coded under."""
        scene = f"{self.name.scene} {condition}".strip()
        return Clip(scene, self.name.rate_hz, self.frames, self.digest, field_psnr_db)


def frames_digest(frames: Sequence[I420]) -> str:
    """Return the sha256 over the frames' digests."""
    return hashlib.sha256(b"".join(frame.digest() for frame in frames)).hexdigest()


def read_drive(name: DriveName | str, limit: int | None = None) -> Drive:
    """Read at most ``limit`` frames of ``NAME@HZ=DATASET``; raises as ``DriveName.parse`` does."""
    if isinstance(name, str):
        name = DriveName.parse(name)
    pictures = read_dataset(name.dataset).pictures[:limit]
    frames = [i420_from_rgb(picture.read()) for picture in pictures]
    return Drive(name, pictures, with_noise(frames, name.noise_sigma))


def with_noise(
    frames: Sequence[I420], sigma: float, seed: int | Sequence[int] = NOISE_SEED
) -> Sequence[I420]:
    """Add Gaussian noise, for a seed always the same, to every sample of the frames; as they are
    for 0."""
    if not sigma:
        return frames
    rng = np.random.default_rng(seed)

    def noisy(plane: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return np.clip(plane + rng.normal(0, sigma, plane.shape), 0, 255).round().astype(np.uint8)

    return [I420(*map(noisy, frame.planes)) for frame in frames]
