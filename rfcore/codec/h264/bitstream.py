"""Bits, NAL units, starts of slices and the parameter sets of an H.264 stream.

Clause numbers are those of ITU-T H.264 (08/2021).

A NAL unit here is ``bytes`` without its start code: one header byte, then the payload with
emulation prevention bytes. An RBSP is that payload without them. Everything that reads raises
``BitstreamError`` and nothing else, whatever the bytes are.

The stream header is what a receiver must know before the first packet. All packets of a stream, at
any effort, CRF and number of references, use the same two parameter sets. They depend on the coder
and the size alone: a receiver writes them itself and accepts no other byte, because parameter sets
decide how much memory and how many reference pictures a decoder holds. Those of x264 are written
here as x264 writes them, which ``rfcore.codec.sender.picture_coder`` checks.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

from rfcore.codec.h264.config import PICTURES_PER_SECOND, CodecConfig, Coder
from rfcore.errors import BitstreamError, InvalidInput

NAL_P, NAL_IDR, NAL_SPS, NAL_PPS = 1, 5, 7, 8
NAL_REF_IDC = 3 << 5
"""nal_ref_idc 3 in the header byte of a NAL unit."""
LOG2_MAX_FRAME_NUM = 4
"""Bits of frame_num in the slice headers of all streams here."""

START_CODE = b"\x00\x00\x00\x01"
_START = re.compile(rb"\x00\x00\x01")
_FORBIDDEN = re.compile(rb"\x00\x00[\x00-\x02]")
_NEEDS_PREVENTION = re.compile(rb"\x00\x00(?=[\x00-\x03])")
_MAX_EXP_GOLOMB_ZEROS = 31


def split_nals(stream: bytes) -> list[bytes]:
    """Return the NAL units of a byte stream (annex B); raise if it does not start with one."""
    starts = [match.start() for match in _START.finditer(stream)]
    if not starts or stream[: starts[0]].strip(b"\x00"):
        raise BitstreamError(f"byte stream of {len(stream)} bytes does not begin with a start code")
    ends = [*starts[1:], len(stream)]
    nals = [
        stream[start + 3 : end].rstrip(b"\x00") for start, end in zip(starts, ends, strict=True)
    ]
    if not all(nals):
        raise BitstreamError(f"NAL unit {nals.index(b'')} of the byte stream is empty")
    return nals


def join_nals(nals: Iterable[bytes]) -> bytes:
    """Return the byte stream of NAL units, each after a four-byte start code (annex B)."""
    return b"".join(START_CODE + nal for nal in nals)


def nal_of_rbsp(header: int, rbsp: bytes) -> bytes:
    """Return a NAL unit: the header byte and ``rbsp`` with emulation prevention (7.4.1.1).

    An RBSP ends with its stop bit, so one that is empty or ends in a zero byte is refused.
    """
    if not rbsp or rbsp[-1] == 0:
        raise InvalidInput("rbsp", "must end with the byte that holds its stop bit")
    return bytes([header]) + _NEEDS_PREVENTION.sub(b"\x00\x00\x03", rbsp)


def rbsp_of_nal(nal: bytes) -> bytes:
    """Return the payload without emulation prevention (7.3.1).

    Raises when the unit holds no payload, a start code, or ends in a zero byte: what a receiver
    takes for one NAL unit is one.
    """
    if len(nal) < 2 or nal[-1] == 0:
        raise BitstreamError(f"NAL unit of {len(nal)} bytes is empty or ends in a zero byte")
    if found := _FORBIDDEN.search(nal):
        raise BitstreamError(f"start code or reserved zeros inside a NAL unit at {found.start()}")
    return nal[1:].replace(b"\x00\x00\x03", b"\x00\x00")


class BitWriter:
    """Collects bits, most significant first."""

    def __init__(self) -> None:
        self._bits: list[str] = []

    def u(self, width: int, value: int) -> BitWriter:
        """Append an unsigned integer of ``width`` bits."""
        if not 0 <= value < 1 << width:
            raise InvalidInput("bits", f"{value} does not fit {width} bits")
        if width:
            self._bits.append(f"{value:0{width}b}")
        return self

    def ue(self, value: int) -> BitWriter:
        """Append an unsigned Exp-Golomb code (9.1)."""
        if value < 0:
            raise InvalidInput("bits", f"ue({value}) must not be negative")
        width = (value + 1).bit_length()
        return self.u(2 * width - 1, value + 1)

    def se(self, value: int) -> BitWriter:
        """Append a signed Exp-Golomb code (9.1.1)."""
        return self.ue(2 * value - 1 if value > 0 else -2 * value)

    def align(self, bit: int = 0) -> BitWriter:
        """Append zero bits, or one bits, up to the next byte."""
        width = -sum(map(len, self._bits)) % 8
        return self.u(width, bit * ((1 << width) - 1))

    def stop(self) -> BitWriter:
        """Append the RBSP's stop bit and align (7.3.2.11)."""
        return self.u(1, 1).align()

    def to_bytes(self) -> bytes:
        """Return the bytes; the bits must be aligned."""
        bits = "".join(self._bits)
        if len(bits) % 8:
            raise InvalidInput("bits", f"{len(bits)} bits are not whole bytes; align first")
        return int(bits or "0", 2).to_bytes(len(bits) // 8, "big")


class BitReader:
    """Reads bits, most significant first; raises ``BitstreamError`` at the end of the data."""

    def __init__(self, data: bytes) -> None:
        self._value = int.from_bytes(data, "big")
        self._left = 8 * len(data)

    def u(self, width: int) -> int:
        """Read an unsigned integer of ``width`` bits."""
        if width > self._left:
            raise BitstreamError(f"{width} bits wanted, {self._left} left")
        self._left -= width
        return (self._value >> self._left) & ((1 << width) - 1)

    def ue(self) -> int:
        """Read an unsigned Exp-Golomb code (9.1), at most 2**32 - 2."""
        zeros = 0
        while not self.u(1):
            zeros += 1
            if zeros > _MAX_EXP_GOLOMB_ZEROS:
                raise BitstreamError(f"Exp-Golomb code with more than {zeros - 1} leading zeros")
        return (1 << zeros) - 1 + self.u(zeros)


_MAX_SLICE_START_BYTES = 64
"""Bytes of a slice that are read: its first fields take fewer."""


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


def parse_slice_start(nal: bytes) -> SliceStart:
    """Parse the first four fields of a slice; what follows is left to the decoder."""
    if nal_type(nal) not in (NAL_P, NAL_IDR):
        raise BitstreamError(f"NAL unit type {nal_type(nal)} is not a slice")
    r = BitReader(rbsp_of_nal(nal)[:_MAX_SLICE_START_BYTES])
    first_mb, slice_type, pps_id = r.ue(), r.ue(), r.ue()
    if slice_type > 9:
        raise BitstreamError(f"slice type {slice_type} is above 9")
    return SliceStart(first_mb, slice_type % 5, pps_id, r.u(LOG2_MAX_FRAME_NUM))


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
