"""Check whether a field shows what a drive's camera saw, and which convention would make it fit.

Two things are tried. *Conventions*: a field in a normalised frame, with other axes or in other
units renders black or fog without a hint. Each ``Convention`` is one guess at what is wrong: how
the field's frame follows from the drive's world, and what has to be done to the drive's poses.
*Modes*: splats trained antialiased lose several dB when they are drawn without the opacity that
makes up for the blur, and the other way round; a .ply without the ``SplatRenderMode`` comment does
not say which is right.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, Pose
from rfcore.errors import InvalidInput
from rfcore.field import RadianceField, SplatField
from rfcore.field.place import FITS_DB, PAIRS
from rfcore.field.quality import LevelOfDetail
from rfcore.field.similarity import Similarity, moved
from rfcore.image import Rgb, rgb_from_colour
from rfcore.metrics import psnr
from rfcore.views import PosedPicture, spread

UNITS = {"": 1.0, "centimetres": 100.0, "millimetres": 1000.0, "hundreds of metres": 0.01}
"""Field units in a metre of the drive's world."""
AS_OPENGL = Pose((0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0))
"""Half a turn about x: camera axes x right, y up, z backward."""


@dataclass(frozen=True)
class Convention:
    """``field_from_world``, and whether poses are to be inverted or their camera axes turned."""

    name: str
    field_from_world: Similarity
    inverted_poses: bool = False
    opengl_axes: bool = False

    @property
    def blames_the_drive(self) -> bool:
        """Whether it says that the drive's poses are wrong, not the field's frame."""
        return self.inverted_poses or self.opengl_axes

    def camera(self, camera: Camera) -> Camera:
        """Return where the drive's camera is in the field's frame."""
        pose = camera.world_from_cam.inverse() if self.inverted_poses else camera.world_from_cam
        if self.opengl_axes:
            pose = pose.compose(AS_OPENGL)
        move = self.field_from_world
        x, y, z = move.apply(np.array([pose.translation_m]))[0].tolist()
        return Camera(camera.intrinsics, Pose((x, y, z), move.pose.compose(pose).rotation))


AS_GIVEN = Convention("as it is", Similarity(Pose.identity()))


def known_conventions(nerfstudio: Similarity | None) -> Iterator[Convention]:
    """Yield every convention worth trying, those of one scale together.

    ``nerfstudio`` is the ``field_from_world`` of a ``dataparser_transforms.json``, if there is one.
    """
    for frame, similarity in _frames(nerfstudio).items():
        for inverted, opengl in product((False, True), (False, True)):
            for axes, turn in _axes().items():
                parts = [frame, axes, inverted * "poses inverted", opengl * "OpenGL camera axes"]
                name = ", ".join(part for part in parts if part) or AS_GIVEN.name
                yield Convention(name, similarity.compose(turn), inverted, opengl)


def _frames(nerfstudio: Similarity | None) -> dict[str, Similarity]:
    frames = {
        f"the field is in {unit}" if unit else "": Similarity(Pose.identity(), scale)
        for unit, scale in UNITS.items()
    }
    if nerfstudio is not None:
        turned = Similarity(Pose((0.0, 0.0, 0.0), nerfstudio.pose.rotation))
        frames |= {
            "the field is in nerfstudio's frame": nerfstudio,
            "nerfstudio's transform was applied instead of undone": nerfstudio.compose(nerfstudio),
            "nerfstudio's transform was undone twice": nerfstudio.inverse(),
            "the field is in nerfstudio's frame, not scaled": _without_scale(nerfstudio),
            "the field is turned as nerfstudio turns": turned,
        }
    return frames


def _without_scale(similarity: Similarity) -> Similarity:
    x, y, z = (value / similarity.scale for value in similarity.pose.translation_m)
    return Similarity(Pose((x, y, z), similarity.pose.rotation))


def _axes() -> dict[str, Similarity]:
    """Return the 24 ways to turn a cube, by what becomes of x, y, z; first no turn at all."""
    turns = {}
    for order in permutations(range(3)):
        for signs in product((1, -1), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            if math.isclose(np.linalg.det(matrix), 1.0):
                names = [f"{'-' * (s < 0)}{'xyz'[i]}" for i, s in zip(order, signs, strict=True)]
                name = f"the field's axes are {', '.join(names)} of the drive's world"
                rows = np.hstack([matrix, np.zeros((3, 1))])
                turns[name if names != ["x", "y", "z"] else ""] = Similarity(
                    Pose.from_matrix(rows.tolist())
                )
    return turns


PROBES = 2
PROBE_WIDTH_PX = 96
FINALISTS = 8
GAIN_DB = 3.0
"""Another convention must be so much better to be believed below ``FITS_DB``."""
MODE_GAIN_DB = 0.5
"""The mode that the field does not state must be so much better to be believed. A field drawn in
the wrong mode lost 4.2 dB on the first sample; between modes that both fit there is less."""
MAX_PAIR_WIDTH_PX = 640

F32 = NDArray[np.float32]


@dataclass(frozen=True)
class ModeFit:
    """PSNR of a field's splats in either mode, under the convention that fits best."""

    stated_antialiased: bool
    """Value that the field's metadata states."""
    antialiased_db: float
    default_db: float

    @property
    def antialiased(self) -> bool:
        """The mode that fits: the stated one unless the other is clearly better."""
        stated_db, other_db = self.antialiased_db, self.default_db
        if not self.stated_antialiased:
            stated_db, other_db = other_db, stated_db
        return self.stated_antialiased != (other_db >= stated_db + MODE_GAIN_DB)

    @property
    def psnr_db(self) -> float:
        """PSNR in the mode that fits."""
        return self.antialiased_db if self.antialiased else self.default_db


@dataclass(frozen=True)
class Fit:
    """The fit of a field to a drive under one convention.

    ``psnr_db`` is in the mode that fits, ``as_given_db`` in the field's own frame and mode.
    ``fits`` says whether the fit is good enough to be believed, ``tried`` how many conventions
    there were to choose from. ``mode`` is ``None`` for a field that is not made of splats.
    """

    convention: Convention
    psnr_db: float
    as_given_db: float
    fits: bool
    tried: int
    mode: ModeFit | None = None


def check_field(
    field: RadianceField, pictures: Sequence[PosedPicture], nerfstudio: Similarity | None = None
) -> Fit:
    """Return the convention under which ``field`` shows four of ``pictures`` best.

    Splats are drawn in both modes. Other conventions are tried only when the field fits as it is
    in neither. Raises ``InvalidInput`` when there are no pictures.
    """
    if not pictures:
        raise InvalidInput("drive", "has no pictures")
    view, seen = _FieldInDrive(field), spread(pictures, PAIRS)
    best, tried = AS_GIVEN, 1
    as_given_db = best_db = _psnr_db(view, seen, AS_GIVEN)
    mode = _mode_fit(field, seen, best, best_db)
    if (best_db if mode is None else mode.psnr_db) < FITS_DB:
        best, best_db, tried = _best_convention(view, seen, nerfstudio)
        mode = _mode_fit(field, seen, best, best_db)
    psnr_db = best_db if mode is None else mode.psnr_db
    fits = psnr_db >= FITS_DB or psnr_db >= as_given_db + GAIN_DB
    return Fit(best, psnr_db, as_given_db, fits, tried, mode)


def drawn_antialiased(field: SplatField, antialiased: bool) -> SplatField:
    """Return the same splats, drawn antialiased or not; the field itself where it says so.

    A field in another mode states no quality: what was measured was measured in its own.
    """
    old = field.metadata
    if old.antialiased == antialiased:
        return field
    metadata = replace(old, antialiased=antialiased, held_out_psnr_db=None, held_out_ssim=None)
    return field.described(metadata)


def pairs_picture(
    field: RadianceField, pictures: Sequence[PosedPicture], convention: Convention
) -> tuple[Rgb, list[float]]:
    """Return four camera pictures, each beside the field's render, and their PSNR in dB."""
    view = _FieldInDrive(field)
    rows, values_db = [], []
    for picture in spread(pictures, PAIRS):
        camera, render = picture.read(), rgb_from_colour(view.colour(picture.camera, convention))
        values_db.append(psnr(render, camera, mask=picture.read_mask()))
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
    if convention == AS_GIVEN:
        return field
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


class _FieldInDrive:
    """A field as a drive's cameras see it under any convention.

    It is scaled to metres first, because renderers have a near plane.
    """

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


def _best_convention(
    view: _FieldInDrive, seen: Sequence[PosedPicture], nerfstudio: Similarity | None
) -> tuple[Convention, float, int]:
    """Return the best convention, its PSNR in dB, and how many were tried."""
    conventions = list(known_conventions(nerfstudio))
    probes = [_Probe.of(picture) for picture in spread(seen, PROBES)]
    ranked = sorted(conventions, key=lambda guess: _probed_error(view, probes, guess))
    results = [(_psnr_db(view, seen, guess), guess) for guess in ranked[:FINALISTS]]
    best_db, best = max(results, key=lambda result: result[0])
    return best, best_db, len(conventions)


def _mode_fit(
    field: RadianceField, seen: Sequence[PosedPicture], convention: Convention, stated_db: float
) -> ModeFit | None:
    """Return how both modes fit; ``stated_db`` is the PSNR in the one the field states."""
    if not isinstance(field, SplatField):
        return None
    stated = field.metadata.antialiased
    other = _FieldInDrive(drawn_antialiased(field, not stated))
    other_db = _psnr_db(other, seen, convention)
    return ModeFit(stated, *((stated_db, other_db) if stated else (other_db, stated_db)))


def _probed_error(view: _FieldInDrive, probes: Sequence[_Probe], convention: Convention) -> float:
    renders = [(view.colour(probe.camera, convention), probe.colour) for probe in probes]
    return float(np.mean([np.square(np.clip(r, 0, 1) - seen).mean() for r, seen in renders]))


def _psnr_db(
    view: _FieldInDrive, pictures: Sequence[PosedPicture], convention: Convention
) -> float:
    renders = [rgb_from_colour(view.colour(p.camera, convention)) for p in pictures]
    pairs = zip(renders, pictures, strict=True)
    return float(np.mean([psnr(rgb, p.read(), mask=p.read_mask()) for rgb, p in pairs]))


def _shrunk(rgb: Rgb) -> Rgb:
    step = -(-rgb.shape[1] // (2 * MAX_PAIR_WIDTH_PX))
    return np.asarray(np.floor(_averaged(rgb, step) + 0.5), np.uint8)


def _averaged(rgb: Rgb, step: int) -> F32:
    """Return the means of step x step pixels; what is left over at the far sides is cut off."""
    height, width = (side // step * step for side in rgb.shape[:2])
    blocks = rgb[:height, :width].reshape(height // step, step, width // step, step, 3)
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float32))
