"""Does a field show what a drive's camera saw? If not: which known convention would make it fit?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, Pose
from rfcore.errors import InvalidInput
from rfcore.field import RadianceField, SplatField
from rfcore.field.quality import LevelOfDetail
from rfcore.field.similarity import Similarity, moved
from rfcore.image import Rgb
from rfcore.metrics import psnr
from rfcore.views import PosedPicture
from rfedge.fields.conventions import AS_GIVEN, Convention, known_conventions

__all__ = ["PAIRS", "Fit", "check_field", "in_drive_world", "pairs_picture", "to_rgb"]

PAIRS = 4
PROBES = 2
PROBE_WIDTH_PX = 96
FINALISTS = 8
FITS_DB = 18.0
"""A field of the place, seen as it is, is above this even with vehicles it has never seen (21.3 dB
in the published figures); other places and frames gave 6 to 14 dB."""
GAIN_DB = 3.0
"""So much better than as given another convention must be to be believed below ``FITS_DB``."""
MAX_PAIR_WIDTH_PX = 640

F32 = NDArray[np.float32]


@dataclass(frozen=True)
class Fit:
    """How well the field fits the drive under one convention.

    ``fits`` says whether it is believed; ``tried`` how many there were to choose from.
    """

    convention: Convention
    psnr_db: float
    as_given_db: float
    fits: bool
    tried: int


def check_field(
    field: RadianceField, pictures: Sequence[PosedPicture], nerfstudio: Similarity | None = None
) -> Fit:
    """Return the convention under which ``field`` shows four of ``pictures`` best.

    The others are tried only when the field does not fit as it is. Raises ``InvalidInput`` when
    there are no pictures.
    """
    if not pictures:
        raise InvalidInput("drive", "has no pictures")
    stage, seen = _Stage(field), _spread(pictures, PAIRS)
    as_given_db = _psnr_db(stage, seen, AS_GIVEN)
    if as_given_db >= FITS_DB:
        return Fit(AS_GIVEN, as_given_db, as_given_db, fits=True, tried=1)
    conventions = list(known_conventions(nerfstudio))
    probes = [_Probe.of(picture) for picture in _spread(seen, PROBES)]
    ranked = sorted(conventions, key=lambda guess: _probed_error(stage, probes, guess))
    results = [(_psnr_db(stage, seen, guess), guess) for guess in ranked[:FINALISTS]]
    best_db, best = max(results, key=lambda result: result[0])
    fits = best_db >= FITS_DB or best_db >= as_given_db + GAIN_DB
    return Fit(best, best_db, as_given_db, fits, len(conventions))


def pairs_picture(
    field: RadianceField, pictures: Sequence[PosedPicture], convention: Convention
) -> tuple[Rgb, list[float]]:
    """Return four camera pictures, each beside the field's render, and their PSNR in dB."""
    stage = _Stage(field)
    rows, values_db = [], []
    for picture in _spread(pictures, PAIRS):
        camera, render = picture.read(), to_rgb(stage.colour(picture.camera, convention))
        values_db.append(psnr(render, camera))
        rows.append(_shrunk(np.hstack([camera, render])))
    width = min(row.shape[1] for row in rows)
    return np.vstack([row[:, :width] for row in rows]), values_db


def in_drive_world(field: RadianceField, convention: Convention) -> SplatField:
    """Return the field in the frame of the drive it was checked against.

    Raises ``InvalidInput`` when it is the drive's poses that have to change, or for a field that
    is not made of splats.
    """
    if not isinstance(field, SplatField):
        raise InvalidInput("fix", f"a field of kind '{field.metadata.kind}' cannot be moved")
    if convention.blames_the_drive:
        raise InvalidInput("fix", f"the drive's poses are to be changed: {convention.name}")
    world_from_field = convention.field_from_world.inverse()
    wider = np.float32(np.log(world_from_field.scale))
    levels = {
        detail: LevelOfDetail(own.log_scales + wider, own.opacity_logits)
        for detail, own in field.levels.items()
    }
    splats = moved(field.gaussians, world_from_field)
    fixed = SplatField(splats, field.metadata, levels=levels, isa=field.isa)
    return fixed.compressed() if "encoding" in field.archive().metadata else fixed


def to_rgb(colour: F32) -> Rgb:
    """Return display-referred colour as 8 bits, rounded to nearest."""
    return np.asarray(np.floor(np.clip(colour, 0, 1) * 255 + 0.5), np.uint8)


@dataclass(frozen=True)
class _Probe:
    """A small camera and the picture it took."""

    camera: Camera
    colour: F32

    @staticmethod
    def of(picture: PosedPicture) -> _Probe:
        k = picture.camera.intrinsics
        step = max(1, k.width_px // PROBE_WIDTH_PX)
        small = _averaged(picture.read(), step)
        intrinsics = k.resized(small.shape[1], small.shape[0])
        return _Probe(Camera(intrinsics, picture.camera.world_from_cam), small / np.float32(255))


class _Stage:
    """A field under any convention, brought to metres first: renderers have a near plane."""

    def __init__(self, field: RadianceField) -> None:
        self._field = field
        self._metric = field
        self._scale = 1.0

    def colour(self, camera: Camera, convention: Convention) -> F32:
        """Return what the field shows ``camera`` of the drive."""
        seen, scale = convention.camera(camera), convention.field_from_world.scale
        if scale == 1 or not isinstance(self._field, SplatField):
            return self._field.render_colour(seen)
        if scale != self._scale:
            in_metres = moved(self._field.gaussians, Similarity(Pose.identity(), 1 / scale))
            self._metric = SplatField(in_metres, self._field.metadata, isa=self._field.isa)
            self._scale = scale
        x, y, z = (value / scale for value in seen.world_from_cam.translation_m)
        pose = Pose((x, y, z), seen.world_from_cam.rotation)
        return self._metric.render_colour(Camera(seen.intrinsics, pose))


def _probed_error(stage: _Stage, probes: Sequence[_Probe], convention: Convention) -> float:
    renders = [(stage.colour(probe.camera, convention), probe.colour) for probe in probes]
    return float(np.mean([np.square(np.clip(r, 0, 1) - seen).mean() for r, seen in renders]))


def _psnr_db(stage: _Stage, pictures: Sequence[PosedPicture], convention: Convention) -> float:
    renders = [(to_rgb(stage.colour(p.camera, convention)), p.read()) for p in pictures]
    return float(np.mean([psnr(render, seen) for render, seen in renders]))


def _spread(pictures: Sequence[PosedPicture], count: int) -> list[PosedPicture]:
    """Return ``count`` pictures spread evenly over the drive, or all if there are fewer."""
    chosen = np.unique(np.linspace(0, len(pictures) - 1, count).round().astype(int))
    return [pictures[i] for i in chosen]


def _shrunk(rgb: Rgb) -> Rgb:
    step = -(-rgb.shape[1] // (2 * MAX_PAIR_WIDTH_PX))
    return np.asarray(np.floor(_averaged(rgb, step) + 0.5), np.uint8)


def _averaged(rgb: Rgb, step: int) -> F32:
    """Return the means of step x step pixels; what is left over at the far sides is cut off."""
    height, width = (side // step * step for side in rgb.shape[:2])
    blocks = rgb[:height, :width].reshape(height // step, step, width // step, step, 3)
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float32))
