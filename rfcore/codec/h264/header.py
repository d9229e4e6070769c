"""The stream header: what a receiver must know before the first packet, and its check.

Every packet of a stream, at any effort, CRF and number of references, is coded under the same two
parameter sets, so they travel once. There are two forms. Ours depends on the size alone: a receiver
writes the sets itself and accepts no other byte. x264's, of ``--coder x264`` and of vehicles from
before there was a slice coder, is accepted when it says what our settings make x264 write. Sets
decide how much memory and how many reference pictures a decoder holds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from rfcore.codec.h264.config import CodecConfig, Coder
from rfcore.codec.h264.parameter_set_writer import pps_nal, sps_nal
from rfcore.codec.h264.parameter_sets import (
    PictureParameters,
    SequenceParameters,
    Vui,
    parse_pps,
    parse_sps,
)
from rfcore.errors import BitstreamError, InvalidInput

__all__ = ["StreamHeader", "check_header", "own_header"]

_BT709 = (1, 1, 1)
_HIGH_PROFILE = 100
_CHROMA_IN_THE_MIDDLE = 1
"""Chroma sample location type (figure E-1), as ``rfcore.native.yuv`` averages."""
_LOG2_MAX_FRAME_NUM = 4

_OWN_PPS = PictureParameters(
    pps_id=0,
    sps_id=0,
    cabac=True,
    bottom_field_order=False,
    default_refs=(3, 1),
    weighted_pred=False,
    weighted_bipred_idc=0,
    init_qp=26,
    init_qs=26,
    chroma_qp_offsets=(0, 0),
    deblocking_control=True,
    constrained_intra=False,
    redundant_pictures=False,
    transform_8x8=True,
)
"""Three references is what most frames have: they need no override in the slice header."""
_X264_PPS = replace(_OWN_PPS, weighted_pred=True)


@dataclass(frozen=True)
class StreamHeader:
    """A stream's configuration with its SPS and PPS (NAL units without start codes)."""

    config: CodecConfig
    sps: bytes
    pps: bytes


def own_header(config: CodecConfig) -> StreamHeader:
    """Return the header of our slice coder, the same for every effort and CRF of a size."""
    return StreamHeader(config, sps_nal(_expected_sps(config)), pps_nal(_OWN_PPS))


def check_header(header: StreamHeader) -> SequenceParameters:
    """Return the parsed SPS; raise ``InvalidInput`` unless the coder it names makes this header."""
    try:
        sps, pps = parse_sps(header.sps), parse_pps(header.pps)
    except BitstreamError as error:
        raise InvalidInput("stream_header", f"unusable parameter set: {error}") from error
    is_own = header.config.coder is Coder.OWN
    _require_equal("stream_header.sps", sps, _expected_sps(header.config))
    _require_equal("stream_header.pps", pps, _OWN_PPS if is_own else _X264_PPS)
    if is_own and header != own_header(header.config):
        raise InvalidInput("stream_header", "its parameter sets are not, byte for byte, ours")
    return sps


def _expected_sps(config: CodecConfig) -> SequenceParameters:
    width_mbs, height_mbs = config.size_mbs
    width_px, height_px = config.coded_size_px
    return SequenceParameters(
        profile_idc=_HIGH_PROFILE,
        constraint_flags=0,
        level_idc=config.level_idc,
        sps_id=0,
        chroma_format_idc=1,
        bit_depths=(8, 8),
        log2_max_frame_num=_LOG2_MAX_FRAME_NUM,
        poc_type=2,
        max_num_ref_frames=config.reference_frames,
        frame_num_gaps_allowed=False,
        width_mbs=width_mbs,
        height_mbs=height_mbs,
        frame_mbs_only=True,
        direct_8x8_inference=True,
        crop_px=(0, 16 * width_mbs - width_px, 0, 16 * height_mbs - height_px),
        vui=Vui(
            full_range=False,
            primaries_transfer_matrix=_BT709,
            chroma_location=_CHROMA_IN_THE_MIDDLE,
            reorder_frames=0,
            buffered_frames=config.reference_frames,
        ),
    )


def _require_equal(field: str, got: object, expected: object) -> None:
    for name, want in vars(expected).items():
        have = getattr(got, name)
        if have != want:
            raise InvalidInput(f"{field}.{name}", f"{have} where our encoder writes {want}")
