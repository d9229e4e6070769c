"""The stream header: what a receiver must know before the first packet, and its check.

Every packet of a stream, at any effort, CRF and number of references, is coded under the same two
parameter sets, so they are sent once. There are two forms. Ours depends on the size alone: a
receiver writes the sets itself and accepts no other byte. Those of ``--coder x264`` are accepted
when they say what our settings make x264 write, because parameter sets decide how much memory and
how many reference pictures a decoder holds. Writing is the inverse of the parsers of
``parameter_sets``: what those refuse (interlaced pictures, scaling matrices, slice groups, HRD)
cannot be written. Clause numbers are those of ITU-T H.264 (08/2021).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from rfcore.codec.h264.bitstream import BitWriter, nal_of_rbsp
from rfcore.codec.h264.config import CodecConfig, Coder
from rfcore.codec.h264.parameter_sets import (
    NAL_PPS,
    NAL_SPS,
    PictureParameters,
    SequenceParameters,
    Vui,
    parse_pps,
    parse_sps,
)
from rfcore.errors import BitstreamError, InvalidInput

__all__ = ["StreamHeader", "check_header", "own_header", "pps_nal", "sps_nal"]

_NAL_REF_IDC = 3 << 5
_HIGH_PROFILE = 100
_POC_OF_DECODING_ORDER = 2
_CROP_UNIT_PX = 2
"""Unit of cropping 4:2:0 frames, in both directions (7.4.2.1.1)."""
_VIDEO_FORMAT_UNSPECIFIED = 5
_LOG2_MAX_MV_LENGTH = 15
"""The largest value that can be written (E.2.1); the level is stricter."""


def sps_nal(sps: SequenceParameters) -> bytes:
    """Return the NAL unit of a sequence parameter set (7.3.2.1.1).

    Raises ``InvalidInput`` for another profile than High, another chroma format than 4:2:0, more
    than 8 bits, another picture order count type than 2, or cropping by odd numbers.
    """
    if (sps.profile_idc, sps.chroma_format_idc, sps.bit_depths) != (_HIGH_PROFILE, 1, (8, 8)):
        raise InvalidInput("sps", "is not of High profile with 8 bits and 4:2:0")
    if sps.poc_type != _POC_OF_DECODING_ORDER:
        raise InvalidInput("sps.poc_type", f"{sps.poc_type} is not {_POC_OF_DECODING_ORDER}")
    w = BitWriter()
    w.u(8, sps.profile_idc).u(8, sps.constraint_flags).u(8, sps.level_idc).ue(sps.sps_id)
    w.ue(sps.chroma_format_idc).ue(0).ue(0)  # bit depths - 8
    w.u(1, 0).u(1, 0)  # no lossless transform bypass, no scaling matrices
    w.ue(sps.log2_max_frame_num - 4).ue(sps.poc_type)
    w.ue(sps.max_num_ref_frames).u(1, sps.frame_num_gaps_allowed)
    w.ue(sps.width_mbs - 1).ue(sps.height_mbs - 1)
    w.u(1, sps.frame_mbs_only).u(1, sps.direct_8x8_inference)
    _write_crop(w, sps.crop_px)
    _write_vui(w, sps.vui)
    return nal_of_rbsp(_NAL_REF_IDC | NAL_SPS, w.stop().to_bytes())


def pps_nal(pps: PictureParameters) -> bytes:
    """Return the NAL unit of a picture parameter set of one slice group (7.3.2.2)."""
    w = BitWriter()
    w.ue(pps.pps_id).ue(pps.sps_id).u(1, pps.cabac).u(1, pps.bottom_field_order).ue(0)
    w.ue(pps.default_refs[0] - 1).ue(pps.default_refs[1] - 1)
    w.u(1, pps.weighted_pred).u(2, pps.weighted_bipred_idc)
    w.se(pps.init_qp - 26).se(pps.init_qs - 26).se(pps.chroma_qp_offsets[0])
    w.u(1, pps.deblocking_control).u(1, pps.constrained_intra).u(1, pps.redundant_pictures)
    w.u(1, pps.transform_8x8).u(1, 0).se(pps.chroma_qp_offsets[1])
    return nal_of_rbsp(_NAL_REF_IDC | NAL_PPS, w.stop().to_bytes())


def _write_crop(w: BitWriter, crop_px: tuple[int, int, int, int]) -> None:
    w.u(1, any(crop_px))
    if any(crop_px):
        for side_px in crop_px:
            if side_px % _CROP_UNIT_PX:
                raise InvalidInput("sps.crop_px", f"{crop_px} must be even")
            w.ue(side_px // _CROP_UNIT_PX)


def _write_vui(w: BitWriter, vui: Vui) -> None:
    """Write vui_parameters (E.1.1), or that there are none if ``vui`` is empty."""
    w.u(1, vui != Vui())
    if vui == Vui():
        return
    w.u(1, 0).u(1, 0)  # no aspect ratio, no overscan
    _write_signal_type(w, vui)
    w.u(1, vui.chroma_location is not None)
    if vui.chroma_location is not None:
        w.ue(vui.chroma_location).ue(vui.chroma_location)
    w.u(1, 0).u(1, 0).u(1, 0).u(1, 0)  # no timing, no HRD of either kind, no pic_struct
    _write_restriction(w, vui)


def _write_signal_type(w: BitWriter, vui: Vui) -> None:
    w.u(1, vui.full_range is not None)
    if vui.full_range is None:
        return
    colour = vui.primaries_transfer_matrix
    w.u(3, _VIDEO_FORMAT_UNSPECIFIED).u(1, vui.full_range).u(1, colour is not None)
    for code in colour or ():
        w.u(8, code)


def _write_restriction(w: BitWriter, vui: Vui) -> None:
    """Write the bitstream restriction: no limit but the level's on vectors, bytes and bits."""
    w.u(1, vui.buffered_frames is not None)
    if vui.buffered_frames is None:
        return
    w.u(1, 1).ue(0).ue(0)  # vectors over picture boundaries; max_bytes and max_bits denominators
    w.ue(_LOG2_MAX_MV_LENGTH).ue(_LOG2_MAX_MV_LENGTH)
    w.ue(vui.reorder_frames or 0).ue(vui.buffered_frames)


_BT709 = (1, 1, 1)
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
"""The default is three references: most frames have three and then need no override."""
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
