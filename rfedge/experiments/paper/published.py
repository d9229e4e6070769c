"""The experiment as published, frame by frame: rows as its tables need them.

``published_rows`` codes the two-frame clip of ``rfedge.experiments.paper.savings`` at every size,
preset and CRF; the camera frame alone, coded the same way, says what an I picture of it costs.
Nothing here is our own coding. PSNR and SSIM are of RGB, without the encoder's padding.
``downscaled`` renders and frames are made at the drive's size and reduced together, as published;
``native`` renders are made at the small size, which is what a vehicle would do.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from rfcore.codec.h264.config import CodecConfig, effort_of_preset
from rfcore.codec.h264.ffmpeg import decode_clip
from rfcore.errors import InvalidInput
from rfcore.extras import needs
from rfcore.image import I420, Rgb
from rfcore.metrics import psnr
from rfcore.native.yuv import i420_from_rgb, rgb_from_i420
from rfedge.experiments.paper.savings import (
    intra_alone,
    published_clip,
    savings_of_clip,
    slice_nals,
)
from rfedge.experiments.picture_quality import RenderQuality, colour_ssim, render_quality

with needs("eval"):
    import cv2

__all__ = [
    "PUBLISHED_CRFS",
    "PUBLISHED_PRESETS",
    "PublishedFrame",
    "Setting",
    "published_rows",
    "reduced",
]


PUBLISHED_PRESETS = ("veryslow", "medium", "veryfast")
PUBLISHED_CRFS = (18.0, 23.0, 28.0)
Size = tuple[int, int]
Making = Literal["downscaled", "native"]


@dataclass(frozen=True)
class PublishedFrame:
    """A camera frame, and how its render is made for a size: uint8 RGB [H, W, 3]."""

    name: str
    camera: Rgb
    render: Callable[[Size, Making], Rgb]


@dataclass(frozen=True)
class Setting:
    """One combination of what the published averages run over."""

    size_px: Size
    making: Making
    preset: str
    crf: float


def published_rows(frame: PublishedFrame, settings: Sequence[Setting]) -> Iterator[dict[str, Any]]:
    """Yield a row per setting. Raises ``InvalidInput`` for a size larger than the frame."""
    pairs: dict[tuple[Size, Making], _Pair] = {}
    alone: dict[tuple[Size, str, float], tuple[int, float]] = {}
    for setting in settings:
        made = (setting.size_px, setting.making)
        if made not in pairs:
            pairs[made] = _pair(frame, *made)
        camera, render, quality = pairs[made]
        coding = (setting.size_px, setting.preset, setting.crf)
        if coding not in alone:
            alone[coding] = _alone(camera, setting)
        yield {
            "width": setting.size_px[0],
            "height": setting.size_px[1],
            "render": setting.making,
            "preset": setting.preset,
            "crf": setting.crf,
            "frame": frame.name,
            **_coded(camera, render, setting),
            "camera_i_bytes": alone[coding][0],
            "camera_i_psnr_db": alone[coding][1],
            "rf_psnr_db": quality.psnr_db,
            "rf_ssim": quality.ssim,
            "rf_residual_bands": list(quality.bands),
        }


_Pair = tuple[Rgb, Rgb, RenderQuality]


def _pair(frame: PublishedFrame, size_px: Size, making: Making) -> _Pair:
    camera, render = reduced(frame.camera, size_px), frame.render(size_px, making)
    return camera, render, render_quality(render, camera)


def _alone(camera: Rgb, setting: Setting) -> tuple[int, float]:
    """Return slice bytes and PSNR of the camera frame coded by itself."""
    unit = intra_alone(i420_from_rgb(camera), setting.preset, setting.crf)
    shown = rgb_from_i420(_decoded((unit,), setting)[0])
    return sum(map(len, slice_nals(unit))), psnr(shown, camera)


def reduced(picture: Rgb, size_px: Size) -> Rgb:
    """Return the picture at a smaller size, each pixel the mean of the area it covers."""
    height, width = picture.shape[:2]
    if size_px == (width, height):
        return picture
    if size_px[0] > width or size_px[1] > height:
        raise InvalidInput("size", f"{size_px} px is larger than the frame's {(width, height)} px")
    smaller: Rgb = cv2.resize(picture, size_px, interpolation=cv2.INTER_AREA).astype(np.uint8)
    return smaller


def _coded(camera: Rgb, render: Rgb, setting: Setting) -> dict[str, Any]:
    frame, reference = i420_from_rgb(camera), i420_from_rgb(render)
    clip = published_clip(frame, reference, setting.preset, setting.crf)
    sizes = savings_of_clip(clip)
    first, second = (rgb_from_i420(picture) for picture in _decoded(clip, setting))
    return {
        "i_bytes": sizes.i_bytes,
        "p_bytes": sizes.p_bytes,
        "second_type": sizes.second_type,
        "header_bytes": sum(map(len, clip)) - sizes.i_bytes - sizes.p_bytes,
        "savings_percent": sizes.percent,
        "i_psnr_db": psnr(first, render),
        "psnr_db": psnr(second, camera),
        "ssim": colour_ssim(second, camera),
    }


def _decoded(clip: Sequence[bytes], setting: Setting) -> list[I420]:
    config = CodecConfig(*setting.size_px, effort_of_preset(setting.preset), setting.crf)
    width, height = setting.size_px
    pictures = decode_clip(config.coded_size_px, clip)
    return [I420(p.y[:height, :width], p.u, p.v) for p in pictures]
