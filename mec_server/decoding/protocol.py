"""Protocol between a server and its decoder processes: requests on a socket, data in shared memory.

A request is a command and its numbers, one message of a SOCK_SEQPACKET socket; the answer is
``DONE``, or ``FAILED`` and an error text. Access units stand one after the other at the start of
the memory, a decoded picture (I420, plane after plane, of the size given by OPEN) at ``OUTPUT_AT``.
The memory is a sealed memfd: it cannot shrink under its reader, is on no disk, and only pages in
use take memory.

Decoder processes are forked from one that has imported all they need, the fork server, over a
socket of the same kind. A message with three descriptors (socket, memory, file for errors) forks
one; the answer is ``DONE`` with its process number in the fork server's namespace and, as a
descriptor, its pidfd (pidfd_open(2)). A message with such a number reaps a process that ended or
was killed; the answer is ``DONE`` with its exit status, negative for a signal. What fails is
answered as above.
"""

from __future__ import annotations

import struct
from enum import IntEnum

from rfcore.codec.h264.config import MAX_MACROBLOCKS

__all__ = [
    "DONE",
    "FAILED",
    "INPUT_BYTES",
    "MAX_ANSWER_BYTES",
    "MAX_REQUEST_BYTES",
    "MEMORY_BYTES",
    "NUMBER",
    "OUTPUT_AT",
    "DecoderCommand",
    "request_from_bytes",
    "request_to_bytes",
]

SAMPLES_PER_MACROBLOCK = 384

INPUT_BYTES = MAX_MACROBLOCKS * SAMPLES_PER_MACROBLOCK * 3 // 2 + (1 << 20)
"""The largest I_PCM picture, all of it escaped (7.4.1), with parameter sets and syntax to spare."""

OUTPUT_AT = (INPUT_BYTES + 4095) // 4096 * 4096
MEMORY_BYTES = OUTPUT_AT + MAX_MACROBLOCKS * SAMPLES_PER_MACROBLOCK

DONE, FAILED = b".", b"!"
NUMBER = struct.Struct("<i")
"""A process number, or an exit status."""
MAX_ANSWER_BYTES = 1024
MAX_REQUEST_BYTES = 1 + 4 * 16


class DecoderCommand(IntEnum):
    """What a decoder process can be asked for: OPEN with width and height, RESET, and with the
    lengths of access units FEED, which decodes them, and DECODE, which also returns the last."""

    OPEN = 1
    FEED = 2
    DECODE = 3
    RESET = 4


def request_to_bytes(command: DecoderCommand, *numbers: int) -> bytes:
    """Return a request as it is sent."""
    return struct.pack(f"<B{len(numbers)}I", command, *numbers)


def request_from_bytes(data: bytes) -> tuple[DecoderCommand, tuple[int, ...]]:
    """Return the command and its numbers."""
    command, *numbers = struct.unpack(f"<B{(len(data) - 1) // 4}I", data)
    return DecoderCommand(command), tuple(numbers)
