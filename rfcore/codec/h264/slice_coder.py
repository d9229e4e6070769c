"""Codes a picture as one H.264 slice against given pictures, without an encoder's own state.

The slice refers to the parameter sets of a stream header. It is a P slice of ITU-T H.264 with
CABAC: skipped macroblocks, partitions of 16x16 to 8x8 with a reference each, quarter-sample
vectors, intra modes, 4x4 and 8x8 transforms; without references an I slice. The kernels
(``csrc/h264``) compute in integers, so the same pictures and settings give the same bytes on every
instruction set.

A decision costs ``J = D + lambda R`` with squared error D and bits R as the arithmetic coder's
states predict them; ``lambda`` follows the quantiser (Wiegand and Girod, ICIP 2001).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from rfcore.codec.h264.bitstream import BitWriter, nal_of_rbsp
from rfcore.codec.h264.config import REFERENCE_FRAMES
from rfcore.codec.h264.header import StreamHeader, check_header
from rfcore.codec.h264.parameter_sets import NAL_IDR, NAL_P, PictureParameters, parse_pps
from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.native import _native
from rfcore.native.backend import check_backend

__all__ = ["Effort", "OwnSlice", "SliceCoder"]

LAMBDA_FACTOR = 0.59
"""Squared error a bit is worth at QP 12; doubles every 3 steps of the quantiser. 0.68 takes 0.25 %
more bits for the same squared error (a street with vehicles, 640x360), 0.53 as many."""
MOTION_FACTOR = 1.3
"""Times the root of that: transformed difference a bit is worth. 1 takes 0.25 % more bits."""
_NAL_REF_IDC = 0x60
_P_SLICE, _I_SLICE = 0, 2


class Effort(Enum):
    """How much is tried: integer steps and sub-sample steps of the motion search, whether every
    reference is refined, and how far intra prediction may be behind to be tried (quarters of the
    inter prediction's difference, 0 for always)."""

    FAST = (4, 1, 0, 5)
    DEFAULT = (8, 2, 1, 10)
    THOROUGH = (16, 3, 1, 0)


@dataclass(frozen=True)
class OwnSlice:
    """A coded slice. ``payload``: its NAL unit without start code; ``reconstruction``: what it
    decodes to before the deblocking filter."""

    payload: bytes
    reconstruction: I420


class SliceCoder:
    """Codes pictures of one stream; may be shared between threads, which take turns.

    Raises ``InvalidInput`` for a header that our streams would not have, and ``BackendUnavailable``
    for an instruction set that this machine lacks.
    """

    def __init__(self, header: StreamHeader, *, isa: str | None = None) -> None:
        self._log2_max_frame_num = check_header(header).log2_max_frame_num
        self._pps = parse_pps(header.pps)
        self._size_px = header.config.size_px
        width_px, height_px = self._size_px
        self._native = _native.SliceCoder(width_px, height_px, check_backend(1, isa))
        self._macroblocks = -(-width_px // 16) * -(-height_px // 16)
        squared = [LAMBDA_FACTOR * 2.0 ** ((qp - 12) / 3) for qp in range(52)]
        self._lambda_q8 = np.array([round(256 * v) for v in squared], np.uint32)
        self._motion_q8 = np.array(
            [round(256 * MOTION_FACTOR * v**0.5) for v in squared], np.uint32
        )

    def encode(
        self,
        frame: I420,
        references: Sequence[I420],
        qp: int,
        *,
        effort: Effort = Effort.DEFAULT,
        deblocked: bool = True,
        offsets: NDArray[np.int8] | None = None,
    ) -> OwnSlice:
        """Return ``frame`` as a slice against ``references``, the last one reference 0.

        ``qp``: the quantiser, 0..51; ``offsets`` [macroblocks, in raster order] is added to it and
        the sum kept within 0..51. ``deblocked``: whether decoders filter the picture. Raises
        ``InvalidInput`` for values out of range and pictures of another size than the header's.
        """
        quantisers = self._quantisers(qp, offsets)
        if len(references) > REFERENCE_FRAMES:
            raise InvalidInput(
                "references", f"{len(references)} are more than the stream's {REFERENCE_FRAMES}"
            )
        self._check_size("frame", frame)
        for index, reference in enumerate(references):
            self._check_size(f"references[{index}]", reference)
        reconstruction = I420(*(np.empty(plane.shape, np.uint8) for plane in frame.planes))
        data = self._native.encode(
            frame.planes,
            [picture.planes for picture in reversed(references)],
            qp,
            quantisers,
            self._lambda_q8,
            self._motion_q8,
            effort.value,
            reconstruction.planes,
        )
        header = _slice_header(self._pps, self._log2_max_frame_num, len(references), qp, deblocked)
        unit = NAL_P if references else NAL_IDR
        return OwnSlice(nal_of_rbsp(_NAL_REF_IDC | unit, header + data), reconstruction)

    def _quantisers(self, qp: int, offsets: NDArray[np.int8] | None) -> NDArray[np.int8]:
        """Return the quantiser of every macroblock."""
        if not 0 <= qp <= 51:
            raise InvalidInput("qp", f"{qp} is outside 0..51")
        if offsets is None:
            return np.full(self._macroblocks, qp, np.int8)
        if offsets.shape != (self._macroblocks,) or offsets.dtype != np.int8:
            raise InvalidInput(
                "offsets",
                f"{offsets.dtype} {offsets.shape} where int8 ({self._macroblocks},) is expected",
            )
        return np.clip(offsets.astype(np.int16) + qp, 0, 51).astype(np.int8)

    def _check_size(self, name: str, picture: I420) -> None:
        if picture.size_px != self._size_px:
            raise InvalidInput(
                name, f"{picture.size_px} px where the header says {self._size_px} px"
            )


def _slice_header(
    pps: PictureParameters, log2_max_frame_num: int, references: int, qp: int, deblocked: bool
) -> bytes:
    """Return slice_header and the alignment before slice_data (7.3.3, 7.3.4), picture order 2."""
    w = BitWriter()
    w.ue(0).ue(_P_SLICE if references else _I_SLICE).ue(pps.pps_id)
    w.u(log2_max_frame_num, references)  # frame_num
    if references:
        override = references != pps.default_refs[0]
        w.u(1, override)
        if override:
            w.ue(references - 1)
        w.u(1, 0)  # ref_pic_list_modification_flag_l0
        if pps.weighted_pred:
            w.ue(0).ue(0)  # denominators
            for _ in range(references):
                w.u(1, 0).u(1, 0)
        w.u(1, 0)  # adaptive_ref_pic_marking_mode_flag
        w.ue(0)  # cabac_init_idc
    else:
        w.ue(0)  # idr_pic_id
        w.u(1, 0).u(1, 0)  # no_output_of_prior_pics_flag, long_term_reference_flag
    w.se(qp - pps.init_qp)
    if pps.deblocking_control:
        w.ue(0 if deblocked else 1)
        if deblocked:
            w.se(0).se(0)
    return w.align(1).to_bytes()  # cabac_alignment_one_bit
