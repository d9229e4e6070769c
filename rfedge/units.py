"""Picture sizes as commands take them: WIDTHxHEIGHT.

Durations as people say them.
"""

from __future__ import annotations

import re

from rfcore.camera import MAX_SIDE_PX
from rfcore.errors import InvalidInput

__all__ = ["parse_size", "time_text"]


def parse_size(text: str) -> tuple[int, int]:
    """Return (width, height) in pixels; raise ``InvalidInput`` for anything but ``640x360``."""
    match = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", text, re.ASCII)
    if match is None:
        raise InvalidInput("size", f"'{text}' is not WIDTHxHEIGHT, such as 640x360")
    width_px, height_px = int(match[1]), int(match[2])
    if max(width_px, height_px) > MAX_SIDE_PX:
        raise InvalidInput("size", f"{text} is over the limit of {MAX_SIDE_PX} px")
    return width_px, height_px


def time_text(seconds: float) -> str:
    """Return a duration in the unit that fits it."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
