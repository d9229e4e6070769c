"""The splice: a standard decoder is fed our own reference pictures, then the received slice.

Sender and receiver run the same code: an I_PCM picture for each reference, then the received slice.
The P slice predicts from exactly those samples. Whatever it carries, the next frame begins with an
IDR picture again, so no decoder state outlives a frame.

A frame without references is an IDR picture. A grey I_PCM picture goes before it, so that its
``idr_pic_id``, which is always 0, never follows another 0 (7.4.3).

An I_PCM picture is a render as an H.264 picture that decodes to exactly itself. The receiver never
gets the picture its P slice predicts from; it makes one from its own render. An I_PCM macroblock
holds its 384 samples as they are (ITU-T H.264, 7.3.5 and 7.4.5), so every standard decoder
reproduces them bit for bit. The picture is one slice under a picture parameter set of its own (id
1: CAVLC, so that macroblocks need no arithmetic coder, and deblocking off), beside x264's (id 0),
which the P slice names. The first of several pictures is an IDR picture, those after it are not: an
IDR picture would drop the ones before.

In CAVLC each macroblock after the first begins byte-aligned with mb_type ue(25), nine bits, and
seven zero bits: 0x0D 0x00. So the picture is one array of rows of 386 bytes, which a native kernel
writes: those two bytes (not before the first macroblock), 256 Y, 64 Cb and 64 Cr. The last row and
column are repeated up to whole macroblocks. Samples are clamped to at least 1; then no two zero
bytes meet and no emulation prevention is needed (7.4.1).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rfcore.codec.h264.bitstream import (
    LOG2_MAX_FRAME_NUM,
    NAL_IDR,
    NAL_P,
    NAL_PPS,
    NAL_REF_IDC,
    BitWriter,
    StreamHeader,
    check_header,
    join_nals,
    nal_of_rbsp,
    nal_type,
    parse_slice_start,
)
from rfcore.codec.h264.ffmpeg import H264Decoder
from rfcore.errors import BitstreamError, CodecError, InvalidInput
from rfcore.image import I420
from rfcore.native import _native

PCM_PPS_ID = 1
_I_SLICE_ONLY = 7
_MB_TYPE_I_PCM = 25
_MB_PX = 16
_MB_BYTES = 2 + 256 + 64 + 64
_STOP = 0x80
_MAX_BYTES_BEFORE = 512
"""Three parameter sets of at most 64 bytes, with emulation prevention, and a slice header."""


def pcm_pps() -> bytes:
    """Return the NAL unit of picture parameter set 1, referring to SPS 0 (7.3.2.2)."""
    w = BitWriter()
    w.ue(PCM_PPS_ID).ue(0)
    w.u(1, 0).u(1, 0)  # entropy_coding_mode_flag: CAVLC; no field order
    w.ue(0)  # one slice group
    w.ue(0).ue(0)  # default reference counts - 1
    w.u(1, 0).u(2, 0)  # no weighted prediction
    w.se(0).se(0).se(0)  # pic_init_qp - 26, pic_init_qs - 26, chroma_qp_index_offset
    w.u(1, 1)  # deblocking_filter_control_present_flag
    w.u(1, 0).u(1, 0)  # constrained_intra_pred_flag, redundant_pic_cnt_present_flag
    return nal_of_rbsp(NAL_REF_IDC | NAL_PPS, w.stop().to_bytes())


@dataclass(frozen=True)
class PcmPlace:
    """The position of an I_PCM picture in its stream.

    The one with ``frame_num`` 0 is an IDR picture; its ``idr_pic_id`` must differ from that of an
    IDR picture right before it (7.4.3).
    """

    frame_num: int = 0
    idr_pic_id: int = 0


class PcmPictures:
    """Makes I_PCM pictures of one size (width, height), all of them in the same memory."""

    def __init__(self, size_px: tuple[int, int]) -> None:
        self._samples_bytes = _samples_bytes(size_px)
        self._memory = np.empty(self._samples_bytes + _MAX_BYTES_BEFORE, np.uint8)

    def access_unit(self, picture: I420, place: PcmPlace, sets: bytes = b"") -> memoryview:
        """Return the byte stream of a picture that decodes to ``picture``, samples raised to >= 1.

        ``sets``: a byte stream to put before it. The next call overwrites the returned memory.
        The coded area is the size rounded up to whole macroblocks by repeating the last row and
        column. The sequence must use picture order count type 2.
        """
        before = sets + join_nals([_slice_header(place)])
        start, end = len(before), len(before) + self._samples_bytes
        unit = self._memory[: end + 1]
        unit[:start] = np.frombuffer(before, np.uint8)
        write_macroblocks(picture, unit[start:end])
        unit[end] = _STOP
        return unit.data


def write_macroblocks(picture: I420, out: NDArray[np.uint8]) -> None:
    """Write the macroblocks of ``picture`` to ``out``, uint8 [N], contiguous.

    Raises ``InvalidInput`` for another N than the macroblocks take, or an empty picture.
    """
    expected = _samples_bytes(picture.size_px)
    if out.shape != (expected,) or expected < _MB_BYTES - 2:
        raise InvalidInput(
            "out", f"shape {out.shape} for a picture of {picture.size_px} px, not ({expected},)"
        )
    _native.pcm_macroblocks(*picture.dense_planes(), out)


def _samples_bytes(size_px: tuple[int, int]) -> int:
    """Return how many bytes the macroblocks of a picture of (width, height) take."""
    width_px, height_px = size_px
    return -(-width_px // _MB_PX) * -(-height_px // _MB_PX) * _MB_BYTES - 2


def without_zeros(picture: I420) -> I420:
    """Return ``picture`` with samples raised to at least 1, as its I_PCM picture decodes."""
    y, u, v = (np.maximum(plane, 1) for plane in picture.planes)
    return I420(y, u, v)


def _slice_header(place: PcmPlace) -> bytes:
    """Return the NAL unit up to the first macroblock's samples (7.3.3, 7.3.5)."""
    w = BitWriter()
    w.ue(0).ue(_I_SLICE_ONLY).ue(PCM_PPS_ID)
    w.u(LOG2_MAX_FRAME_NUM, place.frame_num)
    is_idr = place.frame_num == 0
    if is_idr:
        w.ue(place.idr_pic_id)
        w.u(1, 0).u(1, 0)  # no_output_of_prior_pics_flag, long_term_reference_flag
    else:
        w.u(1, 0)  # adaptive_ref_pic_marking_mode_flag: the oldest picture leaves first
    w.se(0)  # slice_qp_delta
    w.ue(1)  # disable_deblocking_filter_idc
    w.ue(_MB_TYPE_I_PCM).align()
    # The sample that follows is >= 1 and the last byte is not zero unless the bits were: a final
    # one bit stands in for what follows while emulation prevention is applied.
    nal_unit_type = NAL_IDR if is_idr else NAL_P
    return nal_of_rbsp(NAL_REF_IDC | nal_unit_type, w.to_bytes() + b"\x01")[:-1]


_P_SLICE, _I_SLICE = 0, 2


class PictureDecoder(Protocol):
    """A standard decoder for access units of one size, as ``ffmpeg.H264Decoder`` is."""

    def decode(self, access_unit: bytes) -> I420:
        """Return the picture of one access unit; raise ``CodecError``."""

    def feed(self, access_unit: bytes | memoryview) -> None:
        """Decode a reference for later units; raise ``CodecError``. The buffer is not kept."""

    def reset(self) -> None:
        """Forget everything, parameter sets included."""

    def close(self) -> None:
        """Release the decoder's resources; it is not used again."""


class SpliceDecoder:
    """Decodes slices against references. One caller at a time.

    Raises ``InvalidInput`` for a header that our encoder would not make, before ``open_decoder``
    is called with the coded size.
    """

    def __init__(
        self,
        header: StreamHeader,
        open_decoder: Callable[[tuple[int, int]], PictureDecoder] = H264Decoder,
    ) -> None:
        self._config = header.config
        check_header(header)
        self._parameter_sets = join_nals([header.sps, header.pps, pcm_pps()])
        self._decoder = open_decoder(header.config.coded_size_px)
        self._pcm_pictures = PcmPictures(header.config.size_px)
        self._knows_parameter_sets = False
        self._idr_pic_id = 1

    def check_payload(self, payload: bytes, references: int = 1) -> None:
        """Raise ``BitstreamError`` unless ``payload`` is one NAL unit holding the first slice of a
        picture under x264's PPS: the P picture after so many references, or an IDR picture."""
        expected_nal = NAL_P if references else NAL_IDR
        if nal_type(payload) != expected_nal:
            kind = "a P picture's slice" if references else "an IDR picture's slice"
            raise BitstreamError(f"NAL unit type {nal_type(payload)} is not {kind}")
        start = parse_slice_start(payload)
        fields = (start.first_mb, start.slice_type, start.pps_id, start.frame_num)
        expected = (0, _P_SLICE if references else _I_SLICE, 0, references)
        if fields != expected:
            raise BitstreamError(
                f"slice with first macroblock, type, PPS, frame number {fields} "
                f"where {expected} is expected"
            )

    def predict_from(self, *pictures: I420) -> None:
        """Make ``pictures`` the references, the last one reference 0; none prepares for an IDR
        picture. Raises ``CodecError`` if the decoder fails. The caller checks sizes and number.
        """
        fed: Sequence[I420] = pictures or [I420.filled(self._config.size_px)]
        self._idr_pic_id ^= 3  # 1 and 2 by turns
        for frame_num, picture in enumerate(fed):
            place = PcmPlace(frame_num, self._idr_pic_id)
            sets = b"" if self._knows_parameter_sets else self._parameter_sets
            unit = self._pcm_pictures.access_unit(picture, place, sets)
            with self._fresh_after_errors():
                self._decoder.feed(unit)
            self._knows_parameter_sets = True

    def decode(self, payload: bytes) -> I420:
        """Return the picture that ``payload`` makes of the references, cropped to size.

        Raises ``CodecError`` for damage that the decoder detects; it does not detect all damage.
        """
        with self._fresh_after_errors():
            picture = self._decoder.decode(join_nals([payload]))
        return picture.cropped(self._config.size_px)

    def reset(self) -> None:
        """Start over with a fresh decoder, whatever the last payload did to the old one."""
        self._knows_parameter_sets = False
        self._decoder.reset()

    def close(self) -> None:
        """Release the decoder's resources."""
        self._decoder.close()

    @contextmanager
    def _fresh_after_errors(self) -> Iterator[None]:
        try:
            yield
        except CodecError:
            self.reset()
            raise
