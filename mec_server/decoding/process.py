"""One decoder process as the server sees it: started, sent requests, and found dead or killed.

A process that dies or does not answer is a ``DecoderLost``. The server reads nothing from it but
one-byte answers, short texts, and as many samples as it asked for.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import select
import signal
import socket
import subprocess
import tempfile
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack, nullcontext, suppress
from enum import StrEnum

from mec_server.decoding.protocol import (
    DONE,
    MAX_ANSWER_BYTES,
    MEMORY_BYTES,
    OUTPUT_AT,
    Command,
    request_to_bytes,
)
from rfcore.confinement.start import ConfinedProgram
from rfcore.errors import CodecError, RfedgeError

__all__ = ["DecoderLost", "DecoderProcess", "LossCause", "Waiting"]

START_S = 20.0
"""Time limit of its start: 0.3 s on an idle machine, more on one that swaps or is overloaded."""

ANSWER_S = 2.0
"""Time limit of an answer: a thousand times what a 640x360 picture takes."""

PATIENCE_S = 0.1
"""An answer that takes longer is waited for without holding a worker of the server."""

Waiting = Callable[[], AbstractContextManager[None]]
"""Makes a context in which a thread waits, so that another one may work in its place."""

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


class DecoderProcess:
    """A decoder process: ``program`` is ``mec_server.decoding.child`` in its confinement.

    Make it on a thread that outlives the process: bubblewrap ends with the thread that started it.
    """

    def __init__(self, program: ConfinedProgram) -> None:
        with ExitStack() as until_started:
            self._errors = until_started.enter_context(tempfile.TemporaryFile())
            memory_fd = os.memfd_create("decoder", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
            until_started.callback(os.close, memory_fd)
            os.ftruncate(memory_fd, MEMORY_BYTES)
            fcntl.fcntl(memory_fd, fcntl.F_ADD_SEALS, SEALS)
            self._memory = until_started.enter_context(mmap.mmap(memory_fd, MEMORY_BYTES))
            self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            until_started.enter_context(self._control)
            with theirs:
                self._process = self._start(program, theirs.fileno(), memory_fd)
            until_started.pop_all()
            os.close(memory_fd)
        self.pid = self._process.pid

    def _start(self, program: ConfinedProgram, *descriptors: int) -> subprocess.Popen[bytes]:
        return program.start(list(map(str, descriptors)), descriptors, stderr=self._errors)

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

    def ask(self, command: Command, *numbers: int, waiting: Waiting = nullcontext) -> None:
        """Send a request and wait for its answer, for long in the context of ``waiting``.

        Raises ``DecoderLost``, or ``CodecError`` if FFmpeg refuses.
        """
        with suppress(OSError):  # a process that ended is noticed when its answer is received
            self._control.send(request_to_bytes(command, *numbers))
        with nullcontext() if self._answers_within(PATIENCE_S) else waiting():
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

    def _answers_within(self, patience_s: float) -> bool:
        poll = select.poll()
        poll.register(self._control, select.POLLIN)
        return bool(poll.poll(patience_s * 1e3))

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
        if number in signal.valid_signals():
            return DecoderLost(LossCause.SIGNAL, self.pid, f"was killed by {_signal_name(number)}")
        return DecoderLost(LossCause.EXIT, self.pid, f"ended with status {status}")


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:  # real-time signals have no names of their own
        return f"signal {number}"
