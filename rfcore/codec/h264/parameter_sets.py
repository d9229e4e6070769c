"""Parsers of the sequence and picture parameter sets, and of the first fields of a slice.

Only the parts of ITU-T H.264 (08/2021) that x264 writes for progressive 8-bit 4:2:0 are read: a
set that uses another part (scaling matrices, slice groups, picture order count type 1, HRD) raises
``BitstreamError``, as does one that is cut short or has bits left over.
"""

from __future__ import annotations

from dataclasses import dataclass

from rfcore.codec.h264.bitstream import BitReader, rbsp_of_nal
from rfcore.errors import BitstreamError

__all__ = [
    "NAL_IDR",
    "NAL_P",
    "NAL_PPS",
    "NAL_SPS",
    "PictureParameters",
    "SequenceParameters",
    "SliceStart",
    "Vui",
    "nal_type",
    "parse_pps",
    "parse_slice_start",
    "parse_sps",
]

NAL_P, NAL_IDR, NAL_SPS, NAL_PPS = 1, 5, 7, 8
_EXTENDED_SAR = 255
_HIGH_PROFILES = frozenset({100, 110, 122, 244})
_MAX_HEADER_BYTES = 64
"""Longest parameter set or slice header that is read."""


@dataclass(frozen=True)
class Vui:
    """Video usability information (annex E); ``None`` where the stream has no value."""

    full_range: bool | None = None
    primaries_transfer_matrix: tuple[int, int, int] | None = None
    chroma_location: int | None = None
    reorder_frames: int | None = None
    buffered_frames: int | None = None


@dataclass(frozen=True)
class SequenceParameters:
    """A sequence parameter set (7.3.2.1.1). ``crop_px`` is left, right, top, bottom in luma."""

    profile_idc: int
    constraint_flags: int
    level_idc: int
    sps_id: int
    chroma_format_idc: int
    bit_depths: tuple[int, int]
    log2_max_frame_num: int
    poc_type: int
    max_num_ref_frames: int
    frame_num_gaps_allowed: bool
    width_mbs: int
    height_mbs: int
    frame_mbs_only: bool
    direct_8x8_inference: bool
    crop_px: tuple[int, int, int, int]
    vui: Vui

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height) after cropping."""
        left, right, top, bottom = self.crop_px
        return (16 * self.width_mbs - left - right, 16 * self.height_mbs - top - bottom)


@dataclass(frozen=True)
class PictureParameters:
    """A picture parameter set (7.3.2.2)."""

    pps_id: int
    sps_id: int
    cabac: bool
    bottom_field_order: bool
    default_refs: tuple[int, int]
    weighted_pred: bool
    weighted_bipred_idc: int
    init_qp: int
    init_qs: int
    chroma_qp_offsets: tuple[int, int]
    deblocking_control: bool
    constrained_intra: bool
    redundant_pictures: bool
    transform_8x8: bool


@dataclass(frozen=True)
class SliceStart:
    """The first fields of a slice header (7.3.3); ``slice_type`` is 0 P, 1 B, 2 I (table 7-6)."""

    first_mb: int
    slice_type: int
    pps_id: int
    frame_num: int


def nal_type(nal: bytes) -> int:
    """Return nal_unit_type (table 7-1); raise for an empty unit or a set forbidden_zero_bit."""
    if not nal or nal[0] & 0x80:
        raise BitstreamError("NAL unit is empty or its forbidden_zero_bit is set")
    return nal[0] & 0x1F


def parse_sps(nal: bytes) -> SequenceParameters:
    """Parse a sequence parameter set NAL unit to its last bit."""
    r = _open(nal, NAL_SPS)
    profile_idc, constraint_flags, level_idc, sps_id = r.u(8), r.u(8), r.u(8), r.ue()
    chroma_format_idc, bit_depths = _read_chroma_format(r, profile_idc)
    log2_max_frame_num = r.ue() + 4
    poc_type = _read_poc_type(r)
    refs, gaps = r.ue(), r.flag()
    width_mbs, height_mbs = r.ue() + 1, r.ue() + 1
    frame_mbs_only = r.flag()
    if not frame_mbs_only:
        raise BitstreamError("interlaced coding is not used here")
    sps = SequenceParameters(
        profile_idc=profile_idc,
        constraint_flags=constraint_flags,
        level_idc=level_idc,
        sps_id=sps_id,
        chroma_format_idc=chroma_format_idc,
        bit_depths=bit_depths,
        log2_max_frame_num=log2_max_frame_num,
        poc_type=poc_type,
        max_num_ref_frames=refs,
        frame_num_gaps_allowed=gaps,
        width_mbs=width_mbs,
        height_mbs=height_mbs,
        frame_mbs_only=frame_mbs_only,
        direct_8x8_inference=r.flag(),
        crop_px=_read_crop(r),
        vui=_read_vui(r) if r.flag() else Vui(),
    )
    r.stop()
    return sps


def parse_pps(nal: bytes) -> PictureParameters:
    """Parse a picture parameter set NAL unit to its last bit."""
    r = _open(nal, NAL_PPS)
    pps_id, sps_id, cabac, bottom_field_order = r.ue(), r.ue(), r.flag(), r.flag()
    if r.ue() != 0:
        raise BitstreamError("slice groups are not used here")
    default_refs = (r.ue() + 1, r.ue() + 1)
    weighted_pred, weighted_bipred_idc = r.flag(), r.u(2)
    init_qp, init_qs, chroma_offset = 26 + r.se(), 26 + r.se(), r.se()
    deblocking_control, constrained_intra, redundant = r.flag(), r.flag(), r.flag()
    transform_8x8, second_offset = _read_pps_extension(r, chroma_offset)
    r.stop()
    return PictureParameters(
        pps_id=pps_id,
        sps_id=sps_id,
        cabac=cabac,
        bottom_field_order=bottom_field_order,
        default_refs=default_refs,
        weighted_pred=weighted_pred,
        weighted_bipred_idc=weighted_bipred_idc,
        init_qp=init_qp,
        init_qs=init_qs,
        chroma_qp_offsets=(chroma_offset, second_offset),
        deblocking_control=deblocking_control,
        constrained_intra=constrained_intra,
        redundant_pictures=redundant,
        transform_8x8=transform_8x8,
    )


def parse_slice_start(nal: bytes, log2_max_frame_num: int) -> SliceStart:
    """Parse the first four fields of a slice; what follows is left to the decoder."""
    if nal_type(nal) not in (NAL_P, NAL_IDR):
        raise BitstreamError(f"NAL unit type {nal_type(nal)} is not a slice")
    r = BitReader(rbsp_of_nal(nal)[:_MAX_HEADER_BYTES])
    first_mb, slice_type, pps_id = r.ue(), r.ue(), r.ue()
    if slice_type > 9:
        raise BitstreamError(f"slice type {slice_type} is above 9")
    return SliceStart(first_mb, slice_type % 5, pps_id, r.u(log2_max_frame_num))


def _open(nal: bytes, expected_type: int) -> BitReader:
    if nal_type(nal) != expected_type:
        raise BitstreamError(f"NAL unit type {nal_type(nal)} where {expected_type} is expected")
    if len(nal) > _MAX_HEADER_BYTES:
        raise BitstreamError(f"parameter set of {len(nal)} bytes is above {_MAX_HEADER_BYTES}")
    return BitReader(rbsp_of_nal(nal))


def _read_chroma_format(r: BitReader, profile_idc: int) -> tuple[int, tuple[int, int]]:
    if profile_idc not in _HIGH_PROFILES:
        return 1, (8, 8)
    chroma_format_idc = r.ue()
    if chroma_format_idc == 3:
        raise BitstreamError("4:4:4 sampling is not used here")
    bit_depths = (r.ue() + 8, r.ue() + 8)
    if r.flag() or r.flag():
        raise BitstreamError("lossless transform bypass and scaling matrices are not used here")
    return chroma_format_idc, bit_depths


def _read_poc_type(r: BitReader) -> int:
    poc_type = r.ue()
    if poc_type == 0:
        r.ue()
    elif poc_type != 2:
        raise BitstreamError(f"picture order count type {poc_type} is not used here")
    return poc_type


def _read_crop(r: BitReader) -> tuple[int, int, int, int]:
    if not r.flag():
        return (0, 0, 0, 0)
    return (2 * r.ue(), 2 * r.ue(), 2 * r.ue(), 2 * r.ue())


def _read_vui(r: BitReader) -> Vui:
    """Read vui_parameters (E.1.1)."""
    if r.flag() and r.u(8) == _EXTENDED_SAR:
        r.u(32)
    if r.flag():
        r.flag()
    full_range, colour = _read_signal_type(r) if r.flag() else (None, None)
    chroma_location = _read_chroma_location(r) if r.flag() else None
    if r.flag():
        r.u(65)  # time scale and the fixed rate flag
    if r.flag() or r.flag():
        raise BitstreamError("HRD parameters are not used here")
    r.flag()
    reorder, buffered = _read_restriction(r) if r.flag() else (None, None)
    return Vui(full_range, colour, chroma_location, reorder, buffered)


def _read_signal_type(r: BitReader) -> tuple[bool, tuple[int, int, int] | None]:
    r.u(3)
    full_range = r.flag()
    return full_range, (r.u(8), r.u(8), r.u(8)) if r.flag() else None


def _read_chroma_location(r: BitReader) -> int:
    top, bottom = r.ue(), r.ue()
    if top != bottom:
        raise BitstreamError(f"chroma locations {top} and {bottom} of the two fields differ")
    return top


def _read_restriction(r: BitReader) -> tuple[int, int]:
    r.flag()
    for _ in range(4):
        r.ue()
    return r.ue(), r.ue()


def _read_pps_extension(r: BitReader, chroma_offset: int) -> tuple[bool, int]:
    if not r.more_rbsp_data():
        return False, chroma_offset
    transform_8x8 = r.flag()
    if r.flag():
        raise BitstreamError("scaling matrices are not used here")
    return transform_8x8, r.se()
