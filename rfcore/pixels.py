"""Decoded frames as 8-bit sRGB: alpha, linear light, HDR, wide gamut, 16 bits, odd-sided chroma.

Every picture and video frame passes here; nothing else decides what its numbers mean.

* **Alpha.** The colour is composed over black, in linear light where the file is linear.
* **Linear light** (floating point, or tagged so) gets the sRGB curve; above 1 is white.
* **HLG and PQ** (ITU-R BT.2100) become BT.709 as a BT.1886 display (gamma 2.4) shows it. Their
  reference white, 203 cd/m2 (ITU-R BT.2408), is white and what is brighter too. HLG's system gamma
  1.2 is applied to each channel, as FFmpeg's zscale does.
* **BT.2020 and P3 primaries** become BT.709's, by the transfer that goes with them. Other transfers
  are taken as they are, as displays and browsers do with BT.709 and sRGB.
* **More than 8 bits** are rounded to nearest, without dither.
* **Chroma** is interpolated linearly. swscale does that at even sizes only, so odd ones get one
  column or row more for it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import av
import numpy as np
from av.error import FFmpegError
from av.video.reformatter import ColorRange, ColorTrc, Interpolation
from numpy.typing import NDArray

from rfcore.errors import DatasetError

F32 = NDArray[np.float32]
Levels = NDArray[np.unsignedinteger[Any]]

EXACT_CONVERSION = (
    Interpolation.BILINEAR | Interpolation.FULL_CHR_H_INT | Interpolation.ACCURATE_RND
)
"""swscale's faster modes darken a JPEG's green by 0.9 levels on average, this one by 0.02."""
OPAQUE = 250
"""From this alpha of 255 on, a pixel is taken for opaque: black behind it takes 2 %."""
WHITE_CD_M2 = 203.0
"""Luminance that white of HDR pictures shows, ITU-R BT.2408."""
UNREAD = {
    ColorTrc.LOG: "logarithmic",
    ColorTrc.LOG_SQRT: "logarithmic",
    ColorTrc.SMPTE428: "SMPTE 428",
}
HDR = {ColorTrc.SMPTE2084: "PQ", ColorTrc.ARIB_STD_B67: "HLG"}
# CIE xy of red, green and blue by ITU-T H.273's code; white is D65 (DCI-P3's own white is not).
BT709 = ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06))
WIDE = {
    9: ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046)),
    12: ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060)),
}
D65 = (0.3127, 0.3290)


@dataclass(frozen=True)
class Pixels:
    """``rgb`` uint8 [H, W, 3]; ``opaque`` bool [H, W], ``None`` without an alpha channel."""

    rgb: NDArray[np.uint8]
    opaque: NDArray[np.bool_] | None = None


def pixels_of(frame: av.VideoFrame, source: str, matrix: int | None = None) -> Pixels:
    """Return a frame's pixels; ``matrix`` (ITU-T H.273) replaces the one that it states.

    Raises ``DatasetError`` naming ``source`` for a matrix or transfer that is not read, and for
    floating point that is not finite.
    """
    transfer, is_float = _transfer(frame), _is_float(frame.format)
    if transfer in UNREAD:
        raise DatasetError(
            f"{source}: {UNREAD[ColorTrc(transfer)]} transfer is not read; save it as sRGB"
        )
    is_as_shown = treatment(frame) is None
    if is_float:
        levels, white = _floats(frame, source), 65535
    else:
        levels, white = _integers(frame, source, matrix, is_as_shown=is_as_shown)
    rgb = levels[..., :3]
    rgb = (
        _rounded(rgb, white)
        if is_as_shown
        else _as_srgb(rgb, white, transfer, frame.color_primaries)
    )
    if levels.shape[2] == 3:
        return Pixels(np.ascontiguousarray(rgb, np.uint8))
    alpha = _rounded(levels[..., 3], white)
    if not is_float:  # OpenEXR's colours are multiplied by alpha already
        rgb = (rgb.astype(np.uint16) * alpha[..., None] + 127) // 255
    return Pixels(np.ascontiguousarray(rgb, np.uint8), alpha >= OPAQUE)


def has_alpha(pixel_format: av.VideoFormat) -> bool:
    """Return whether pixels may be transparent."""
    return pixel_format.has_palette or any(part.is_alpha for part in pixel_format.components)


def treatment(frame: av.VideoFrame) -> str | None:
    """Return what the frame is that is converted into sRGB, ``None`` for what is taken as it is."""
    transfer = _transfer(frame)
    if transfer == ColorTrc.LINEAR:
        return "linear"
    if transfer in HDR:
        return HDR[ColorTrc(transfer)]
    return "wide gamut" if frame.color_primaries in WIDE else None


def _transfer(frame: av.VideoFrame) -> int:
    is_unsaid = frame.color_trc == ColorTrc.UNSPECIFIED
    return ColorTrc.LINEAR if is_unsaid and _is_float(frame.format) else frame.color_trc


def _is_float(pixel_format: av.VideoFormat) -> bool:
    return any(kind in pixel_format.name for kind in ("f16", "f32"))


def _floats(frame: av.VideoFrame, source: str) -> Levels:
    """Return planes of floating point, 0..1 and clipped to it, as 16 bits [H, W, C]."""
    name = frame.format.name
    if not name.startswith(("gbr", "gray")):
        raise DatasetError(f"{source}: pixels of {name} are not read; save it as sRGB of 8 bits")
    kind = f"{'>' if name.endswith('be') else '<'}f{2 if 'f16' in name else 4}"
    planes = [
        np.frombuffer(bytes(plane), kind).reshape(frame.height, -1)[:, : frame.width]
        for plane in frame.planes
    ]
    planes = [planes[2], *planes[:2], *planes[3:]] if name.startswith("gbr") else planes * 3
    values = np.stack(planes, axis=-1).astype(np.float32)
    if not np.isfinite(values).all():
        raise DatasetError(f"{source}: has NaN or infinite values; save it as sRGB of 8 bits")
    return np.asarray(np.clip(values, 0, 1) * np.float32(65535) + np.float32(0.5), np.uint16)


def _integers(
    frame: av.VideoFrame, source: str, matrix: int | None, *, is_as_shown: bool
) -> tuple[Levels, int]:
    """Return 8 or 16 bits [H, W, C] of other frames, and the level of white.

    swscale dithers RGB of 16 bits, but not YUV. Its 16 bits of YUV are YUV's bits, shifted, so
    that full range of more than 8 bits, which it converts as if it were shifted too, goes this way.
    """
    parts, with_alpha = frame.format.components, has_alpha(frame.format)
    bits, is_full = max(part.bits for part in parts), frame.color_range == ColorRange.JPEG
    height, width = frame.height, frame.width
    to, white = ("rgba" if with_alpha else "rgb24"), 255
    if any(part.is_chroma and not frame.format.is_rgb for part in parts):
        if not is_as_shown or (is_full and bits > 8):
            to, white = ("gbrap16le" if with_alpha else "gbrp16le"), 65280
            if is_full:
                white = (1 << 16) - (1 << 16 - bits)
    elif bits > 8:
        to, white = ("rgba64le" if with_alpha else "rgb48le"), 65535
    chroma = (frame.format.chroma_width(width), frame.format.chroma_height(height))
    try:
        if chroma != (width, height) and (height % 2 or width % 2):
            frame = _of_even_sides(frame)
        shown = frame.reformat(format=to, src_colorspace=matrix, interpolation=EXACT_CONVERSION)
    except (FFmpegError, OSError, ValueError) as error:
        raise DatasetError(
            f"{source}: {frame.format.name} with colour matrix {int(frame.colorspace)} of ITU-T "
            f"H.273 is not read ({error}); save it as sRGB"
        ) from error
    return np.asarray(shown.to_ndarray()[:height, :width]), white


def _of_even_sides(frame: av.VideoFrame) -> av.VideoFrame:
    """Return the frame with a column and a row more where it has an odd number."""
    even = av.VideoFrame(
        frame.width + frame.width % 2, frame.height + frame.height % 2, frame.format.name
    )
    for name in ("colorspace", "color_range", "color_trc", "color_primaries"):
        setattr(even, name, getattr(frame, name))
    for plane, other in zip(frame.planes, even.planes, strict=True):
        rows = np.frombuffer(bytes(plane), np.uint8).reshape(-1, plane.line_size)
        copied = np.zeros((other.height, other.line_size), np.uint8)
        width = min(plane.line_size, other.line_size)
        copied[: plane.height, :width] = rows[: plane.height, :width]
        other.update(copied.tobytes())
    return even


def _rounded(levels: Levels, white: int) -> NDArray[np.uint8]:
    """Return levels up to ``white`` as 8 bits, rounded to nearest."""
    if white == 255:
        return np.asarray(levels, np.uint8)
    return np.asarray(
        np.minimum((levels.astype(np.uint32) * 255 + white // 2) // white, 255), np.uint8
    )


def _as_srgb(levels: Levels, white: int, transfer: int, primaries: int) -> NDArray[np.uint8]:
    """Return 8-bit sRGB of samples that show something else."""
    light = _light_of(transfer, white)[levels]
    if primaries in WIDE:
        light = light @ _to_bt709(primaries).T
    is_srgb = transfer in (ColorTrc.LINEAR, ColorTrc.IEC61966_2_1)
    return _coded(is_srgb)[_sixteen_bits(light)]


def _sixteen_bits(light: F32) -> NDArray[np.uint16]:
    return np.asarray(np.clip(light, 0, 1) ** np.float32(0.5) * 65535 + 0.5, np.uint16)


@lru_cache(maxsize=8)
def _light_of(transfer: int, white: int) -> F32:
    """Return the light of each level, 1 where it is as bright as white."""
    code = np.minimum(np.arange(256 if white == 255 else 65536) / white, 1)
    if transfer == ColorTrc.SMPTE2084:
        root = code ** (32 / 2523)
        light = (np.maximum(root - 0.8359375, 0) / (18.8515625 - 18.6875 * root)) ** (16384 / 2610)
        light *= 10_000 / WHITE_CD_M2
    elif transfer == ColorTrc.ARIB_STD_B67:
        a, b, c = 0.17883277, 0.28466892, 0.55991073
        scene = np.where(code <= 0.5, code**2 / 3, (np.exp((code - c) / a) + b) / 12)
        light = scene**1.2 * 1000 / WHITE_CD_M2
    elif transfer == ColorTrc.IEC61966_2_1:
        light = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
    else:
        light = code if transfer == ColorTrc.LINEAR else code**2.4
    return light.astype(np.float32)


@lru_cache(maxsize=2)
def _coded(is_srgb: bool) -> NDArray[np.uint8]:
    """Return the level of light by its square root in 16 bits: fine steps where it is dark."""
    light = (np.arange(65536) / 65535) ** 2
    srgb = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.asarray((srgb if is_srgb else light ** (1 / 2.4)) * 255 + 0.5, np.uint8)


@lru_cache(maxsize=2)
def _to_bt709(primaries: int) -> F32:
    return np.asarray(np.linalg.inv(_xyz_of(BT709)) @ _xyz_of(WIDE[primaries]), np.float32)


def _xyz_of(primaries: tuple[tuple[float, float], ...]) -> NDArray[np.float64]:
    """Return the matrix to CIE XYZ of primaries whose white is D65."""
    columns = np.array([(x / y, 1, (1 - x - y) / y) for x, y in (*primaries, D65)]).T
    return np.asarray(columns[:, :3] * np.linalg.solve(columns[:, :3], columns[:, 3]))
