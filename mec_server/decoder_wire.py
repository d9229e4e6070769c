"""What a server and its decoder processes agree on: commands, and a piece of memory they share.

A request is ``REQUEST`` on a socket that keeps messages apart; the answer is ``DONE``, or
``FAILED`` and what is wrong. Bytes to decode lie at the start of the memory, a decoded picture
(I420, plane after plane, of the size given by OPEN) at ``OUTPUT_AT``. The memory is a sealed memfd:
it cannot shrink under its reader, is on no disk, and only the pages in use exist.
"""

from __future__ import annotations

import struct
from enum import IntEnum

from rfcore.codec.config import MAX_MACROBLOCKS

__all__ = [
    "DONE",
    "FAILED",
    "INPUT_BYTES",
    "MAX_ANSWER_BYTES",
    "MEMORY_BYTES",
    "OUTPUT_AT",
    "REQUEST",
    "Command",
]

SAMPLES_PER_MACROBLOCK = 384

INPUT_BYTES = MAX_MACROBLOCKS * SAMPLES_PER_MACROBLOCK * 3 // 2 + (1 << 20)
"""The largest I_PCM picture, all of it escaped (7.4.1), with parameter sets and syntax to spare."""

OUTPUT_AT = (INPUT_BYTES + 4095) // 4096 * 4096
MEMORY_BYTES = OUTPUT_AT + MAX_MACROBLOCKS * SAMPLES_PER_MACROBLOCK

REQUEST = struct.Struct("<BII")
"""Command and two numbers: width and height for OPEN, else a length and 0."""

DONE, FAILED = b".", b"!"
MAX_ANSWER_BYTES = 1024


class Command(IntEnum):
    """What a decoder process can be asked for."""

    OPEN = 1
    FEED = 2
    DECODE = 3
    RESET = 4
