"""RGB <-> I420: BT.709, limited range, integers only, the same bytes on every machine.

Both ends of a stream convert their renders to codec pictures, so this conversion must be bit-exact.
It is defined here by integers; ``csrc/picture/yuv.cpp`` computes exactly this.

Forward (ITU-R BT.709-6 section 3, 8 bits, with Kr = 0.2126, Kb = 0.0722). Coefficients are the
exact ones times 2**16, rounded so that the luma row sums to round(219 / 255 * 2**16) and the
chroma rows sum to zero; hence every grey g gives Y = 16 + round(219 g / 255), U = V = 128. ``>>``
rounds down, so the added half makes it round half up::

    Y = ( 11966 R + 40254 G +  4064 B + ( 16 << 16) + 2**15) >> 16
    U = ( -6596 r - 22188 g + 28784 b + (128 << 18) + 2**17) >> 18
    V = ( 28784 r - 26145 g -  2639 b + (128 << 18) + 2**17) >> 18

r, g, b are sums over a 2x2 block: chroma sits in the middle of the block (chroma sample location
type 1 of ITU-T H.264 figure E-1, which the codec writes into the VUI). A last odd row or column is
counted twice, that is, the edge is replicated. No coefficient is off by more than 0.67 / 2**16, so
a sample differs from the rounded real-valued one by at most 3 * 255 * 0.67 / 2**16 < 0.008 levels
before rounding. Y lies in 16..235, U and V in 16..240: never 0, which an I_PCM picture could not
hold (``rfcore.codec.h264.splice``).

Inverse, each chroma sample standing for its 2x2 block (nearest), clamped to 0..255::

    L = 76309 (Y - 16) + 2**15
    R = (L + 117489 (V - 128)) >> 16
    G = (L - 13975 (U - 128) - 34925 (V - 128)) >> 16
    B = (L + 138438 (U - 128)) >> 16
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera
from rfcore.errors import InvalidInput
from rfcore.image import I420, Rgb
from rfcore.native import _native
from rfcore.views import FieldView, View


def i420_from_rgb(rgb: Rgb) -> I420:
    """Convert uint8 [H, W, 3] to I420; raise ``InvalidInput`` for another shape or dtype."""
    _require_picture("rgb", rgb, np.uint8)
    out = I420.empty((rgb.shape[1], rgb.shape[0]))
    _native.i420_from_rgb(np.ascontiguousarray(rgb), *out.planes)
    return out


def i420_from_colour(colour: NDArray[np.float32]) -> I420:
    """Convert float32 [H, W, 3], nominally 0..1, to I420.

    Values are clamped to [0, 1] and rounded half up to 8 bits, ``floor(255 c + 0.5)`` in float32;
    then as ``i420_from_rgb``. Raises ``InvalidInput`` for another shape or dtype, and for NaN or
    infinity, saying how many.
    """
    _require_picture("colour", colour, np.float32)
    out = I420.empty((colour.shape[1], colour.shape[0]))
    bad = _native.i420_from_colour(np.ascontiguousarray(colour), *out.planes)
    if bad:
        raise InvalidInput(
            "colour", f"{bad} of {colour.size} values are NaN or infinite; repair the render"
        )
    return out


def field_view_from_view(view: View, camera: Camera) -> FieldView:
    """Return ``view``, rendered from ``camera``, with its colours as a codec picture.

    Raises ``InvalidInput`` for colours or depth that are not finite or not of the camera's size.
    """
    return FieldView(camera, i420_from_colour(view.colour), view.depth, view.opacity)


def rgb_from_i420(picture: I420) -> Rgb:
    """Convert I420 to uint8 [H, W, 3]."""
    width_px, height_px = picture.size_px
    rgb = np.empty((height_px, width_px, 3), np.uint8)
    _native.rgb_from_i420(*picture.dense_planes(), rgb)
    return rgb


def _require_picture(name: str, array: NDArray[np.generic], dtype: type[np.generic]) -> None:
    if array.ndim != 3 or array.shape[2] != 3 or 0 in array.shape:
        raise InvalidInput(name, f"shape {array.shape} must be [H, W, 3] with H, W >= 1")
    if array.dtype != dtype:
        raise InvalidInput(name, f"dtype {array.dtype} must be {np.dtype(dtype)}")
