"""The sender's x264 run: reference pictures that are not sent, then the frame as one slice.

A fresh encoder codes one frame, so every frame may have references, quality and analysis of its
own. What matters; figures are for a 640x360 street with unseen vehicles, medium, CRF 23, one core.

* ``ipratio=30`` makes the first unsent picture nearly lossless (14 and above are the same, 5 takes
  a quarter off its time and adds 2 % to the P slice); zones do not reach picture 0. Further ones
  are P pictures (a second I picture would become an IDR picture and drop the first) whose quality
  a zone raises. They cost no bytes, and what x264 predicts from is then almost what the receiver
  predicts from.
* The encoder starts with cheap analysis (``subme=2``, no trellis) and a zone gives the sent
  picture the preset's own. The I picture takes 21 ms instead of 51; P slices are 1 % larger and
  0.04 dB better. ``subme=1`` would be cheaper still, but makes x264 measure complexity by SAD,
  which shifts the meaning of CRF.
* One SPS and one PPS for every preset, CRF and number of references: ``ref=3:stitchable=1`` and the
  level are fixed; CABAC, 8x8 transforms and weighted prediction are on also for ultrafast, which
  would drop them; and without psychovisual analysis no preset has a chroma QP offset.
* No adaptive quantisation and no psychovisual analysis: x264 would spend bits by the variance of
  the frame, most of which the references explain, and on noise that looks sharp. Without them 10 %
  fewer bits give the same PSNR, as they do in any stream; so whoever compares with x264 should say
  which of the two had them (``--tune psnr``).
* A map of quantiser offsets needs adaptive quantisation on, or FFmpeg leaves it out; at a strength
  of 1e-4 it moves no quantiser of its own (equal bytes without a map), and leaves the PPS alone.
* Every block chooses its reference (``mixed-refs``), also where the preset would not let it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from rfcore.codec.bitstream import split_nals
from rfcore.codec.config import REFERENCE_FRAMES, CodecConfig
from rfcore.codec.h264 import EncoderOptions, PictureKind, encode_pictures
from rfcore.codec.header import StreamHeader
from rfcore.codec.parameter_sets import NAL_IDR, NAL_P, NAL_PPS, NAL_SPS, nal_type
from rfcore.codec.qp_map import QpMap
from rfcore.codec.reference import without_zeros
from rfcore.errors import CodecError
from rfcore.image import I420

__all__ = ["CodedSlice", "encode_slice", "slice_options"]

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
"""Of x264's presets (x264 --fullhelp)."""

_TRELLIS = 2
"""For every preset: 1 ms of 70 at veryfast, and 5 % fewer bits at equal PSNR."""

_HEED_REGIONS = {"aq-mode": "1", "aq-strength": "0.0001"}

_UNSENT_QP = 8
"""Between 2 and 10 P slices grow by 0.5 % and the time for three references falls by 12 %."""


@dataclass(frozen=True)
class CodedSlice:
    """One slice NAL unit without start code, and the parameter sets x264 wrote with it."""

    header: StreamHeader
    payload: bytes


def encode_slice(
    config: CodecConfig,
    references: Sequence[I420],
    frame: I420,
    crf: float | None = None,
    qp_map: QpMap | None = None,
) -> CodedSlice:
    """Encode ``frame`` against ``references``, the last one reference 0; against none as an I
    picture. ``crf`` replaces the configured one, ``qp_map`` is added to it.

    Raises ``CodecError`` if x264 makes anything but one slice of the frame. The caller checks
    sizes, and the header.
    """
    unsent = [without_zeros(picture) for picture in references]
    kinds = [PictureKind.I, *[PictureKind.P] * len(unsent)]
    regions = () if qp_map is None else qp_map.regions()
    options = slice_options(config, len(unsent), crf)
    if regions:
        options = replace(options, params={**options.params, **_HEED_REGIONS})
    units = encode_pictures(options, list(zip([*unsent, frame], kinds, strict=True)), regions)
    first = {nal_type(nal): nal for nal in split_nals(units[0])}
    if not {NAL_SPS, NAL_PPS} <= first.keys():
        raise CodecError(f"x264 made NAL units {sorted(first)} without parameter sets")
    wanted = NAL_P if unsent else NAL_IDR
    slices = [nal for nal in split_nals(units[-1]) if nal_type(nal) in (NAL_P, NAL_IDR)]
    if [nal_type(nal) for nal in slices] != [wanted]:
        raise CodecError(f"x264 made slices {[nal_type(n) for n in slices]} of one picture")
    return CodedSlice(StreamHeader(config, first[NAL_SPS], first[NAL_PPS]), slices[0])


def slice_options(
    config: CodecConfig, references: int = 1, crf: float | None = None
) -> EncoderOptions:
    """Return the x264 options for a frame of so many references."""
    params = {
        "keyint": "infinite",
        "scenecut": "0",
        "ref": str(REFERENCE_FRAMES),
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
    if config.preset == "ultrafast":
        params["weightp"] = "1"
    if references:
        params |= _unsent_params(config, references)
    crf = config.crf if crf is None else crf
    return EncoderOptions(config.coded_size_px, config.preset, crf, params)


def _unsent_params(config: CodecConfig, references: int) -> Mapping[str, str]:
    subme = _SUBME[config.preset]
    zones = [f"{references},{references},b=1,subme={subme},trellis={_TRELLIS}"]
    if references > 1:
        zones.insert(0, f"1,{references - 1},q={_UNSENT_QP}")
    return {"ipratio": "30", "subme": "2", "trellis": "0", "zones": "/".join(zones)}
