"""Splits the bits of a drive by what each macroblock of a frame shows.

A pixel shows, in this order: *off-map*, where the field has nothing; *moving*, where the camera
differs from the same drive through the empty street (parked objects count too: what is not in the
field); *entering*, where the field's surface was outside the previous view; *disoccluded*, where it
was inside but behind another surface; and *static*, all else. A macroblock is of the first kind
that covers a quarter of it.

The bits of a kind are measured with the coder: by how much the frame's slice becomes shorter when
its macroblocks of that kind show exactly what reference 0 shows there, so that nothing is left to
send. Neighbouring macroblocks predict each other, so these parts do not add up to the slice; they
are scaled to its size.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera
from rfcore.codec.decoder import prediction_of
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.references import EncoderState
from rfcore.codec.sender.encoder import DeltaEncoder, Encoded, FrameChoice
from rfcore.image import I420
from rfcore.views import FieldView
from rfedge.evaluate.compare.foreground import by_macroblock, composed
from rfedge.evaluate.field_coder import RenderedClip

KINDS = ("static", "moving", "disoccluded", "entering", "off-map")
PRECEDENCE = ("off-map", "moving", "entering", "disoccluded")
SHARE = 0.25
NEAR_M = 0.1
RELATIVE_DEPTH, ABSOLUTE_DEPTH_M = 0.08, 0.1
"""Two depths of one surface may differ by this much; as in ``rfcore.native.warp``."""
F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]


def macroblock_kinds(
    before: FieldView, now: FieldView, covered: Mask, foreground: Mask
) -> NDArray[np.int8]:
    """Return the index into ``KINDS`` of each macroblock, [ceil(H / 16), ceil(W / 16)]."""
    u, v, depth = _in_previous_view(before.camera, now)
    height, width = now.depth.shape
    inside = (depth > NEAR_M) & (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
    columns = np.rint(np.clip(np.nan_to_num(u), 0, width - 1)).astype(int)
    rows = np.rint(np.clip(np.nan_to_num(v), 0, height - 1)).astype(int)
    there = before.depth[rows, columns]
    visible = np.abs(there - depth) < RELATIVE_DEPTH * depth + ABSOLUTE_DEPTH_M
    pixels = {
        "off-map": ~covered,
        "moving": covered & foreground,
        "entering": covered & ~foreground & ~inside,
        "disoccluded": covered & ~foreground & inside & ~visible,
    }
    kinds = np.zeros(by_macroblock(covered).shape, np.int8)
    for name in reversed(PRECEDENCE):
        kinds[by_macroblock(pixels[name]) >= SHARE] = KINDS.index(name)
    return kinds


def _in_previous_view(previous: Camera, now: FieldView) -> tuple[F64, F64, F64]:
    """Return where the surface of each pixel lies in the previous view: (u, v) in pixels, depth."""
    k = now.camera.intrinsics
    height, width = now.depth.shape
    rays = np.stack(
        [
            *np.meshgrid(
                (np.arange(width) + 0.5 - k.cx_px) / k.fx_px,
                (np.arange(height) + 0.5 - k.cy_px) / k.fy_px,
            ),
            np.ones((height, width)),
        ],
        axis=-1,
    )
    points = rays * now.depth[..., None].astype(np.float64)
    previous_from_now = previous.cam_from_world().compose(now.camera.world_from_cam)
    rotation = np.array(previous_from_now.rotation_matrix())
    moved = points @ rotation.T + np.array(previous_from_now.translation_m)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = k.fx_px * moved[..., 0] / moved[..., 2] + k.cx_px - 0.5
        v = k.fy_px * moved[..., 1] / moved[..., 2] + k.cy_px - 0.5
    return u, v, moved[..., 2]


@dataclass(frozen=True)
class SplitClip:
    """A clip to split; ``foregrounds`` has a bool [H, W] a frame, true for what the field lacks."""

    frames: Sequence[I420]
    rendered: RenderedClip
    foregrounds: Sequence[NDArray[np.bool_]]
    effort: str
    crf: float


def split_rows(clips: Sequence[SplitClip]) -> list[dict[str, Any]]:
    """Return the share of the macroblocks and of the slices' bytes, and the bytes a frame, of each
    kind over the runs of a drive; the first frame of each is not counted."""
    areas, slices, frames = np.zeros(len(KINDS)), np.zeros(len(KINDS)), 0
    for area, share in chain.from_iterable(map(_split_frames, clips)):
        areas += area
        slices += share
        frames += 1
    return [
        {
            "shows": kind,
            "area_percent": float(100 * areas[index] / areas.sum()),
            "slice_percent": float(100 * slices[index] / slices.sum()),
            "bytes_per_frame": float(slices[index] / frames),
        }
        for index, kind in enumerate(KINDS)
    ]


def _split_frames(clip: SplitClip) -> Iterator[tuple[F64, F64]]:
    """Yield macroblocks and slice bytes by kind for every frame but the first."""
    encoder = DeltaEncoder(CodecConfig(*clip.frames[0].size_px, effort=clip.effort, crf=clip.crf))
    state, rendered = encoder.start(1), clip.rendered
    for index, frame in enumerate(clip.frames):
        coding = _Coding(encoder, state, rendered.views[index])
        made = coding.of(frame)
        if index:
            kinds = macroblock_kinds(
                rendered.views[index - 1],
                rendered.views[index],
                rendered.covered[index],
                clip.foregrounds[index],
            )
            yield (
                np.bincount(kinds.ravel(), minlength=len(KINDS)).astype(np.float64),
                _slice_bytes(clip.frames[index], coding, made, kinds),
            )
        state = made.state


@dataclass(frozen=True)
class _Coding:
    """The inputs of a frame's coding beside the frame itself."""

    encoder: DeltaEncoder
    state: EncoderState
    view: FieldView

    def of(self, frame: I420, choice: FrameChoice | None = None) -> Encoded:
        return self.encoder.encode(self.state, frame, self.view, choice or FrameChoice())


def _slice_bytes(frame: I420, coding: _Coding, made: Encoded, kinds: NDArray[np.int8]) -> F64:
    packet = made.packet
    whole = len(packet.payload)
    spared = np.zeros(len(KINDS))
    if not packet.references:  # an I picture has no reference to show
        spared += np.bincount(kinds.ravel(), minlength=len(KINDS))
    else:
        prediction = prediction_of(packet, coding.view, coding.state.past)
        reference = prediction.picture(packet.references[-1])
        choice = FrameChoice(
            packet.references,
            photometric=packet.photometric,
            relight=packet.relit,
            light=packet.light,
        )
        for kind in np.unique(kinds):
            without = composed(reference, frame, kinds == kind)
            spared[kind] = max(0, whole - len(coding.of(without, choice).packet.payload))
    shares: F64 = spared * (whole / max(float(spared.sum()), 1.0))
    return shares
