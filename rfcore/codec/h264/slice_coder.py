"""Codes a picture as one H.264 slice against given pictures, without an encoder's own state.

The slice refers to the parameter sets of ``rfcore.codec.h264.bitstream``. It is a P slice of ITU-T
H.264 with CABAC: skipped macroblocks, partitions of 16x16 to 8x8 with a reference each,
quarter-sample vectors, intra modes, 4x4 and 8x8 transforms; without references an I slice. The
kernels (``csrc/h264``) compute in integers, so the same pictures and settings give the same bytes
on every instruction set.

A decision costs ``J = D + lambda R`` with squared error D and bits R as the arithmetic coder's
states predict them; ``lambda`` follows the quantiser (Wiegand and Girod, ICIP 2001).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rfcore.codec.h264.bitstream import (
    DEFAULT_REFERENCES,
    INIT_QP,
    LOG2_MAX_FRAME_NUM,
    NAL_IDR,
    NAL_P,
    NAL_REF_IDC,
    BitWriter,
    nal_of_rbsp,
)
from rfcore.codec.h264.config import CodecConfig
from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.native import _native
from rfcore.native.backend import check_backend

LAMBDA_FACTOR = 0.59
"""Lambda at QP 12: the squared error that one bit is worth. It doubles every 3 steps of the
quantiser. 0.68 takes 0.25 % more bits for the same squared error (a street with vehicles, 640x360),
and so does 0.53."""
MOTION_FACTOR = 1.2
"""Factor on the root of lambda for motion search, where a difference is a sum of absolute transform
coefficients. A factor of 1.4 takes 0.3 to 0.8 % more bits (streets with and without a field, a real
one, rain), 1.8 another 0.5."""
MAX_QP = 60
"""Highest QP. Beyond 51 only lambda grows, by up to eight times, until little is left to code."""
_P_SLICE, _I_SLICE = 0, 2
_ANY_MODE = -1


class Trials(NamedTuple):
    """The choices that are tried for a macroblock; more of them cost time and save bits."""

    search_steps: int
    """Steps of the integer motion search."""
    subsample_steps: int
    """Steps of the half- and quarter-sample search."""
    references_reach: int
    """A partition's vector is refined in the references that cost at most this many percent of the
    best one; 100: in the best alone, 0: in all."""
    intra_reach: int
    """Intra prediction is tried where its difference is at most this many quarters of inter
    prediction's; 0: always."""
    halves_reach: int
    """16x8 and 8x16 are tried where 8x8 blocks cost at most this many percent of 16x16; 0: always.
    """
    shapes_reach: int
    """Partitions that cost at most this many percent of the cheapest are coded as well."""
    whole_trials: int
    """1: 16x16 is coded with the predicted vector, too; 2: also with the second best reference."""
    cost_rounds: int
    """Rounds of moving vectors by a quarter sample wherever the coded macroblock then costs
    less."""


class Effort(Enum):
    """The number of choices that the coder tries.

    The default leaves out references that cost 18 % more than the best: 10 % less time for at most
    0.2 % more bits. The predicted vector for 16x16 takes 8 % more instructions and saves up to
    0.9 %, 2 % in rain. ``THOROUGH`` nearly doubles the time and saves 2 to 4 %.
    """

    FAST = Trials(
        search_steps=8,
        subsample_steps=1,
        references_reach=100,
        intra_reach=5,
        halves_reach=101,
        shapes_reach=100,
        whole_trials=0,
        cost_rounds=0,
    )
    DEFAULT = Trials(
        search_steps=16,
        subsample_steps=2,
        references_reach=118,
        intra_reach=7,
        halves_reach=104,
        shapes_reach=100,
        whole_trials=1,
        cost_rounds=0,
    )
    THOROUGH = Trials(
        search_steps=24,
        subsample_steps=3,
        references_reach=0,
        intra_reach=0,
        halves_reach=0,
        shapes_reach=103,
        whole_trials=2,
        cost_rounds=2,
    )


class MacroblockMode(IntEnum):
    """The coding mode of a macroblock: skipped, inter with partitions, intra with blocks, or its
    plain samples (I_PCM)."""

    SKIP = 0
    INTER_16X16 = 1
    INTER_16X8 = 2
    INTER_8X16 = 3
    INTER_8X8 = 4
    INTRA_16X16 = 5
    INTRA_8X8 = 6
    INTRA_4X4 = 7
    PCM = 8


@dataclass(frozen=True)
class OwnSlice:
    """A coded slice. ``payload``: its NAL unit without start code; ``reconstruction``: the picture
    that decoders make of it; ``modes`` [macroblocks]: their ``MacroblockMode``, in raster order.
    """

    payload: bytes
    reconstruction: I420
    modes: NDArray[np.int8]


class SliceCoder:
    """Codes pictures of one stream; may be shared between threads, which take turns.

    ``threads`` work on rows of macroblocks at the same time, each row behind the one above it; the
    bytes do not depend on their number. Raises ``InvalidInput`` for a number of threads out
    of range, and ``BackendUnavailable`` for an instruction set that this machine lacks.
    """

    def __init__(self, config: CodecConfig, *, threads: int = 1, isa: str | None = None) -> None:
        self._vertical_reach = 4 * config.vertical_range - 1
        self._size_px = config.size_px
        self._reference_frames = config.reference_frames
        width_px, height_px = self._size_px
        self._native = _native.SliceCoder(width_px, height_px, check_backend(threads, isa), threads)
        self._macroblocks = -(-width_px // 16) * -(-height_px // 16)
        # Between two quantisers lambda alone follows: 0.2 % more bits at equal squared error than
        # the integers' own curve, where one macroblock in so many at the next quantiser takes
        # 2.6 %, the picture's upper part 0.9 % (both sample drives, QP 27 to 35).
        self._lambda = LAMBDA_FACTOR * 2.0 ** ((np.arange(52) - 12) / 3)

    def encode(
        self,
        frame: I420,
        references: Sequence[I420],
        qp: float,
        *,
        effort: Effort = Effort.DEFAULT,
        deblocked: bool = True,
        offsets: NDArray[np.int8] | None = None,
        forced: NDArray[np.int8] | None = None,
    ) -> OwnSlice:
        """Return ``frame`` as a slice against ``references``, the last one reference 0.

        ``qp``: the quantiser, 0..60. Quantisers are integers of at most 51; what a fraction or a
        higher value leaves over goes into lambda, so bits go on falling. ``offsets``
        [macroblocks, in raster order] is added to it and the sum kept within 0..51.
        ``deblocked``: whether decoders filter the picture. ``forced`` [macroblocks]: the
        ``MacroblockMode`` each must have (for tests), -1 where the coder decides; one that takes
        more than the standard's 3200 bits is coded as its samples. Raises ``InvalidInput`` for
        values out of range and pictures of another size than the header's.
        """
        if not 0 <= qp <= MAX_QP:
            raise InvalidInput("qp", f"{qp} is outside 0..{MAX_QP}")
        slice_qp = min(int(qp + 0.5), 51)
        quantisers = self._quantisers(slice_qp, offsets)
        squared = self._lambda * 2 ** ((qp - slice_qp) / 3)
        if len(references) > self._reference_frames:
            raise InvalidInput(
                "references",
                f"{len(references)} are more than the stream's {self._reference_frames}",
            )
        self._check_size("frame", frame)
        for index, reference in enumerate(references):
            self._check_size(f"references[{index}]", reference)
        modes = np.empty(self._macroblocks, np.int8)
        reconstruction = I420.empty(frame.size_px)
        data = self._native.encode(
            frame.planes,
            [picture.planes for picture in reversed(references)],
            slice_qp,
            quantisers,
            self._forced(forced, bool(references)),
            np.rint(256 * squared).astype(np.uint32),
            np.rint(256 * MOTION_FACTOR * squared**0.5).astype(np.uint32),
            _native.SliceEffort(**effort.value._asdict()),
            deblocked,
            self._vertical_reach,
            reconstruction.planes,
            modes,
        )
        header = _slice_header(len(references), slice_qp, deblocked)
        unit = NAL_P if references else NAL_IDR
        return OwnSlice(nal_of_rbsp(NAL_REF_IDC | unit, header + data), reconstruction, modes)

    def _quantisers(self, qp: int, offsets: NDArray[np.int8] | None) -> NDArray[np.int8]:
        """Return the quantiser of every macroblock."""
        if offsets is None:
            return np.full(self._macroblocks, qp, np.int8)
        self._check_map("offsets", offsets)
        return np.clip(offsets.astype(np.int16) + qp, 0, 51).astype(np.int8)

    def _forced(self, forced: NDArray[np.int8] | None, p_slice: bool) -> NDArray[np.int8]:
        """Return the mode every macroblock must have, -1 for any."""
        if forced is None:
            return np.full(self._macroblocks, _ANY_MODE, np.int8)
        self._check_map("forced", forced)
        least = MacroblockMode.SKIP if p_slice else MacroblockMode.INTRA_16X16
        known = (forced == _ANY_MODE) | ((forced >= least) & (forced <= MacroblockMode.PCM))
        if not known.all():
            raise InvalidInput(
                "forced", f"{forced[~known][0]} is no mode of {'P' if p_slice else 'I'} slices"
            )
        return np.ascontiguousarray(forced)

    def _check_map(self, name: str, values: NDArray[np.int8]) -> None:
        if values.shape != (self._macroblocks,) or values.dtype != np.int8:
            raise InvalidInput(
                name,
                f"{values.dtype} {values.shape} where int8 ({self._macroblocks},) is expected",
            )

    def _check_size(self, name: str, picture: I420) -> None:
        if picture.size_px != self._size_px:
            raise InvalidInput(
                name, f"{picture.size_px} px where the header says {self._size_px} px"
            )


def _slice_header(references: int, qp: int, deblocked: bool) -> bytes:
    """Return slice_header and the alignment before slice_data (7.3.3, 7.3.4), picture order 2."""
    w = BitWriter()
    w.ue(0).ue(_P_SLICE if references else _I_SLICE).ue(0)
    w.u(LOG2_MAX_FRAME_NUM, references)  # frame_num
    if references:
        override = references != DEFAULT_REFERENCES
        w.u(1, override)
        if override:
            w.ue(references - 1)
        w.u(1, 0)  # ref_pic_list_modification_flag_l0
        w.u(1, 0)  # adaptive_ref_pic_marking_mode_flag
        w.ue(0)  # cabac_init_idc
    else:
        w.ue(0)  # idr_pic_id
        w.u(1, 0).u(1, 0)  # no_output_of_prior_pics_flag, long_term_reference_flag
    w.se(qp - INIT_QP)
    w.ue(0 if deblocked else 1)
    if deblocked:
        w.se(0).se(0)
    return w.align(1).to_bytes()  # cabac_alignment_one_bit
