"""Who is compared with: families of encoder settings, and codecs that a user brings."""

from __future__ import annotations

import importlib

from rfcore.errors import InvalidInput
from rfedge.evaluate.clip import ClipCoder
from rfedge.evaluate.rivals import (
    Rival,
    svtav1_lowdelay,
    x264_for_psnr,
    x264_lowdelay,
    x265_for_psnr,
    x265_lowdelay,
)

__all__ = ["foreign_coder", "rival_families"]

KEYINTS = (10, 30, 250)


def rival_families(preset: str, *, quick: bool) -> dict[str, list[ClipCoder]]:
    """Return the rivals by codec: the anchors alone of their kind, the others at several settings.

    The first anchor is x264 as it comes, which is what a user has. It spends bits on looks that a
    PSNR does not see, and our encoder does not; the second is tuned for PSNR as ours is, and so are
    the stronger presets.
    """
    anchors: dict[str, list[ClipCoder]] = {
        "x264-lowdelay": [x264_lowdelay(preset)],
        "x264-lowdelay-psnr": [x264_for_psnr(preset)],
    }
    if quick:
        return {**anchors, "svtav1-lowdelay": [svtav1_lowdelay(8)]}
    return {
        **anchors,
        "x264-stronger": [x264_for_psnr(p) for p in ("medium", "veryslow")],
        **{f"x264-keyint-{n}": [_with_key_frames(preset, n)] for n in KEYINTS},
        "x264-intra-refresh": [_with_intra_refresh(preset)],
        "x265-lowdelay": [
            x265_lowdelay("veryfast"),
            *(x265_for_psnr(p) for p in ("veryfast", "medium")),
        ],
        "svtav1-lowdelay": [svtav1_lowdelay(p) for p in (10, 8, 6, 4)],
    }


def _with_key_frames(preset: str, keyint: int) -> Rival:
    return x264_lowdelay(preset, f"x264-keyint-{keyint}-{preset}", keyint=str(keyint))


def _with_intra_refresh(preset: str) -> Rival:
    """A column of intra blocks crosses the picture in ten frames; x264 waits as long before it."""
    params = {"intra-refresh": "1", "keyint": "10"}
    return x264_lowdelay(preset, f"x264-intra-refresh-10-{preset}", **params)


def foreign_coder(text: str) -> ClipCoder:
    """Return an instance of ``package.module:Class``; raise ``InvalidInput`` if there is none."""
    module, _, name = text.partition(":")
    try:
        coder: ClipCoder = getattr(importlib.import_module(module), name)()
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        raise InvalidInput("method", f"{text!r} is no package.module:Class ({error})") from error
    missing = [key for key in ("name", "points", "version", "code") if not hasattr(coder, key)]
    if missing:
        raise InvalidInput("method", f"{text!r} lacks {', '.join(missing)} of a ClipCoder")
    return coder
