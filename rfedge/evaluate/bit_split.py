"""Where the bits of a drive go, by what a macroblock shows (``rfedge.evaluate.regions``).

The bits of a kind are those a frame is shorter by when its macroblocks of that kind show exactly
what reference 0 shows there, so that nothing is left to send. That is a measurement by x264 itself,
not an estimate; neighbours lean on each other, so the parts are scaled to the sum of the slice.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rfcore.codec import CodecConfig, DeltaEncoder, FrameChoice
from rfcore.codec.encoder import Encoded
from rfcore.codec.photometric import adapt
from rfcore.codec.prediction import Prediction
from rfcore.codec.state import EncoderState
from rfcore.image import I420
from rfcore.native.warp import PosedDepth
from rfedge.evaluate.foreground import composed
from rfedge.evaluate.own import SeenClip
from rfedge.evaluate.regions import KINDS, macroblock_kinds

__all__ = ["SplitClip", "split_rows"]

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class SplitClip:
    """A clip to look into; ``foregrounds`` bool [H, W] a frame, what is not in the field."""

    frames: Sequence[I420]
    seen: SeenClip
    foregrounds: Sequence[NDArray[np.bool_]]
    preset: str
    crf: float


def split_rows(clip: SplitClip) -> list[dict[str, Any]]:
    """Return for each kind its share of the macroblocks and of the slices' bytes, first frame not
    counted, and the bytes a frame."""
    areas, slices = np.zeros(len(KINDS)), np.zeros(len(KINDS))
    for area, share in _frames(clip):
        areas += area
        slices += share
    frames = len(clip.frames) - 1
    return [
        {
            "shows": kind,
            "area_percent": float(100 * areas[index] / areas.sum()),
            "slice_percent": float(100 * slices[index] / slices.sum()),
            "bytes_per_frame": float(slices[index] / frames),
        }
        for index, kind in enumerate(KINDS)
    ]


def _frames(clip: SplitClip) -> Iterator[tuple[F64, F64]]:
    """Yield macroblocks and slice bytes by kind for every frame but the first."""
    encoder = DeltaEncoder(CodecConfig(*clip.frames[0].size_px, preset=clip.preset, crf=clip.crf))
    state, seen = encoder.start(1), clip.seen
    for index, frame in enumerate(clip.frames):
        coding = _Coding(encoder, state, seen.renders[index], seen.depths[index])
        made = coding.of(frame)
        if index:
            kinds = macroblock_kinds(
                seen.depths[index - 1],
                seen.depths[index],
                seen.covered[index],
                clip.foregrounds[index],
            )
            yield (
                np.bincount(kinds.ravel(), minlength=len(KINDS)).astype(np.float64),
                _slice_bytes(clip.frames[index], coding, made, kinds),
            )
        state = made.state


@dataclass(frozen=True)
class _Coding:
    """Everything a frame is coded with but the frame itself."""

    encoder: DeltaEncoder
    state: EncoderState
    render: I420
    depth: PosedDepth

    def of(self, frame: I420, choice: FrameChoice | None = None) -> Encoded:
        return self.encoder.encode(
            self.state, frame, self.render, self.depth, choice or FrameChoice()
        )


def _slice_bytes(frame: I420, coding: _Coding, made: Encoded, kinds: NDArray[np.int8]) -> F64:
    packet = made.packet
    whole = len(packet.payload)
    spared = np.zeros(len(KINDS))
    if not packet.references:  # an I picture has no reference to show
        spared += np.bincount(kinds.ravel(), minlength=len(KINDS))
    else:
        render = adapt(coding.render, packet.photometric)
        prediction = Prediction(render, coding.depth, coding.state.past)
        reference = prediction.picture(packet.references[-1])
        choice = FrameChoice(references=packet.references, photometric=packet.photometric)
        for kind in np.unique(kinds):
            without = composed(reference, frame, kinds == kind)
            spared[kind] = max(0, whole - len(coding.of(without, choice).packet.payload))
    shares: F64 = spared * (whole / max(float(spared.sum()), 1.0))
    return shares
