"""The lens of a camera as tables name it: a camera model and coefficients k1, k2, p1, ...

Models are COLMAP's names, which nerfstudio shares. Coefficients of zero are no lens,
except of a fisheye, which is one even then. A coefficient that the model does not have, and a model
that is not known, raise ``DatasetError``.
"""

from __future__ import annotations

from rfcore.dataset.keys import Table, number
from rfcore.errors import DatasetError
from rfcore.lens import BrownLens, FisheyeLens, Lens

__all__ = ["LENS_KEYS", "lens_of"]

LENS_KEYS = {
    "PINHOLE": (),
    "SIMPLE_PINHOLE": (),
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV": ("k1", "k2", "p1", "p2", "k3"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}
DISTORTION_KEYS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")


def lens_of(where: str, model: object, keys: Table) -> Lens | None:
    """Return the lens, ``None`` for a pinhole."""
    if not isinstance(model, str) or model not in LENS_KEYS:
        raise DatasetError(f"{where}: camera_model {model!r} is none of {', '.join(LENS_KEYS)}")
    given = {key: number(where, keys, key) for key in DISTORTION_KEYS if key in keys}
    known = LENS_KEYS[model]
    for key, value in given.items():
        if value != 0.0 and key not in known:
            raise DatasetError(
                f"{where}: lens distortion {key} = {value:g} does not belong to camera_model "
                f"{model}, which has {', '.join(known) or 'none'}"
            )
    return _lens(model, {key: given.get(key, 0.0) for key in known})


def _lens(model: str, coefficients: dict[str, float]) -> Lens | None:
    if model == "OPENCV_FISHEYE":
        return FisheyeLens(**coefficients)
    return BrownLens(**coefficients) if any(coefficients.values()) else None
