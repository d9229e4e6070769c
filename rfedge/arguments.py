"""What commands take on the command line, and durations as they print them.

The placeholders stand in a verb's help where a type's name (PATH, STR) would say nothing::

    field: Annotated[Path, Positional, FIELD]

This module is imported for every ``--help`` and therefore imports nothing heavy itself.
"""

from __future__ import annotations

import re

from tyro.conf import arg

from rfcore.errors import InvalidInput

__all__ = [
    "ADDRESS",
    "DATASET",
    "FIELD",
    "FOLDER",
    "JSON",
    "PLY",
    "RFF",
    "SCENE",
    "SIZE",
    "parse_size",
    "time_text",
]

FIELD = arg(metavar="FIELD")
"""An archive's path, or a name (``rfedge.fields.find``)."""
DATASET = arg(metavar="DATASET")
"""A dataset's folder, or the file that describes it (docs/data.md)."""
SCENE = arg(metavar="SCENE")
ADDRESS = arg(metavar="HOST:PORT")
SIZE = arg(metavar="WIDTHxHEIGHT")
FOLDER = arg(metavar="FOLDER")
RFF = arg(metavar="FILE.rff")
PLY = arg(metavar="FILE.ply")
JSON = arg(metavar="FILE.json")


def parse_size(text: str) -> tuple[int, int]:
    """Return (width, height) in pixels; raise ``InvalidInput`` for anything but ``640x360``."""
    from rfcore.camera import MAX_SIDE_PX

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
