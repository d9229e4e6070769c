"""The decoder processes: each runs FFmpeg's H.264 decoder alone, with as few rights as possible.

``mec_server.decoding.process`` starts ``python -m mec_server.decoding.child CONFINEMENT SOCKET``
once: the fork server. It imports what decoders need, reads nothing but the server's requests, and
forks a decoder process for each, which takes milliseconds where a start of Python and FFmpeg takes
0.3 s of a processor. A decoder process confines itself (``rfcore.confinement``) before it reads
the first byte that comes from a vehicle, and ends when its socket is closed. The limit of CPU time
is for one request and is moved on before each.

*Protocol.* A request is a command and its numbers, one message of a SOCK_SEQPACKET socket; the
answer is ``DONE``, or ``FAILED`` and an error text. Access units stand one after the other at the
start of the shared memory, a decoded picture (I420, plane after plane, of the size given by OPEN)
at ``OUTPUT_AT``. The memory is a sealed memfd: it cannot shrink under its reader, is on no disk,
and only pages in use take memory.

The fork server has a socket of the same kind. A message with three descriptors (socket, memory,
file for errors) forks a process; the answer is ``DONE`` with its process number in the fork
server's namespace and, as a descriptor, its pidfd (pidfd_open(2)). A message with such a number
reaps a process that ended or was killed; the answer is ``DONE`` with its exit status, negative for
a signal. A failure is answered as above.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import resource
import socket
import struct
import sys
import traceback
from collections.abc import Iterator, Sequence
from enum import IntEnum
from typing import NoReturn

import numpy as np

from rfcore.codec.h264.config import MAX_MACROBLOCKS
from rfcore.codec.h264.ffmpeg import H264Decoder
from rfcore.confinement.confine import Confinement, ProcessLimits, confine
from rfcore.errors import CodecError
from rfcore.image import I420

LIMITS = ProcessLimits(address_space_bytes=1 << 30)
"""0.2 GiB is the interpreter; a 4096x2304 picture is 14 MB, and FFmpeg holds some twenty."""

REQUEST_CPU_S = 5

DECODER_NAME, FORK_SERVER_NAME = "decoder", "decoder-forks"
"""Names of the processes in lists of processes (``ps -o comm``)."""

PR_SET_NAME = 15


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
    """Requests to a decoder process: OPEN with width and height, RESET, and with the lengths of
    access units FEED, which decodes them, and DECODE, which also returns the last picture."""

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

    def _obey(self, command: DecoderCommand, numbers: Sequence[int]) -> None:
        if command is DecoderCommand.OPEN:
            width_px, height_px = numbers
            self._decoder = H264Decoder((width_px, height_px))
            return
        if self._decoder is None:
            raise CodecError("decoder process: nothing is open")
        if command is DecoderCommand.RESET:
            self._decoder.reset()
            return
        units = list(self._units(numbers))
        wanted = units.pop() if command is DecoderCommand.DECODE else None
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


def _name_process(name: str) -> None:
    ctypes.CDLL(None).prctl(PR_SET_NAME, name.encode(), 0, 0, 0)


def _decode(confinement: Confinement, control_fd: int, memory_fd: int) -> None:
    """Serve a decoder's requests until its socket closes."""
    control = socket.socket(fileno=control_fd)
    child = DecoderChild(mmap.mmap(memory_fd, MEMORY_BYTES))
    confine(confinement, LIMITS)
    control.send(DONE)
    while request := control.recv(MAX_REQUEST_BYTES):
        _allow_cpu()
        control.send(child.answer(request))


def _run_decoder(confinement: Confinement, control_fd: int, memory_fd: int, errors_fd: int) -> int:
    """Run in a forked process; return its exit status."""
    try:
        os.dup2(errors_fd, sys.stderr.fileno())
        _name_process(DECODER_NAME)
        _decode(confinement, control_fd, memory_fd)
    except BaseException:
        traceback.print_exc()
        sys.stderr.flush()
        return 1
    return 0


class ForkServer:
    """Forks decoder processes, and reaps them."""

    def __init__(self, requests: socket.socket, confinement: Confinement) -> None:
        self._requests = requests
        self._confinement = confinement

    def serve(self) -> None:
        """Answer requests until their socket closes."""
        self._requests.send(DONE)
        while True:
            request, descriptors, _, _ = socket.recv_fds(self._requests, MAX_REQUEST_BYTES, 3)
            if not request:
                return
            try:
                if descriptors:
                    self._fork(descriptors)
                else:
                    self._reap(request)
            except OSError as error:
                self._requests.send(FAILED + str(error).encode()[: MAX_ANSWER_BYTES - 1])
            finally:
                for descriptor in descriptors:
                    os.close(descriptor)

    def _fork(self, descriptors: Sequence[int]) -> None:
        pid = os.fork()
        if not pid:
            self._become_decoder(descriptors)
        pidfd = os.pidfd_open(pid)
        try:
            socket.send_fds(self._requests, [DONE + NUMBER.pack(pid)], [pidfd])
        finally:
            os.close(pidfd)

    def _become_decoder(self, descriptors: Sequence[int]) -> NoReturn:
        self._requests.close()
        control_fd, memory_fd, errors_fd = descriptors
        os._exit(_run_decoder(self._confinement, control_fd, memory_fd, errors_fd))

    def _reap(self, request: bytes) -> None:
        (pid,) = NUMBER.unpack(request)
        _, status = os.waitpid(pid, 0)
        self._requests.send(DONE + NUMBER.pack(os.waitstatus_to_exitcode(status)))


def main() -> None:
    """Be the fork server until its socket closes."""
    confinement, requests_fd = sys.argv[1:]
    _name_process(FORK_SERVER_NAME)
    ForkServer(socket.socket(fileno=int(requests_fd)), Confinement(confinement)).serve()


if __name__ == "__main__":
    main()
