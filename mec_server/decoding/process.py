"""One decoder process as the server sees it: started, sent requests, and found dead or killed.

A process that dies or does not answer is a ``DecoderLost``. The server reads nothing from it but
one-byte answers, short texts, and as many samples as it asked for.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from enum import StrEnum

from mec_server.decoding.protocol import (
    DONE,
    MAX_ANSWER_BYTES,
    MEMORY_BYTES,
    OUTPUT_AT,
    Command,
    request_to_bytes,
)
from rfcore.errors import CodecError, RfedgeError

__all__ = ["DecoderLost", "DecoderProcess", "LossCause", "child_environment"]

START_S = 20.0
"""Time limit of its start: 0.3 s on an idle machine, more on one that swaps or is overloaded."""

ANSWER_S = 2.0
"""Time limit of an answer: a thousand times what a 640x360 picture takes."""

SEALS = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL


class LossCause(StrEnum):
    """How a decoder process ended."""

    SIGNAL = "signal"
    EXIT = "exit"
    TIMEOUT = "timeout"


class DecoderLost(CodecError):
    """A decoder process died, or had to be killed."""

    def __init__(self, cause: LossCause, pid: int, problem: str) -> None:
        super().__init__(f"decoder process {pid} {problem}")
        self.cause = cause
        self.pid = pid


def child_environment() -> Mapping[str, str]:
    """Return the environment variables of a decoder process."""
    inherited = ("PYTHONPATH", "LD_LIBRARY_PATH")
    own = {"OPENBLAS_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    return own | {name: os.environ[name] for name in inherited if name in os.environ}


class DecoderProcess:
    """A decoder process, started by ``wrapper``: a command line that runs its own arguments.

    Make it on a thread that outlives the process: bubblewrap ends with the thread that started it.
    """

    def __init__(self, wrapper: Sequence[str] = ()) -> None:
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the process
        memory_fd = os.memfd_create("decoder", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        try:
            os.ftruncate(memory_fd, MEMORY_BYTES)
            fcntl.fcntl(memory_fd, fcntl.F_ADD_SEALS, SEALS)
            self._memory = mmap.mmap(memory_fd, MEMORY_BYTES)
            self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            with theirs:
                self._process = self._start(wrapper, theirs.fileno(), memory_fd)
        finally:
            os.close(memory_fd)
        self.pid = self._process.pid

    def _start(self, wrapper: Sequence[str], *descriptors: int) -> subprocess.Popen[bytes]:
        python = [sys.executable, "-P", "-m", "mec_server.decoding.child"]
        return subprocess.Popen(
            [*wrapper, *python, *map(str, descriptors)],
            pass_fds=descriptors,
            env=child_environment(),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=self._errors,
        )

    def wait_until_ready(self) -> None:
        """Return when it answers; raise ``RfedgeError`` with its last line of errors otherwise."""
        try:
            self._receive(START_S)
        except DecoderLost as lost:
            self._errors.seek(0)
            errors = self._errors.read()[-4000:].decode(errors="replace").strip().splitlines()
            self.close()
            raise RfedgeError(
                f"{lost} at its start: {errors[-1] if errors else 'no message'}"
            ) from lost

    @property
    def is_alive(self) -> bool:
        """Whether it runs."""
        return self._process.poll() is None

    def ask(self, command: Command, *numbers: int) -> None:
        """Send a request and wait for its answer.

        Raises ``DecoderLost``, or ``CodecError`` if FFmpeg refuses.
        """
        with suppress(OSError):  # a process that ended is noticed when its answer is received
            self._control.send(request_to_bytes(command, *numbers))
        answer = self._receive(ANSWER_S)
        if answer != DONE:
            raise CodecError(answer[1:].decode(errors="replace"))

    def put(self, access_unit: bytes | memoryview, start: int) -> None:
        """Write an access unit into the shared memory; the caller checks that there is room."""
        self._memory[start : start + len(access_unit)] = access_unit

    def take(self, size_bytes: int) -> bytes:
        """Return a copy of the picture decoded last; the process may overwrite its own any time."""
        return self._memory[OUTPUT_AT : OUTPUT_AT + size_bytes]

    def close(self) -> None:
        """Kill and reap it."""
        self._process.kill()
        self._process.wait()
        self._control.close()
        self._memory.close()
        self._errors.close()

    def _receive(self, within_s: float) -> bytes:
        self._control.settimeout(within_s)
        try:
            answer = self._control.recv(MAX_ANSWER_BYTES)
        except TimeoutError:
            self._process.kill()
            problem = f"did not answer within {within_s:g} s and was killed"
            raise DecoderLost(LossCause.TIMEOUT, self.pid, problem) from None
        except OSError:
            answer = b""
        if not answer:
            raise self._ended()
        return answer

    def _ended(self) -> DecoderLost:
        try:
            status = self._process.wait(ANSWER_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return DecoderLost(LossCause.EXIT, self.pid, "hung up and was killed")
        number = -status if status < 0 else status - 128  # as bubblewrap and shells pass it on
        if number > 0:
            name = signal.Signals(number).name
            return DecoderLost(LossCause.SIGNAL, self.pid, f"was killed by {name}")
        return DecoderLost(LossCause.EXIT, self.pid, f"ended with status {status}")
