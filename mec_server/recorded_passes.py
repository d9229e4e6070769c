"""Recordings as passes over a tile: which there are, what they show of it, and in which light.

A pass is what one vehicle recorded on one drive through the tile (``rfcore.update.passes``). Its
light is the published one whose field resembles it most, or else a new one, which it shares with
passes of the same colours.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from functools import partial
from itertools import count
from pathlib import Path

import numpy as np
import structlog
from numpy.typing import NDArray

from rfcore.camera import Camera, TileOrigin
from rfcore.codec.packet import median_block_mean_difference
from rfcore.dataset.picture_file import read_picture
from rfcore.dataset.recorded_session import RecordedPart, read_recorded_part, recordings_under
from rfcore.errors import DatasetError
from rfcore.field import RadianceField
from rfcore.field.interface import render_field_view
from rfcore.native.yuv import i420_from_rgb
from rfcore.update.passes import Pass, SeenFrame
from rfcore.views import PosedPicture, spread
from rfcore.wire.tile_manifest import TileVersions

log = structlog.get_logger()

FITS_LEVELS = 6.0
"""Median difference of block means up to which a pass is in a field's light, as for vehicles."""
SAME_LIGHT = 0.25
"""Two passes are in one light if the logarithms of their colours' gains differ by no more."""
LOOKED_AT = 5
"""Number of frames by which the light of a pass is estimated."""


@dataclass(frozen=True)
class RecordedPass:
    """A finished recording: its name, its pass, and its light.

    ``gains``: logarithms of the colours' gains over the tile's own field; ``nearest_light``: None
    if no light fits.
    """

    name: str
    drive: Pass
    first_ns: int
    gains: tuple[float, float, float]
    nearest_light: str | None


class Recordings:
    """The folder that the server records into; ``now_ms`` is the time of the Unix epoch."""

    def __init__(self, folder: Path, now_ms: Callable[[], int]) -> None:
        self._folder, self._now_ms = folder, now_ms

    def files(self, max_age_s: float) -> list[Path]:
        """Return the recordings that were added to lately, oldest first."""
        files = sorted(recordings_under(self._folder), key=lambda file: file.parent.name)
        return [file for file in files if self.age_s(file) <= max_age_s]

    def age_s(self, file: Path) -> float:
        """Return the seconds since a file was written; any number for one that is gone."""
        try:
            return self._now_ms() / 1e3 - file.stat().st_mtime
        except FileNotFoundError:
            return math.inf

    def name_of(self, file: Path) -> str:
        """Return a recording's path below the folder."""
        return str(file.parent.relative_to(self._folder))


def readable(files: Sequence[Path]) -> Iterator[RecordedPart]:
    """Yield recordings; one that is deleted meanwhile is left out."""
    for file in files:
        try:
            yield read_recorded_part(file)
        except (DatasetError, FileNotFoundError) as error:
            log.info("recording left out", problem=str(error))


def pass_of(part: RecordedPart, field_ids: Set[str], origin: TileOrigin) -> Pass:
    """Return the pictures coded against one of ``field_ids``, in a tile of ``origin``."""
    intrinsics = part.camera.intrinsics
    pictures = tuple(
        PosedPicture(
            picture.file,
            Camera(intrinsics, origin.localise(picture.world_from_cam)),
            partial(read_picture, part.file.parent / picture.file, intrinsics),
        )
        for picture in part.pictures
        if picture.world_from_cam is not None and picture.field_id in field_ids
    )
    return Pass(part.camera.vehicle_id, pictures)


def hour_of(time_ns: int) -> float:
    """Return the time of day, UTC, of a capture time."""
    return time_ns / 1e9 % 86_400 / 3600


def light_of(
    drive: Pass, fields: Mapping[str, RadianceField]
) -> tuple[tuple[float, float, float], str | None]:
    """Return the log gains of a pass's colours over the tile's own field, and the light it fits."""
    looked_at = spread(drive.pictures, LOOKED_AT)
    frames = [SeenFrame(picture.camera.rounded(), picture.read(), 0) for picture in looked_at]
    differences = {
        name: float(np.median([_difference(field, frame) for frame in frames]))
        for name, field in fields.items()
    }
    nearest = min(differences, key=lambda name: differences[name])
    means = [_colour_gains(fields[""], frame) for frame in frames]
    red, green, blue = (float(gain) for gain in np.median(means, axis=0))
    return (red, green, blue), nearest if differences[nearest] <= FITS_LEVELS else None


def _difference(field: RadianceField, frame: SeenFrame) -> float:
    view = render_field_view(field, frame.camera)
    return median_block_mean_difference(i420_from_rgb(frame.rgb), view.render)


def _colour_gains(field: RadianceField, frame: SeenFrame) -> NDArray[np.float64]:
    shown = np.clip(field.render_colour(frame.camera), 0, 1).mean(axis=(0, 1))
    seen = frame.colour().mean(axis=(0, 1))
    gains: NDArray[np.float64] = np.log(np.maximum(seen, 1 / 255) / np.maximum(shown, 1 / 255))
    return gains


def by_light(
    passes: Sequence[RecordedPass], versions: TileVersions
) -> Iterator[tuple[str, list[RecordedPass]]]:
    """Yield the passes of each light, oldest first; a light that is new gets a name of its hour."""
    known: dict[str, list[RecordedPass]] = {}
    new: list[list[RecordedPass]] = []
    for one in passes:
        if one.nearest_light is not None:
            known.setdefault(one.nearest_light, []).append(one)
            continue
        alike = [group for group in new if _same_light(group[0], one)]
        if alike:
            alike[0].append(one)
        else:
            new.append([one])
    yield from known.items()
    taken = {version.label.light for version in versions.versions}
    for group in new:
        name = _unused(f"h{int(hour_of(group[0].first_ns)):02}", taken)
        taken.add(name)
        yield name, group


def _same_light(first: RecordedPass, second: RecordedPass) -> bool:
    return max(abs(a - b) for a, b in zip(first.gains, second.gains, strict=True)) <= SAME_LIGHT


def _unused(name: str, taken: Set[str]) -> str:
    names = (name if number == 1 else f"{name}-{number}" for number in count(1))
    return next(each for each in names if each not in taken)
