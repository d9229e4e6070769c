"""Passes of vehicles along a street, and the frames of them that an update learns from.

Every fourth frame of a pass is held back for the trial; poses are rounded as vehicles send them.

Pixels that the other passes contradict are left out, so that moving objects are not learnt. A block
of 8x8 pixels is moving if its frame differs from the field and most of the other passes, warped to
the same place by the field's depth, do not. What persists over the passes (a parked car, another
light) differs in all of them. Where there is only one pass, everything is learnt.

A whole frame is an outlier (a wrong pose, a pasted picture) if its edges agree neither with the
field's nor with those of another vehicle: edges stay in another light, colours do not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput
from rfcore.field import RadianceField
from rfcore.field.interface import render_field_view
from rfcore.image import I420
from rfcore.native.warp import BLOCK_PX, warp_i420
from rfcore.native.yuv import i420_from_rgb
from rfcore.train.targets import Target
from rfcore.views import FieldView, PosedPicture, spread

HOLD_BACK_EVERY = 4
FEWEST_FRAMES = 8
"""Fewest frames of a pass: two of eight are held back, and not next to each other."""


@dataclass(frozen=True)
class Pass:
    """One drive of one vehicle, in time order; ``identity`` says whose."""

    identity: str
    pictures: tuple[PosedPicture, ...]


@dataclass(frozen=True)
class SeenFrame(Target):
    """A camera and its picture, with the number of the pass it belongs to."""

    pass_number: int


def check_passes(passes: Sequence[Pass], min_identities: int) -> None:
    """Raise ``InvalidInput`` for too few vehicles, or a pass of too few frames."""
    identities = {drive.identity for drive in passes}
    if len(identities) < min_identities:
        raise InvalidInput(
            "min_identities",
            f"passes of {len(identities)} vehicle(s) ({', '.join(sorted(identities)) or 'none'}), "
            f"at least {min_identities} are asked for",
        )
    for drive in passes:
        if len(drive.pictures) < FEWEST_FRAMES:
            raise InvalidInput(
                "from", f"{drive.identity}: {len(drive.pictures)} frames, at least {FEWEST_FRAMES}"
            )


def split_frames(passes: Sequence[Pass], most: int) -> tuple[list[SeenFrame], list[SeenFrame]]:
    """Return the frames to learn from and those held back, ``most`` in all, evenly over the passes.

    Raises ``DatasetError`` for a picture that cannot be read.
    """
    learnt: list[SeenFrame] = []
    held_back: list[SeenFrame] = []
    for number, drive in enumerate(passes):
        for place, picture in enumerate(spread(drive.pictures, max(2, most // len(passes)))):
            camera = picture.camera.rounded()
            frame = SeenFrame(camera, picture.read(), number)
            is_held_back = place % HOLD_BACK_EVERY == HOLD_BACK_EVERY // 2
            (held_back if is_held_back else learnt).append(frame)
    return learnt, held_back


FAR_LEVELS = 20
"""Mean absolute difference of a block's luma above which it does not show the same as the field."""
NEAR_LEVELS = 12
REACH_M = 6.0
"""Two frames show the same place if their cameras are nearer than this and look the same way."""
SAME_WAY = 0.8
"""Cosine of the angle between the axes of two such cameras."""
UNKNOWN = 255
"""Level of pixels that cannot be warped; warped differences are at most ``CLIPPED``."""
CLIPPED = 120
EDGES_AGREE = 0.3
"""Least correlation of edges of two pictures of the same place. Pictures of the sample street and
its field have 0.70 to 0.98, also in a third of the light; 0.16 to 0.38 if the pose is 0.5 m off; at
most 0.21 if the picture is another one of the same street."""
EDGE_CELL_PX = 4
"""Edges are computed between means of so many pixels, which hides noise and small pose errors."""

Mask = NDArray[np.bool_]
F32 = NDArray[np.float32]


@dataclass(frozen=True)
class _Difference:
    """The difference of a frame from the field: luma levels, uint8 [H, W], block by block."""

    view: FieldView
    levels: NDArray[np.uint8]


def trusted_pixels(field: RadianceField, frames: Sequence[SeenFrame]) -> list[Mask | None]:
    """Return for each frame the pixels [H, W] to learn from, or None for all."""
    differences = [_difference(field, frame) for frame in frames]
    return [_trusted(index, frames, differences) for index in range(len(frames))]


def both(first: Sequence[Mask | None], second: Sequence[Mask | None]) -> list[Mask | None]:
    """Return the pixels that both trust, frame by frame."""
    pairs = zip(first, second, strict=True)
    return [b if a is None else a if b is None else a & b for a, b in pairs]


def _difference(field: RadianceField, frame: SeenFrame) -> _Difference:
    view = render_field_view(field, frame.camera)
    seen, shown = i420_from_rgb(frame.rgb).y.astype(np.int16), view.render.y.astype(np.int16)
    means = _block_means(np.abs(seen - shown).astype(np.float32))
    return _Difference(view, np.clip(means, 0, CLIPPED).astype(np.uint8))


def _block_means(plane: F32) -> F32:
    """Return the mean of each whole 8x8 block at each of its pixels; the rest is 0."""
    height, width = (side // BLOCK_PX * BLOCK_PX for side in plane.shape)
    blocks = plane[:height, :width].reshape(height // BLOCK_PX, BLOCK_PX, -1, BLOCK_PX)
    means = blocks.mean(axis=(1, 3), dtype=np.float32)
    out = np.zeros_like(plane)
    out[:height, :width] = means.repeat(BLOCK_PX, 0).repeat(BLOCK_PX, 1)
    return out


def _trusted(
    index: int, frames: Sequence[SeenFrame], differences: Sequence[_Difference]
) -> Mask | None:
    own = differences[index]
    carried = [
        _carried(differences[other], own.view) for other in _neighbours(index, frames).values()
    ]
    if not carried:
        return None
    known = np.stack([plane != UNKNOWN for plane in carried])
    near = np.stack([plane < NEAR_LEVELS for plane in carried])
    contradicted = 2 * near.sum(axis=0) > known.sum(axis=0)
    passing = (own.levels > FAR_LEVELS) & contradicted
    return ~passing if passing.any() else None


def _neighbours(index: int, frames: Sequence[SeenFrame]) -> Mapping[int, int]:
    """Return the index of the nearest frame of every other pass, by the pass's number."""
    mine = frames[index]
    nearest: dict[int, tuple[float, int]] = {}
    position, axis = _position_and_axis(mine)
    for other, frame in enumerate(frames):
        if frame.pass_number == mine.pass_number:
            continue
        if frame.camera.intrinsics != mine.camera.intrinsics:
            continue
        there, looking = _position_and_axis(frame)
        distance_m = float(np.linalg.norm(there - position))
        if distance_m > REACH_M or float(axis @ looking) < SAME_WAY:
            continue
        best = nearest.get(frame.pass_number)
        if best is None or distance_m < best[0]:
            nearest[frame.pass_number] = (distance_m, other)
    return {number: other for number, (_, other) in nearest.items()}


def _position_and_axis(
    frame: SeenFrame,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    pose = frame.camera.world_from_cam
    return np.array(pose.translation_m), np.array(pose.rotation_matrix())[:, 2]


def _carried(difference: _Difference, now: FieldView) -> NDArray[np.uint8]:
    """Return the other frame's levels warped to ``now``, the maximum over 3x3 blocks."""
    picture = I420.filled(now.render.size_px)
    blank = FieldView(now.camera, I420.filled(now.render.size_px, UNKNOWN), now.depth)
    levels = I420(difference.levels, picture.u, picture.v)
    carried = warp_i420(levels, difference.view, blank).y
    return _most_around(carried)


def _most_around(plane: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the highest known level within a block's side, which allows for wrong depth."""
    known = np.where(plane == UNKNOWN, 0, plane)
    most = known
    for axis in (0, 1):
        shifted = [np.roll(most, step, axis) for step in (-BLOCK_PX, 0, BLOCK_PX)]
        most = np.maximum.reduce(shifted)
    return np.where(plane == UNKNOWN, np.uint8(UNKNOWN), most).astype(np.uint8)


def without_outliers(field: RadianceField, passes: Sequence[Pass]) -> list[Pass]:
    """Return the passes without frames that agree neither with the field nor with another vehicle.

    A pass is left out if fewer than half of its frames agree, or fewer than an update needs.
    Raises ``DatasetError`` for a picture that cannot be read.
    """
    identities = sorted({drive.identity for drive in passes})
    frames = [
        SeenFrame(picture.camera, picture.read(), identities.index(drive.identity))
        for drive in passes
        for picture in drive.pictures
    ]
    agree = iter(_agreeing(field, frames))
    kept = []
    for drive in passes:
        pictures = tuple(picture for picture in drive.pictures if next(agree))
        if len(pictures) >= max(FEWEST_FRAMES, len(drive.pictures) / 2):
            kept.append(Pass(drive.identity, pictures))
    return kept


def edge_correlation(first: F32, second: F32) -> float:
    """Return how alike the edges of two luma planes [H, W] lie: -1..1, 0 if one has no edges."""
    a, b = _edges(first), _edges(second)
    norm = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return float((a * b).sum()) / norm if norm > 0 else 0.0


def _edges(plane: F32) -> NDArray[np.float64]:
    cell = EDGE_CELL_PX
    height, width = (side // cell * cell for side in plane.shape)
    cells = plane[:height, :width].reshape(height // cell, cell, width // cell, cell)
    means = cells.mean(axis=(1, 3), dtype=np.float64)
    return np.concatenate([np.diff(means, axis=0).ravel(), np.diff(means, axis=1).ravel()])


def _agreeing(field: RadianceField, frames: Sequence[SeenFrame]) -> list[bool]:
    """Return for each frame, whose ``pass_number`` is that of its vehicle, whether it agrees."""
    views = [render_field_view(field, frame.camera) for frame in frames]
    pictures = [i420_from_rgb(frame.rgb) for frame in frames]
    agree = [
        edge_correlation(_luma(picture), _luma(view.render)) >= EDGES_AGREE
        for picture, view in zip(pictures, views, strict=True)
    ]
    for index in [index for index, agrees in enumerate(agree) if not agrees]:
        agree[index] = any(
            edge_correlation(
                _luma(warp_i420(pictures[other], views[other], views[index])),
                _luma(pictures[index]),
            )
            >= EDGES_AGREE
            for other in _neighbours(index, frames).values()
        )
    return agree


def _luma(picture: I420) -> F32:
    return picture.y.astype(np.float32)
