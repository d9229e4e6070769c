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
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera
from rfcore.errors import InvalidInput
from rfcore.field import RadianceField
from rfcore.image import I420
from rfcore.metrics import psnr_of_mse
from rfcore.native.yuv import i420_from_rgb
from rfcore.views import PosedPicture
from rfedge.arguments import open_drive, open_field

PEAK = 255.0
STEADY = slice(1, None)
"""Every frame but the first, which a stream sends once and a clip of 24 frames counts too much."""


Notes = tuple[float | str, ...]
"""A value per frame."""


@dataclass(frozen=True)
class CodedClip:
    """A clip coded at one operating point, a value per frame in time order.

    ``frame_bytes`` int64 [N], all that would have to be sent for the frame; ``luma_mse`` float64
    [N], of the decoded luma against the camera's on the true size; ``ssim`` float64 [N], likewise;
    ``cpu_ms`` and ``receiver_cpu_ms``, processor time over the whole clip, of all threads, of the
    sender (what it does before a frame is sent) and of the receiver (until a picture is there).
    Their sum is what tables call the time of both ends.
    """

    point: float
    frame_bytes: NDArray[np.int64]
    luma_mse: NDArray[np.float64]
    ssim: NDArray[np.float64]
    cpu_ms: float
    notes: Mapping[str, Notes] = field(default_factory=dict)
    """Notes of the method on each frame, by name: references chosen, bits by kind..."""
    receiver_cpu_ms: float | None = None
    """None: not measured, and the time of both ends is the sender's alone. A codec of ``--method``
    has to give it."""

    def __post_init__(self) -> None:
        shapes = {self.frame_bytes.shape, self.luma_mse.shape, self.ssim.shape}
        if len(shapes) != 1 or self.frame_bytes.ndim != 1 or not len(self.frame_bytes):
            raise InvalidInput("clip", f"shapes {shapes} must be one value per frame")
        if any(len(values) != len(self.frame_bytes) for values in self.notes.values()):
            raise InvalidInput("clip.notes", "must have one value per frame")

    def psnr_db(self, frames: slice = STEADY) -> float:
        """Return the luma PSNR of the mean squared error over ``frames``; inf if that is 0."""
        return psnr_of_mse(float(self.luma_mse[frames].mean()))

    def values(self, quality: str) -> NDArray[np.float64]:
        """Return a quality of each frame by its name: ``ssim``, or one of the notes."""
        return self.ssim if quality == "ssim" else np.array(self.notes[quality], np.float64)

    def bytes_per_frame(self, frames: slice = STEADY) -> float:
        """Return the mean size of a frame of ``frames``."""
        return float(self.frame_bytes[frames].mean())

    def of_frames(self, chosen: Sequence[int]) -> CodedClip:
        """Return the clip with the frames ``chosen`` alone; processor time is that of all."""
        notes = {name: tuple(each[k] for k in chosen) for name, each in self.notes.items()}
        at = list(chosen)
        arrays = (self.frame_bytes[at], self.luma_mse[at], self.ssim[at])
        return CodedClip(self.point, *arrays, self.cpu_ms, notes, self.receiver_cpu_ms)


class ClipCoder(Protocol):
    """A codec under test. ``--method package:Class`` names one; it is called without arguments.

    ``name`` labels it in tables. ``points`` are its operating points (CRF, QP or whatever it
    takes), ordered from best to worst quality, and must span the quality window asked about.
    ``version`` names the program behind it: finished pieces of another version are done anew, as
    are those of a ``--method`` whose module's file was edited.
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


@runtime_checkable
class BoundCoder(Protocol):
    """A ``ClipCoder`` that is made for the frames of one clip, as ours is for their poses."""

    def of_run(self, run: slice) -> ClipCoder:
        """Return the coder of the frames ``run`` alone."""


def luma_mse(decoded: I420, frame: I420) -> float:
    """Return the mean squared error of the luma planes."""
    difference = decoded.y.astype(np.float64) - frame.y
    return float(np.mean(difference * difference))


def luma_sse(decoded: I420, frame: I420, where: NDArray[np.bool_]) -> float:
    """Return the sum of squared errors of the luma over the pixels ``where`` is true."""
    difference = (decoded.y.astype(np.float64) - frame.y)[where]
    return float(difference @ difference)


@dataclass(frozen=True)
class Runs:
    """``count`` runs of ``frames`` consecutive frames, spread evenly over a drive.

    A codec predicts each frame from the one before, so single frames would not do. Of each run the
    ``settling`` first frames do not count: an encoder spends more on its key frame than it must,
    and the next frames profit. One run alone is in the middle of the drive.
    """

    count: int
    frames: int
    settling: int = 1

    def chosen(self, length: int) -> list[int]:
        """Return the numbers of their frames in a drive of ``length`` frames: all, if it has no
        more than they."""
        if length <= self.count * self.frames:
            return list(range(length))
        last = length - self.frames
        shares = [k / (self.count - 1) for k in range(self.count)] if self.count > 1 else [0.5]
        return [round(last * share) + k for share in shares for k in range(self.frames)]

    def in_drive(self, length: int) -> RunsOfDrive | None:
        """Return them in a drive of ``length`` frames; None if they are all of it."""
        return RunsOfDrive(self, length) if length > self.count * self.frames else None


@dataclass(frozen=True)
class RunsOfDrive:
    """Runs, and the length of the drive that they were taken from."""

    runs: Runs
    drive_frames: int


QUICK = Runs(5, 8, 4)
"""Part of a drive that ``--quick`` codes.

On KITTI's loop, -35.5 % as a whole, such runs are 3 points off, 8 if all frames but the first of
each counted, and the first eight frames of the drive 26.
"""
ONE_RUN = Runs(1, 6)
"""The same where time goes on from frame to frame, as over a link."""

NOISE_SEED = 1
MAX_NOISE_SIGMA = 64.0
"""Levels; nothing of a picture is left."""

DECIMATION = 5
"""Every fifth frame stands for a slow camera: 2 Hz of 10."""


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

    def read(self, limit: int | Runs | None) -> tuple[Drive, RadianceField]:
        """Read the frames and the field."""
        field = open_field(self.field)
        return read_drive(self.name, limit, (field, self.field)), field


@dataclass(frozen=True)
class Clip:
    """Frames to code: their rate, the scene's name, their digest, and the field's own quality.

    ``part``: the frames are runs, each coded on its own, of a longer drive; None: a whole drive.
    """

    scene: str
    rate_hz: float
    frames: Sequence[I420]
    frames_digest: str
    field_psnr_db: float | None
    part: RunsOfDrive | None = None

    @property
    def drive_frames(self) -> int:
        """Length of the drive."""
        return len(self.frames) if self.part is None else self.part.drive_frames

    @property
    def runs(self) -> list[slice]:
        """The frames of each run."""
        count = len(self.frames)
        step = count if self.part is None else self.part.runs.frames
        return [slice(first, first + step) for first in range(0, count, step)]

    @property
    def coded(self) -> list[int]:
        """The frames that a coded clip has: the first, and all others that count."""
        every = range(len(self.frames))
        if self.part is None:
            return list(every)
        runs = self.part.runs
        return [k for k in every if not k or k % runs.frames >= runs.settling]


@dataclass(frozen=True)
class Drive:
    """The frames of a drive: as posed pictures, read again when asked for, and as the codec takes
    them, in memory. Noise is in the latter alone. ``part`` is that of its ``Clip``."""

    name: DriveName
    pictures: Sequence[PosedPicture]
    frames: Sequence[I420]
    part: RunsOfDrive | None = None

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

    def spread(self, runs: Runs) -> Drive:
        """Return ``runs`` of the drive alone."""
        length = len(self.frames)
        chosen = runs.chosen(length)
        pictures, frames = [self.pictures[k] for k in chosen], [self.frames[k] for k in chosen]
        return Drive(self.name, pictures, frames, runs.in_drive(length))

    def clip(self, condition: str = "", field_psnr_db: float | None = None) -> Clip:
        """Return what a codec gets, its scene named with the ``condition`` it is coded under."""
        scene = f"{self.name.scene} {condition}".strip()
        hz, digest = self.name.rate_hz, self.digest
        return Clip(scene, hz, self.frames, digest, field_psnr_db, self.part)


def frames_digest(frames: Sequence[I420]) -> str:
    """Return SHA-256 over BLAKE2b-128 of each frame: its size as text, then its planes."""
    total = hashlib.sha256()
    for frame in frames:
        one = hashlib.blake2b(f"{frame.size_px}".encode(), digest_size=16)
        one.update(frame.packed())
        total.update(one.digest())
    return total.hexdigest()


def read_drive(
    name: DriveName | str,
    limit: int | Runs | None = None,
    field: tuple[RadianceField, Path] | None = None,
) -> Drive:
    """Read at most the first ``limit`` frames, or runs, of ``NAME@HZ=DATASET``; raises as
    ``DriveName.parse`` does, and as ``open_drive`` for a ``field`` of another place."""
    if isinstance(name, str):
        name = DriveName.parse(name)
    known = () if field is None else (field[0], str(field[1]))
    pictures: Sequence[PosedPicture] = open_drive(name.dataset, *known).pictures
    length = len(pictures)
    part = None
    if isinstance(limit, Runs):
        part, pictures = limit.in_drive(length), [pictures[k] for k in limit.chosen(length)]
    else:
        pictures = pictures[:limit]
    frames = [i420_from_rgb(picture.read()) for picture in pictures]
    return Drive(name, pictures, with_noise(frames, name.noise_sigma), part)


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
