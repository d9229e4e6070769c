"""A rival that sends only the foreground, as RFDVC does, and what it can and cannot reach.

Šlapák et al.'s later method codes the camera's foreground alone, on a flat ground, with an IDR
picture each 10 frames; the receiver puts it before the field's render. Ours is its bound: the mask
is the true one, in whole macroblocks, the render's pose costs nothing, and x264 is tuned for PSNR.
Where the data has no masks, the true one is where the camera differs from the same drive through
the empty street by more than 12 levels of luma.

The background stays the render, so the whole picture's quality has a ceiling, which no rate lifts:
a BD-rate over the headline window does not exist. It is compared on the foreground's quality
instead, with the bytes of the *whole* picture for us.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.metrics import psnr_of_mse
from rfedge.evaluate.clips import STEADY, Clip, CodedClip, luma_sse
from rfedge.evaluate.compare.rows import ForegroundRow
from rfedge.evaluate.rate_curve import RateCurve, bd_rate_percent
from rfedge.evaluate.rivals import Rival, x264_for_psnr

MACROBLOCK_PX = 16
DIFFERENT_LEVELS = 12
IDR_EACH_FRAMES = 10
GROUND_LEVEL = 128
MIN_WINDOW_DB = 1.0
Mask = NDArray[np.bool_]


def foreground_mask(frame: I420, background: I420) -> Mask:
    """Return bool [H, W], true where the luma differs from the empty street's; raise on sizes."""
    if frame.size_px != background.size_px:
        raise InvalidInput("background", f"{background.size_px} px behind {frame.size_px} px")
    difference = np.abs(frame.y.astype(np.int16) - background.y)
    return np.asarray(difference > DIFFERENT_LEVELS)


def by_macroblock(mask: Mask) -> NDArray[np.float64]:
    """Return the share of each macroblock that is true, [ceil(H / 16), ceil(W / 16)].

    A macroblock over the edge counts the pixels it has there as false.
    """
    height, width = mask.shape
    rows, columns = -(-height // MACROBLOCK_PX), -(-width // MACROBLOCK_PX)
    whole = np.zeros((rows * MACROBLOCK_PX, columns * MACROBLOCK_PX), bool)
    whole[:height, :width] = mask
    blocks = whole.reshape(rows, MACROBLOCK_PX, columns, MACROBLOCK_PX)
    shares: NDArray[np.float64] = blocks.mean(axis=(1, 3))
    return shares


@dataclass(frozen=True)
class ForegroundCoder:
    """Codes the macroblocks of ``masks`` (bool [H, W] a frame) before ``renders``."""

    name: str
    masks: Sequence[Mask]
    renders: Sequence[I420]
    rival: Rival
    stamp: str
    """Digest of the field, the background and our coder, besides the rival's options."""

    @property
    def version(self) -> str:
        """The stamp and the rival's version."""
        return f"{self.stamp}; {self.rival.version}"

    @staticmethod
    def of(
        preset: str, masks: Sequence[Mask], renders: Sequence[I420], stamp: str
    ) -> ForegroundCoder:
        """Return one at x264's ``preset``; the frames of a clip must be those of the masks."""
        plain = x264_for_psnr(preset)
        params = plain.options["x264-params"].replace(
            "keyint=infinite", f"keyint={IDR_EACH_FRAMES}"
        )
        rival = replace(plain, options={**plain.options, "x264-params": params})
        return ForegroundCoder(f"rfdvc-style-{preset}", masks, renders, rival, stamp)

    def of_run(self, run: slice) -> ForegroundCoder:
        """Return the coder of the frames ``run`` alone."""
        return replace(self, masks=self.masks[run], renders=self.renders[run])

    @property
    def points(self) -> Sequence[float]:
        """CRFs."""
        return self.rival.points

    def code(self, frames: Sequence[I420], rate_hz: float, point: float) -> CodedClip:
        """Code and decode at CRF ``point``; bytes are the slices and the deflated mask."""
        if len(frames) > len(self.masks):
            raise InvalidInput("frames", f"{len(frames)} where there are {len(self.masks)} masks")
        blocks = [by_macroblock(mask) > 0 for mask in self.masks[: len(frames)]]
        sent = [_on_flat_ground(*pair) for pair in zip(frames, blocks, strict=True)]
        made = self.rival.pictures(sent, rate_hz, point)
        shown = [
            composed(decoded, render, block)
            for decoded, render, block in zip(made.decoded, self.renders, blocks, strict=False)
        ]
        sizes = [
            size + len(zlib.compress(np.packbits(block).tobytes(), 9))
            for size, block in zip(made.frame_bytes, blocks, strict=True)
        ]
        masked = zip(shown, frames, self.masks, strict=False)
        errors = tuple(luma_sse(*each) for each in masked)
        composed_pictures = replace(made, frame_bytes=sizes, decoded=shown)
        return composed_pictures.measured(point, frames, foreground_sse=errors)


def foreground_row(
    clip: Clip, ours: Sequence[CodedClip], theirs: Sequence[CodedClip], masks: Sequence[Mask]
) -> ForegroundRow:
    """Return both on the foreground's quality, over the window both span, and the rival's ceiling.

    ``bd_rate_percent`` is null where they share less than a decibel. Raises ``InvalidInput`` if the
    masks are all empty.
    """
    pixels = np.array([mask.sum() for mask in masks], np.float64)
    if not pixels[STEADY].any():
        raise InvalidInput("background", f"{clip.scene}: no frame differs from it")
    curves = [_foreground_curve(clips, pixels) for clips in (ours, theirs)]
    low = max(float(curve.psnr_db[0]) for curve in curves)
    high = min(float(curve.psnr_db[-1]) for curve in curves)
    shared = high - low >= MIN_WINDOW_DB
    return ForegroundRow(
        scene=clip.scene,
        hz=clip.rate_hz,
        mask=f"macroblocks where |camera - empty street| > {DIFFERENT_LEVELS} levels",
        foreground_percent=100 * float(np.mean([mask.mean() for mask in masks])),
        window_db=(low, high) if shared else None,
        bd_rate_percent=bd_rate_percent(curves[1], curves[0], (low, high)) if shared else None,
        whole_picture_ceiling_db=max(coded.psnr_db() for coded in theirs),
        ours=_points(curves[0]),
        rfdvc_style=_points(curves[1]),
    )


def _foreground_curve(clips: Sequence[CodedClip], pixels: NDArray[np.float64]) -> RateCurve:
    points = []
    for coded in clips:
        errors = np.array(coded.notes["foreground_sse"], np.float64)
        mse = errors[STEADY].sum() / pixels[STEADY].sum()
        points.append((psnr_of_mse(float(mse)), coded.bytes_per_frame()))
    psnr_db, rates = zip(*sorted(points), strict=True)
    return RateCurve(np.array(psnr_db), np.array(rates))


def _points(curve: RateCurve) -> dict[str, list[float]]:
    return {
        "foreground_psnr_db": curve.psnr_db.tolist(),
        "bytes_per_frame": curve.bytes_per_frame.tolist(),
    }


def _on_flat_ground(frame: I420, block: Mask) -> I420:
    return composed(frame, I420.filled(frame.size_px, GROUND_LEVEL), block)


def composed(front: I420, behind: I420, block: Mask) -> I420:
    """Return ``front`` in the macroblocks of ``block``, ``behind`` elsewhere."""
    sides_px = (MACROBLOCK_PX, MACROBLOCK_PX // 2, MACROBLOCK_PX // 2)
    planes = []
    for ours, theirs, side_px in zip(front.planes, behind.planes, sides_px, strict=True):
        height, width = ours.shape
        where = block.repeat(side_px, axis=0).repeat(side_px, axis=1)[:height, :width]
        planes.append(np.where(where, ours, theirs))
    return I420(*planes)
