"""The savings figure as the method was published, for comparison with the published tables.

A two-frame clip, render then camera frame, goes through x264 with the preset's own defaults: one
frame a second, the same CRF for both, picture types left to the encoder. The figure is
``100 I / (I + P)`` in bytes of the slices, parameter sets and SEI left out.

It says little about bytes saved: it divides by a picture nobody sends, so P = I reads 50 %, and
spending more on the unsent picture raises it. ``rfedge.demo.measure`` has the figure at
equal quality.
"""

from __future__ import annotations

from dataclasses import dataclass

from rfcore.codec.h264.bitstream import NAL_IDR, NAL_P, nal_type, parse_slice_start, split_nals
from rfcore.codec.h264.config import CodecConfig, effort_of_preset
from rfcore.codec.h264.ffmpeg import EncoderOptions, PictureKind, encode_pictures
from rfcore.errors import CodecError, InvalidInput
from rfcore.image import I420

_TYPES = ("P", "B", "I")


@dataclass(frozen=True)
class PaperSavings:
    """Slice bytes of both pictures, start codes left out, and the type x264 chose for the second.

    ``second_type`` is "P", "B", "I" or "IDR"; x264 codes the second picture as "I" when the render
    helps too little.
    """

    i_bytes: int
    p_bytes: int
    second_type: str

    @property
    def percent(self) -> float:
        """100 I / (I + P), whatever the type of the second picture."""
        return 100.0 * self.i_bytes / (self.i_bytes + self.p_bytes)


def published_clip(camera: I420, render: I420, preset: str, crf: float) -> tuple[bytes, bytes]:
    """Code the published two-frame clip; return the access units of render and camera.

    Raises ``InvalidInput`` for pictures of different sizes, a size, preset or CRF outside
    ``CodecConfig``, ``CodecError`` if x264 fails.
    """
    if camera.size_px != render.size_px:
        raise InvalidInput("camera", f"{camera.size_px} px where the render has {render.size_px}")
    options = _published_options(camera.size_px, preset, crf)
    clip = [(render, PictureKind.CHOSEN), (camera, PictureKind.CHOSEN)]
    first, second = encode_pictures(options, clip)
    return first, second


def intra_alone(camera: I420, preset: str, crf: float) -> bytes:
    """Code the camera frame alone with the published options; return its access unit."""
    options = _published_options(camera.size_px, preset, crf)
    (unit,) = encode_pictures(options, [(camera, PictureKind.CHOSEN)])
    return unit


def savings_of_clip(clip: tuple[bytes, bytes]) -> PaperSavings:
    """Return the sizes of a published clip's slices."""
    first, second = map(slice_nals, clip)
    return PaperSavings(sum(map(len, first)), sum(map(len, second)), _type_of(second[0]))


def paper_savings(camera: I420, render: I420, preset: str, crf: float) -> PaperSavings:
    """Code the published two-frame clip and return its sizes; raises as ``published_clip``."""
    return savings_of_clip(published_clip(camera, render, preset, crf))


def slice_nals(access_unit: bytes) -> list[bytes]:
    """Return the slices of an access unit; raise ``CodecError`` if it has none."""
    nals = [nal for nal in split_nals(access_unit) if nal_type(nal) in (NAL_P, NAL_IDR)]
    if not nals:
        raise CodecError(f"access unit of {len(access_unit)} bytes holds no slice")
    return nals


def _published_options(size_px: tuple[int, int], preset: str, crf: float) -> EncoderOptions:
    config = CodecConfig(*size_px, effort_of_preset(preset), crf)
    return EncoderOptions(
        config.coded_size_px, preset, crf, params={"threads": "1"}, tune=None, rate_hz=1
    )


def _type_of(nal: bytes) -> str:
    if nal_type(nal) == NAL_IDR:
        return "IDR"
    # Only the slice type is of interest here; it precedes frame_num.
    return _TYPES[parse_slice_start(nal).slice_type]
