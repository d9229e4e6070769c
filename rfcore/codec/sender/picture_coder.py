"""Codes one frame against its references: by our slice coder, or by x264 for comparison.

The user's word for quality is CRF, x264's constant rate factor. Without adaptive quantisation and
within one picture it is a quantiser: on ten frames of both sample drives x264 medium codes P slices
at QP = CRF + 5.6 +- 0.6, CRF 15 to 40 alike. Our coder gives the same squared error at a QP higher
by one, since it stops short of the coefficients that are not worth their bits; so it takes
QP = CRF + ``QP_OF_CRF``, a quantiser with a fraction (``SliceCoder.encode``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from rfcore.codec.h264.config import CodecConfig, Coder, coder_of
from rfcore.codec.h264.header import StreamHeader, stream_header
from rfcore.codec.h264.qp_map import QpMap
from rfcore.codec.h264.slice_coder import Effort, SliceCoder
from rfcore.codec.h264.slices import SliceCoding, encode_slice
from rfcore.errors import InvalidInput
from rfcore.image import I420

QP_OF_CRF = 6.5
"""Median of the QP at which our coder's squared error is x264's, less the CRF: 6.2 on the empty
sample drive, 6.8 on the one with vehicles, from CRF 15 to 40."""


@dataclass(frozen=True)
class CodingRequest:
    """The settings of one picture; ``effort`` is one of the stream's coder."""

    crf: float
    effort: str
    qp_map: QpMap | None = None


@dataclass(frozen=True)
class CodedPicture:
    """A slice NAL unit and its decoded picture; ``None`` where only a decoder can tell."""

    payload: bytes
    reconstruction: I420 | None = None


class PictureCoder(Protocol):
    """Codes pictures of one stream, each by itself. One caller at a time."""

    @property
    def header(self) -> StreamHeader:
        """The parameter sets of every slice."""

    def code(self, frame: I420, references: Sequence[I420], request: CodingRequest) -> CodedPicture:
        """Code ``frame`` against ``references``, the last one reference 0.

        Raises ``InvalidInput`` for an effort of another coder, ``CodecError`` if x264 fails.
        """


def picture_coder(config: CodecConfig, threads: int = 1) -> PictureCoder:
    """Return the coder of the configuration's effort."""
    if config.coder is Coder.X264:
        return _X264PictureCoder(config, threads)
    return _OwnPictureCoder(config, threads)


class _OwnPictureCoder:
    def __init__(self, config: CodecConfig, threads: int) -> None:
        self.header = stream_header(config)
        self._coder = SliceCoder(config, threads=threads)

    def code(self, frame: I420, references: Sequence[I420], request: CodingRequest) -> CodedPicture:
        _require_coder(request.effort, Coder.OWN)
        coded = self._coder.encode(
            frame,
            references,
            request.crf + QP_OF_CRF,
            effort=Effort[request.effort.upper()],
            offsets=None if request.qp_map is None else request.qp_map.offsets.ravel(),
        )
        return CodedPicture(coded.payload, coded.reconstruction)


class _X264PictureCoder:
    def __init__(self, config: CodecConfig, threads: int) -> None:
        self._config = config
        self._threads = threads
        grey = I420.filled(config.size_px)
        encode_slice(config, [grey], grey)  # raises if there is no x264, or another one
        self.header = stream_header(config)

    def code(self, frame: I420, references: Sequence[I420], request: CodingRequest) -> CodedPicture:
        _require_coder(request.effort, Coder.X264)
        config = replace(self._config, effort=request.effort)
        coding = SliceCoding(request.crf, request.qp_map, threads=self._threads)
        return CodedPicture(encode_slice(config, references, frame, coding))


def _require_coder(effort: str, coder: Coder) -> None:
    if coder_of(effort) is not coder:
        raise InvalidInput("effort", f"{effort!r} is none of the stream's coder, {coder}")
