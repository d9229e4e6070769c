"""Codes one frame against its references: by our slice coder, or by x264 for comparison.

The user's word for quality is CRF, x264's constant rate factor. Without adaptive quantisation and
within one picture it is a quantiser: on ten frames of both sample drives x264 medium codes P slices
at QP = CRF + 5.6 +- 0.6, CRF 15 to 40 alike. Our coder gives the same squared error at a QP higher
by one, since it stops short of the coefficients that are not worth their bits; so it takes
QP = CRF + ``QP_OF_CRF``, a quantiser with a fraction (``SliceCoder.encode``).

x264 codes the reference pictures, which are not sent, and then the frame as one slice. Our own
coder (``rfcore.codec.h264.slice_coder``) needs no such detour.

A fresh encoder codes each frame, so every frame may have its own references, quality and analysis.
Why x264 is configured as it is; figures are for a 640x360 street with vehicles that the field does
not hold, medium, CRF 23, one core.

* The unsent pictures get quantisers 17 below the CRF: what x264 predicts from is then almost what
  the receiver predicts from. ``ipratio`` sets the first one's; zones can not (x264 gives picture 0
  the CRF's own), but set those of further ones, P pictures (a second I picture would become an IDR
  picture and drop the first). They cost no bytes, but most of their time is arithmetic coding.
* The encoder starts with cheap analysis (``subme=2``, no trellis) and a zone gives the sent
  picture the preset's own. The I picture takes 21 ms instead of 51; P slices are 1 % larger and
  0.04 dB better. ``subme=1`` would be cheaper still, but makes x264 measure complexity by SAD,
  which shifts the meaning of CRF. Nor are they deblocked, or their motion searched in parts of a
  macroblock: a fifth off their time, and P slices gain 0.2 %.
* One SPS and one PPS for every preset, CRF and number of references: ``ref=3:stitchable=1`` and the
  level are fixed; CABAC, 8x8 transforms and weighted prediction are on also for ultrafast, which
  would drop them; and without psychovisual analysis no preset has a chroma QP offset.
* No adaptive quantisation and no psychovisual analysis: x264 would spend bits by the variance of
  the frame, most of which the references explain, and on noise that looks sharp. Without them 10 %
  fewer bits give the same PSNR, as they do in any stream; so a comparison with x264 must state
  which of the two had them (``--tune psnr``).
* Two threads code two pictures at a time, for 1 % more processor time and up to 0.2 % more bits.
* A map of quantiser offsets needs adaptive quantisation on, or FFmpeg leaves it out; at a strength
  of 1e-4 it moves no quantiser of its own (equal bytes without a map), and leaves the PPS alone.
* Every block chooses its reference (``mixed-refs``), also where the preset would not let it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from rfcore.codec.h264.bitstream import (
    NAL_IDR,
    NAL_P,
    NAL_PPS,
    NAL_SPS,
    StreamHeader,
    nal_type,
    split_nals,
    stream_header,
)
from rfcore.codec.h264.config import X264_REFERENCE_FRAMES, CodecConfig, Coder, coder_of, preset_of
from rfcore.codec.h264.ffmpeg import EncoderOptions, PictureKind, encode_pictures
from rfcore.codec.h264.qp_map import QpMap
from rfcore.codec.h264.slice_coder import Effort, SliceCoder
from rfcore.errors import CodecError, InvalidInput
from rfcore.image import I420

_SUBME = {
    "ultrafast": 0,
    "superfast": 1,
    "veryfast": 2,
    "faster": 4,
    "fast": 6,
    "medium": 7,
    "slow": 8,
    "slower": 9,
    "veryslow": 10,
}
"""Subpixel refinement of x264's presets (x264 --fullhelp)."""

_TRELLIS = 2
"""Every preset uses trellis 2: it costs 1 ms of 70 at veryfast and saves 5 % of the bits at equal
PSNR."""

_REGIONS_ON = {"aq-mode": "1", "aq-strength": "0.0001"}

_PARTITIONS = {
    **dict.fromkeys(_SUBME, "p8x8b8x8i8x8i4x4"),
    "ultrafast": "none",
    "superfast": "i8x8i4x4",
    "slower": "all",
    "veryslow": "all",
}
"""Partitions of x264's presets, without commas, which would end an option within a zone."""

_UNSENT_MARGIN = 17
"""CRF less the quantiser of unsent pictures. On the first sample with three references, CRF 20 to
32, bits at equal PSNR against quantisers of 3 to 8: 18, 17, 12, 8 and 4 take 0.4, 0.3, 1, 3 and 7 %
more; of the time at CRF 29 they leave 85, 80, 75, 67 and 65 %."""

_LOWEST_UNSENT_QP = 8
"""Lowest quantiser of unsent pictures. Between 2 and 8, P slices change by 0.3 %, and the time of
the unsent pictures by a fifth."""


_MAX_THREADS = 2


@dataclass(frozen=True)
class SliceCoding:
    """Settings of one slice. ``crf`` replaces the configured one, ``qp_map`` is added to it.

    ``threads``: more than two gain nothing; with two the slice may differ by a few bytes, because
    x264 searches motion less far up and down.
    """

    crf: float | None = None
    qp_map: QpMap | None = None
    threads: int = 1


AS_CONFIGURED = SliceCoding()


def encode_slice(
    config: CodecConfig,
    references: Sequence[I420],
    frame: I420,
    coding: SliceCoding = AS_CONFIGURED,
) -> bytes:
    """Return ``frame`` as a slice NAL unit against ``references``, the last one reference 0.

    Without references it is an I picture. Raises ``CodecError`` if x264 writes other parameter sets
    than ``stream_header`` or anything but one slice of the frame, ``InvalidInput`` for more
    references than its streams have. The caller checks sizes.
    """
    if len(references) > X264_REFERENCE_FRAMES:
        raise InvalidInput(
            "references", f"{len(references)} are more than the {X264_REFERENCE_FRAMES} of x264"
        )
    kinds = [PictureKind.I, *[PictureKind.P] * len(references)]
    regions = () if coding.qp_map is None else coding.qp_map.regions()
    options = slice_options(config, len(references), coding)
    if regions:
        options = replace(options, params={**options.params, **_REGIONS_ON})
    units = encode_pictures(options, list(zip([*references, frame], kinds, strict=True)), regions)
    first = {nal_type(nal): nal for nal in split_nals(units[0])}
    header = stream_header(config)
    if (first.get(NAL_SPS), first.get(NAL_PPS)) != (header.sps, header.pps):
        raise CodecError("x264 wrote other parameter sets than it was configured for")
    wanted = NAL_P if references else NAL_IDR
    slices = [nal for nal in split_nals(units[-1]) if nal_type(nal) in (NAL_P, NAL_IDR)]
    if [nal_type(nal) for nal in slices] != [wanted]:
        raise CodecError(f"x264 made slices {[nal_type(n) for n in slices]} of one picture")
    return slices[0]


def slice_options(
    config: CodecConfig, references: int = 1, coding: SliceCoding = AS_CONFIGURED
) -> EncoderOptions:
    """Return the x264 options for a frame of so many references."""
    params = {
        "keyint": "infinite",
        "scenecut": "0",
        "ref": str(X264_REFERENCE_FRAMES),
        "stitchable": "1",
        "level": str(config.level_idc),
        "cabac": "1",
        "8x8dct": "1",
        "chroma-qp-offset": "0",
        "aq-mode": "0",
        "psy": "0",
        "mixed-refs": "1",
        "trellis": str(_TRELLIS),
    }
    preset = preset_of(config.effort)
    if preset == "ultrafast":
        params["weightp"] = "1"
    crf = config.crf if coding.crf is None else coding.crf
    if references:
        params |= _unsent_params(preset, references, crf)
    threads = min(coding.threads, _MAX_THREADS, references + 1)
    return EncoderOptions(config.coded_size_px, preset, crf, params, threads=threads)


def _unsent_params(preset: str, references: int, crf: float) -> Mapping[str, str]:
    sent = {
        "b": "1",
        "subme": str(_SUBME[preset]),
        "trellis": str(_TRELLIS),
        "partitions": _PARTITIONS[preset],
        "no-deblock": "0",
    }
    unsent_qp = max(_LOWEST_UNSENT_QP, round(crf) - _UNSENT_MARGIN)
    unsent = {"q": str(unsent_qp), "ref": "1", "me": "dia", "merange": "4"}
    zones = [_zone(references, references, sent)]
    if references > 1:
        zones.insert(0, _zone(1, references - 1, unsent))
    return {
        "ipratio": f"{2 ** (_UNSENT_MARGIN / 6):.3f}",
        "subme": "2",
        "trellis": "0",
        "partitions": "none",
        "no-deblock": "1",
        "zones": "/".join(zones),
    }


def _zone(first: int, last: int, options: Mapping[str, str]) -> str:
    return ",".join([f"{first},{last}", *(f"{name}={value}" for name, value in options.items())])


QP_OF_CRF = 6.5
"""Median of the QP at which our coder's squared error is x264's, less the CRF: 6.2 on the empty
sample drive, 6.8 on the one with vehicles, from CRF 15 to 40."""
INTRA_FINER = 2.0
"""How much finer a frame without references is coded, since later ones are predicted from it. Clips
of 24 frames without a field take 0.1 % fewer bits in all, and from the second frame on 1 % (x264's
CRF codes the first one 6 finer)."""


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
        qp = request.crf + QP_OF_CRF
        coded = self._coder.encode(
            frame,
            references,
            qp if references else qp - INTRA_FINER,
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
