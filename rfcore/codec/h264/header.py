"""The stream header: what a receiver must know before the first packet, and its check.

All packets of a stream, at any effort, CRF and number of references, use the same two parameter
sets. They depend on the coder and the size alone: a receiver writes them itself and accepts no
other byte, because parameter sets decide how much memory and how many reference pictures a decoder
holds. Those of x264 are written here as x264 writes them, which ``rfcore.codec.h264.slices``
checks. Clause numbers are those of ITU-T H.264 (08/2021).
"""

from __future__ import annotations

from dataclasses import dataclass

from rfcore.codec.h264.bitstream import (
    LOG2_MAX_FRAME_NUM,
    NAL_PPS,
    NAL_REF_IDC,
    NAL_SPS,
    BitWriter,
    nal_of_rbsp,
)
from rfcore.codec.h264.config import PICTURES_PER_SECOND, CodecConfig, Coder
from rfcore.errors import InvalidInput

DEFAULT_REFERENCES = 3
"""References of a slice without an override in its header; most frames have three."""
INIT_QP = 26

_HIGH_PROFILE = 100
_POC_OF_DECODING_ORDER = 2
_BT709 = 1
_CHROMA_IN_THE_MIDDLE = 1
"""Chroma sample location type (figure E-1), as ``rfcore.native.yuv`` averages."""
_VIDEO_FORMAT_UNSPECIFIED = 5
_LOG2_MAX_MV_LENGTH = 15
"""The largest value that can be written (E.2.1); the level is stricter."""


@dataclass(frozen=True)
class StreamHeader:
    """A stream's configuration with its SPS and PPS (NAL units without start codes)."""

    config: CodecConfig
    sps: bytes
    pps: bytes


def stream_header(config: CodecConfig) -> StreamHeader:
    """Return the header of a stream, the same for every effort of its coder and every CRF."""
    return StreamHeader(config, _sps(config), _pps(config))


def check_header(header: StreamHeader) -> None:
    """Raise ``InvalidInput`` unless the configured coder writes these parameter sets."""
    expected = stream_header(header.config)
    for name in ("sps", "pps"):
        have, want = getattr(header, name), getattr(expected, name)
        if have != want:
            raise InvalidInput(
                f"stream_header.{name}", f"{have.hex()} where our encoder writes {want.hex()}"
            )


def _sps(config: CodecConfig) -> bytes:
    """Return the sequence parameter set 0 (7.3.2.1.1)."""
    width_mbs, height_mbs = config.size_mbs
    w = BitWriter()
    w.u(8, _HIGH_PROFILE).u(8, 0).u(8, config.level_idc).ue(0)
    w.ue(1).ue(0).ue(0)  # 4:2:0, bit depths - 8
    w.u(1, 0).u(1, 0)  # no lossless transform bypass, no scaling matrices
    w.ue(LOG2_MAX_FRAME_NUM - 4).ue(_POC_OF_DECODING_ORDER)
    w.ue(config.reference_frames).u(1, 0)  # no gaps in frame_num
    w.ue(width_mbs - 1).ue(height_mbs - 1)
    w.u(1, 1).u(1, 1)  # progressive, direct_8x8_inference_flag
    _write_crop(w, config)
    _write_vui(w, config)
    return nal_of_rbsp(NAL_REF_IDC | NAL_SPS, w.stop().to_bytes())


def _write_crop(w: BitWriter, config: CodecConfig) -> None:
    """Write the cropping at the right and at the bottom, in units of two samples."""
    width_px, height_px = config.coded_size_px
    width_mbs, height_mbs = config.size_mbs
    right, bottom = (16 * width_mbs - width_px) // 2, (16 * height_mbs - height_px) // 2
    w.u(1, right > 0 or bottom > 0)
    if right or bottom:
        w.ue(0).ue(right).ue(0).ue(bottom)


def _write_vui(w: BitWriter, config: CodecConfig) -> None:
    """Write vui_parameters (E.1.1): colours, and that no picture is held back."""
    is_x264 = config.coder is Coder.X264
    w.u(1, 1)
    w.u(1, 0).u(1, 0)  # no aspect ratio, no overscan
    w.u(1, 1).u(3, _VIDEO_FORMAT_UNSPECIFIED).u(1, 0)  # limited range
    w.u(1, 1).u(8, _BT709).u(8, _BT709).u(8, _BT709)  # primaries, transfer, matrix
    w.u(1, 1).ue(_CHROMA_IN_THE_MIDDLE).ue(_CHROMA_IN_THE_MIDDLE)
    w.u(1, is_x264)
    if is_x264:
        w.u(32, 1).u(32, PICTURES_PER_SECOND).u(1, 1)  # units in a tick, time scale, fixed rate
    w.u(1, 0).u(1, 0).u(1, 0)  # no HRD of either kind, no pic_struct
    mv_length = config.vertical_range.bit_length() + 1 if is_x264 else _LOG2_MAX_MV_LENGTH
    w.u(1, 1).u(1, 1)  # bitstream restriction; vectors over picture boundaries
    w.ue(0).ue(0)  # max_bytes and max_bits denominators: no limit but the level's
    w.ue(mv_length).ue(mv_length)
    w.ue(0).ue(config.reference_frames)  # no reordering, decoded picture buffer


def _pps(config: CodecConfig) -> bytes:
    """Return the picture parameter set 0 (7.3.2.2)."""
    w = BitWriter()
    w.ue(0).ue(0).u(1, 1).u(1, 0).ue(0)  # CABAC, no field order, one slice group
    w.ue(DEFAULT_REFERENCES - 1).ue(0)
    w.u(1, config.coder is Coder.X264).u(2, 0)  # weighted prediction of P and B slices
    w.se(INIT_QP - 26).se(0).se(0)  # init_qp, init_qs, chroma_qp_index_offset
    w.u(1, 1)  # deblocking_filter_control_present_flag
    w.u(1, 0).u(1, 0)  # constrained_intra_pred_flag, redundant_pic_cnt_present_flag
    w.u(1, 1).u(1, 0).se(0)  # 8x8 transforms, no scaling matrices, second chroma offset
    return nal_of_rbsp(NAL_REF_IDC | NAL_PPS, w.stop().to_bytes())
