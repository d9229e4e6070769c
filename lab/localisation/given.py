"""One drive of ``rfedge-lab localise``: its text on the command line, its field and pictures.

``NAME=DRIVE,FIELD[,KEY=VALUE...]`` with the keys

* ``units``: the field's units a metre, where that is not 1 (COLMAP's arbitrary scale);
* ``hz``: rate of pictures without times, 10 where it is left out;
* ``frames``: how many are coded, where that is not what the command says for all;
* ``noise``: standard deviation of noise added to the pictures, in 8-bit steps;
* ``rows``: ``starts`` or ``bits``, where not both are wanted; a start error as ``2m:3deg`` where
  only searches from that one are;
* ``feed``, ``feed_map``, ``map``: poses as lines of 12 numbers (KITTI odometry's form) of the drive
  and of the pictures that the field was made of, and the dataset that holds the latter. The feed is
  put into the field's axes by the pictures of the map, so its drift between the two passes stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Pose, TileOrigin
from rfcore.dataset import read_dataset
from rfcore.errors import InvalidInput
from rfcore.field import RadianceField
from rfcore.views import PosedPicture
from rfedge.arguments import open_field
from rfedge.localisation.searches import StartError, parse_start_error

F64 = NDArray[np.float64]
FORM = "NAME=DRIVE,FIELD[,KEY=VALUE...]"
NUMBERS = ("units", "hz", "frames", "noise")
PATHS = ("feed", "feed_map", "map")


@dataclass(frozen=True)
class GivenDrive:
    """One drive of the command line; raises ``InvalidInput`` for text of another form."""

    name: str
    drive: Path
    field: Path
    units: float = 1.0
    hz: float = 10.0
    frames: int | None = None
    noise: float = 0.0
    rows: Literal["starts", "bits", "both"] | StartError = "both"
    feed: Path | None = None
    feed_map: Path | None = None
    map: Path | None = None

    def __post_init__(self) -> None:
        if not (self.units > 0 and self.hz > 0 and self.noise >= 0):
            raise InvalidInput("drives", f"{self.name}: units and hz must be above 0, noise 0 up")
        if len({self.feed is None, self.feed_map is None, self.map is None}) > 1:
            raise InvalidInput("drives", f"{self.name}: feed, feed_map and map go together")

    @staticmethod
    def parse(text: str) -> GivenDrive:
        """Return the drive of ``NAME=DRIVE,FIELD[,KEY=VALUE...]``."""
        name, _, rest = text.partition("=")
        drive, *parts = rest.split(",")
        if not (name and drive and parts):
            raise InvalidInput("drives", f"'{text}' is not {FORM}")
        values: dict[str, Any] = {}
        for part in parts[1:]:
            key, _, value = part.partition("=")
            values |= _value(text, key, value)
        return GivenDrive(name, Path(drive), Path(parts[0]), **values)

    def read(self, threads: int) -> tuple[RadianceField, tuple[PosedPicture, ...]]:
        """Return the field and the posed pictures, with times and with the noise asked for."""
        field = open_field(self.field, threads=threads)
        pictures = read_dataset(self.drive, tile_origin=field.metadata.tile_origin).pictures
        if not any(picture.time_ns for picture in pictures):
            step_ns = 1e9 / self.hz
            pictures = tuple(
                replace(p, time_ns=round(step_ns * n)) for n, p in enumerate(pictures, 1)
            )
        if self.noise:
            pictures = tuple(_noisy(p, n, self.noise) for n, p in enumerate(pictures))
        return field, tuple(pictures)

    def feed_poses(self, origin: TileOrigin | None) -> list[Pose] | None:
        """Return the feed's pose of each picture in the axes of a field with this tile origin; None
        without a feed."""
        if self.feed is None or self.feed_map is None or self.map is None:
            return None
        mapped = read_dataset(self.map, tile_origin=origin).pictures
        truth = [picture.camera.world_from_cam for picture in mapped]
        return aligned_poses(read_pose_lines(self.feed), read_pose_lines(self.feed_map), truth)


def read_pose_lines(path: Path) -> list[Pose]:
    """Return camera-to-world poses of lines of 12 numbers, a 3x4 matrix row by row.

    Raises ``InvalidInput`` for other lines.
    """
    try:
        rows = np.loadtxt(path, ndmin=2).reshape(-1, 3, 4)
    except ValueError as error:
        raise InvalidInput("feed", f"{path}: {error}: lines of 12 numbers are wanted") from error
    return [_pose(row[:, :3], row[:, 3]) for row in rows]


def aligned_poses(
    poses: Sequence[Pose], known: Sequence[Pose], truth: Sequence[Pose]
) -> list[Pose]:
    """Return ``poses`` moved as ``known`` poses must be to lie on ``truth``: turned, then shifted.

    The turn is the chordal mean of truth's rotations by known's (Hartley et al., IJCV 2013).
    Raises ``InvalidInput`` unless there is a truth for each known pose.
    """
    if len(known) != len(truth) or not known:
        raise InvalidInput("feed_map", f"{len(known)} poses for {len(truth)} pictures of the map")
    pairs = [(_matrix(t), _matrix(k)) for t, k in zip(truth, known, strict=True)]
    u, _, vt = np.linalg.svd(sum(t @ k.T for t, k in pairs))
    turn: F64 = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    mine, its = (np.array([p.translation_m for p in group]) for group in (known, truth))
    shift = its.mean(axis=0) - turn @ mine.mean(axis=0)
    moved = _pose(turn, shift)
    return [moved.compose(pose) for pose in poses]


def _value(text: str, key: str, value: str) -> dict[str, Any]:
    """Return one key of a drive with its value as it is stored."""
    if key in PATHS and value:
        return {key: Path(value)}
    if key == "rows":
        return {key: value if value in ("starts", "bits") else parse_start_error(value)}
    if key in NUMBERS:
        try:
            return {key: int(value) if key == "frames" else float(value)}
        except ValueError as error:
            raise InvalidInput("drives", f"'{text}': {key} is not '{value}'") from error
    raise InvalidInput("drives", f"'{text}' is not {FORM}: '{key}={value}'")


def _noisy(picture: PosedPicture, number: int, sigma: float) -> PosedPicture:
    """Return a picture with Gaussian noise, the same at each reading."""

    def read() -> NDArray[np.uint8]:
        rgb = picture.read()
        noise = np.random.default_rng(number).normal(scale=sigma, size=rgb.shape)
        noisy: NDArray[np.uint8] = np.clip(rgb + noise + 0.5, 0, 255).astype(np.uint8)
        return noisy

    return replace(picture, read=read)


def _matrix(pose: Pose) -> F64:
    return np.array(pose.rotation_matrix())


def _pose(turn: F64, shift: F64) -> Pose:
    return Pose.from_matrix(
        [[*row, at] for row, at in zip(turn.tolist(), shift.tolist(), strict=True)]
    )
