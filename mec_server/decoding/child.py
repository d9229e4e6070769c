"""The decoder process: runs FFmpeg's H.264 decoder alone, with as few rights as possible.

Started by ``mec_server.decoding.process`` as ``python -m mec_server.decoding.child CONFINEMENT
SOCKET MEMORY``, the last two inherited descriptors; it ends when the socket is closed. Before it
reads the first byte that comes from a vehicle it confines itself (``rfcore.confinement``). The
limit of CPU time is for one request and is moved on before each.
"""

from __future__ import annotations

import mmap
import resource
import socket
import sys
from collections.abc import Iterator, Sequence

import numpy as np

from mec_server.decoding.protocol import (
    DONE,
    FAILED,
    MAX_ANSWER_BYTES,
    MAX_REQUEST_BYTES,
    MEMORY_BYTES,
    OUTPUT_AT,
    Command,
    request_from_bytes,
)
from rfcore.codec.h264.ffmpeg import H264Decoder
from rfcore.confinement.confine import Confinement, ProcessLimits, confine
from rfcore.errors import CodecError
from rfcore.image import I420

__all__ = ["LIMITS", "REQUEST_CPU_S", "main"]

LIMITS = ProcessLimits(address_space_bytes=1 << 30)
"""0.2 GiB is the interpreter; a 4096x2304 picture is 14 MB, and FFmpeg holds some twenty."""

REQUEST_CPU_S = 5


class DecoderChild:
    """Answers requests about one stream."""

    def __init__(self, memory: mmap.mmap) -> None:
        self._memory = memory
        self._decoder: H264Decoder | None = None

    def answer(self, request: bytes) -> bytes:
        """Do what ``request`` asks for; return the answer."""
        command, numbers = request_from_bytes(request)
        try:
            self._obey(command, numbers)
        except CodecError as error:
            return FAILED + str(error).encode()[: MAX_ANSWER_BYTES - 1]
        return DONE

    def _obey(self, command: Command, numbers: Sequence[int]) -> None:
        if command is Command.OPEN:
            width_px, height_px = numbers
            self._decoder = H264Decoder((width_px, height_px))
            return
        if self._decoder is None:
            raise CodecError("decoder process: nothing is open")
        if command is Command.RESET:
            self._decoder.reset()
            return
        units = list(self._units(numbers))
        wanted = units.pop() if command is Command.DECODE else None
        for unit in units:
            self._decoder.feed(unit)
        if wanted is not None:
            self._put(self._decoder.decode(bytes(wanted)))

    def _units(self, lengths: Sequence[int]) -> Iterator[memoryview]:
        """Yield the access units in place: FFmpeg copies each once, to pad it."""
        memory, start = memoryview(self._memory), 0
        for length in lengths:
            yield memory[start : start + length]
            start += length

    def _put(self, picture: I420) -> None:
        offset = OUTPUT_AT
        for plane in picture.planes:
            target = np.frombuffer(self._memory, np.uint8, plane.size, offset)
            target.reshape(plane.shape)[:] = plane
            offset += plane.size


def _allow_cpu() -> None:
    """Let the kernel end this process if the next request keeps it busy for too long."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    until_s = int(used.ru_utime + used.ru_stime) + REQUEST_CPU_S + 1
    resource.setrlimit(resource.RLIMIT_CPU, (until_s, resource.RLIM_INFINITY))


def main() -> None:
    """Serve until the socket closes."""
    confinement, control_fd, memory_fd = sys.argv[1:]
    control = socket.socket(fileno=int(control_fd))
    child = DecoderChild(mmap.mmap(int(memory_fd), MEMORY_BYTES))
    confine(Confinement(confinement), LIMITS)
    control.send(DONE)
    while request := control.recv(MAX_REQUEST_BYTES):
        _allow_cpu()
        control.send(child.answer(request))


if __name__ == "__main__":
    main()
