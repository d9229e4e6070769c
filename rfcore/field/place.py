"""Check that a field shows what a drive's pictures do: the place, in their frame, as finely."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rfcore.camera import Intrinsics, median_focal_px
from rfcore.errors import InvalidInput
from rfcore.field.interface import RadianceField
from rfcore.field.splats import SplatField
from rfcore.image import rgb_from_colour
from rfcore.metrics import psnr
from rfcore.views import PosedPicture, spread

PAIRS = 4
"""Pictures of a drive that are compared with the field's renders."""
FITS_DB = 18.0
"""A field of the place in the right frame is above this, even with vehicles it has never seen (21.3
dB in the published figures); other places and frames gave 6 to 14 dB."""
FAR = 10.0
"""Distance of a camera from a field's middle, over that of half of the splats, from which on it is
taken for a camera of another place: those of the sample stay below 4."""
COARSE = 1.5
"""Focal length of a camera over that of the training pictures from which on a field is coarse for
it: at 2.0 half of the gain was left."""


def check_place(
    field: RadianceField, pictures: Sequence[PosedPicture], names: tuple[str, str]
) -> str | None:
    """Return a warning if four renders differ much from their pictures; None if the field fits.

    ``names``: the field and the drive, as a command takes them. Raises ``InvalidInput`` when all
    cameras are far away from the field.
    """
    remedy = "rfedge field check {} --drive {}".format(*names)
    eyes = np.array([picture.camera.world_from_cam.translation_m for picture in pictures])
    middle, reach_m = _middle_and_reach(field)
    nearest_m = float(np.linalg.norm(eyes - middle, axis=1).min())
    if reach_m > 0 and nearest_m > FAR * reach_m:  # an own renderer may state no bounds
        raise InvalidInput(
            "field",
            f"is of another place than the drive: its nearest camera is {nearest_m:.4g} m from the "
            f"field's middle, and half of the field lies within {reach_m:.4g} m; give the field of "
            f"this drive, or poses in its frame: {remedy}",
        )
    compared = spread(pictures, PAIRS)
    renders = [rgb_from_colour(field.render_colour(p.camera)) for p in compared]
    pairs = zip(renders, compared, strict=True)
    fit_db = float(np.mean([psnr(rgb, p.read(), mask=p.read_mask()) for rgb, p in pairs]))
    if fit_db >= FITS_DB:
        return None
    return (
        f"the field's renders have {fit_db:.1f} dB against the drive's pictures, a field of the "
        f"place {FITS_DB:g} dB or more: is it of another place, frame or light? {remedy}"
    )


def coarseness(field: RadianceField, cameras: Sequence[Intrinsics]) -> str | None:
    """Return a sentence if the cameras see clearly finer than the pictures that the field was
    trained on; None if they do not, or if that is not known."""
    trained_px, seen_px = field.metadata.focal_px, median_focal_px(cameras)
    if trained_px is None or seen_px < COARSE * trained_px:
        return None
    return (
        f"the camera sees {seen_px / trained_px:.1f} times as finely as the pictures that the "
        f"field was trained on (focal length {seen_px:.0f} px, theirs {trained_px:.0f} px), so it "
        "saves less here: train it on pictures of this size"
    )


def _middle_and_reach(field: RadianceField) -> tuple[np.ndarray, float]:
    """Return the middle of a field, and the distance within which half of it lies."""
    if isinstance(field, SplatField) and field.primitives:
        means = field.gaussians.means.astype(np.float64)
        middle = np.median(means, axis=0)
        return middle, float(np.median(np.linalg.norm(means - middle, axis=1)))
    low, high = np.array(field.bounds.low_m), np.array(field.bounds.high_m)
    return (low + high) / 2, float(np.linalg.norm(high - low)) / 2
