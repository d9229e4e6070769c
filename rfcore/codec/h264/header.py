"""The stream header: what a receiver must know before the first packet, and its check.

Every packet of a stream, at any preset and CRF, is coded under the same two parameter sets, so
they travel once. A receiver accepts only sets that our encoder would have written for the size in
the configuration: they decide how much memory and how many reference pictures a decoder holds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from rfcore.codec.h264.config import REFERENCE_FRAMES, CodecConfig
from rfcore.codec.h264.parameter_sets import (
    PictureParameters,
    SequenceParameters,
    Vui,
    parse_pps,
    parse_sps,
)
from rfcore.errors import BitstreamError, InvalidInput

__all__ = ["StreamHeader", "check_header"]

_BT709 = (1, 1, 1)
_HIGH_PROFILE = 100
_CHROMA_IN_THE_MIDDLE = 1
"""Chroma sample location type (figure E-1), as ``rfcore.native.yuv`` averages."""

_PPS = PictureParameters(
    pps_id=0,
    sps_id=0,
    cabac=True,
    bottom_field_order=False,
    default_refs=(REFERENCE_FRAMES, 1),
    weighted_pred=True,
    weighted_bipred_idc=0,
    init_qp=26,
    init_qs=26,
    chroma_qp_offsets=(0, 0),
    deblocking_control=True,
    constrained_intra=False,
    redundant_pictures=False,
    transform_8x8=True,
)


@dataclass(frozen=True)
class StreamHeader:
    """A stream's configuration with its SPS and PPS (NAL units without start codes)."""

    config: CodecConfig
    sps: bytes
    pps: bytes


def check_header(header: StreamHeader) -> SequenceParameters:
    """Return the parsed SPS; raise ``InvalidInput`` unless our encoder makes such a header."""
    try:
        sps, pps = parse_sps(header.sps), parse_pps(header.pps)
    except BitstreamError as error:
        raise InvalidInput("stream_header", f"unusable parameter set: {error}") from error
    _require_equal("stream_header.sps", sps, _expected_sps(header.config, sps))
    _require_equal("stream_header.pps", pps, _PPS)
    return sps


def _expected_sps(config: CodecConfig, sps: SequenceParameters) -> SequenceParameters:
    width_mbs, height_mbs = config.size_mbs
    width_px, height_px = config.coded_size_px
    return replace(
        sps,
        profile_idc=_HIGH_PROFILE,
        constraint_flags=0,
        level_idc=config.level_idc,
        sps_id=0,
        chroma_format_idc=1,
        bit_depths=(8, 8),
        log2_max_frame_num=4,
        poc_type=2,
        max_num_ref_frames=REFERENCE_FRAMES,
        frame_num_gaps_allowed=False,
        width_mbs=width_mbs,
        height_mbs=height_mbs,
        crop_px=(0, 16 * width_mbs - width_px, 0, 16 * height_mbs - height_px),
        direct_8x8_inference=True,
        vui=Vui(
            full_range=False,
            primaries_transfer_matrix=_BT709,
            chroma_location=_CHROMA_IN_THE_MIDDLE,
            reorder_frames=0,
            buffered_frames=REFERENCE_FRAMES,
        ),
    )


def _require_equal(field: str, got: object, expected: object) -> None:
    for name, want in vars(expected).items():
        have = getattr(got, name)
        if have != want:
            raise InvalidInput(f"{field}.{name}", f"{have} where our encoder writes {want}")
