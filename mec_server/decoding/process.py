"""Decoder processes as the server sees them: forked, sent requests, and found dead or killed.

A process that dies or does not answer is a ``DecoderLost``. The server reads nothing from it but
one-byte answers, short texts, and as many samples as it asked for.

Processes of one fork server have the same addresses in memory, which a sender could try to find out
by crashing one after the other. One fork server is therefore not used any more once a decoder of it
was lost (``ForkServer.retire``).
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
import threading
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext, suppress
from enum import StrEnum
from pathlib import Path
from typing import IO

from mec_server.decoding.child import (
    DONE,
    FAILED,
    MAX_ANSWER_BYTES,
    MEMORY_BYTES,
    NUMBER,
    OUTPUT_AT,
    DecoderCommand,
    request_to_bytes,
)
from rfcore.confinement.start import ConfinedProgram
from rfcore.errors import CodecError, RfedgeError

START_S = 20.0
"""Time limit of the fork server's start, 0.3 s on an idle machine and more on one that swaps or is
overloaded, and of a fork, some ms."""

ANSWER_S = 2.0
"""Time limit of an answer: a thousand times what a 640x360 picture takes."""

PATIENCE_S = 0.03
"""An answer that takes longer, as one of 1080p may, is waited for without holding a worker of the
server: a decoder that hangs costs others no more."""

WaitContext = Callable[[], AbstractContextManager[None]]
"""Makes a context in which a thread waits, so that another one may work in its place."""

SEALS = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL


class LossCause(StrEnum):
    """The way in which a decoder process ended."""

    SIGNAL = "signal"
    EXIT = "exit"
    TIMEOUT = "timeout"


class DecoderLost(CodecError):
    """A decoder process died, or had to be killed."""

    def __init__(self, cause: LossCause, pid: int, problem: str) -> None:
        super().__init__(f"decoder process {pid} {problem}")
        self.cause = cause
        self.pid = pid


class ForkServerRetired(RfedgeError):
    """A fork server forks no more: one of its decoders was lost."""


class ForkServer:
    """The process that decoder processes are forked from; ``program`` is
    ``mec_server.decoding.child`` in its confinement.

    Make it on a thread that outlives it: bubblewrap ends with the thread that started it, and all
    processes in the sandbox with bubblewrap. Its methods may be called on any thread. Raises
    ``RfedgeError`` if it does not start.
    """

    def __init__(self, program: ConfinedProgram) -> None:
        self._lock = threading.Lock()
        self._in_use = 0
        self._retired = self._closed = False
        with ExitStack() as until_started:
            self._errors = until_started.enter_context(tempfile.TemporaryFile())
            self._requests, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            until_started.enter_context(self._requests)
            descriptor = theirs.fileno()
            with theirs:
                self._process = program.start([str(descriptor)], [descriptor], stderr=self._errors)
            until_started.pop_all()
        self._requests.settimeout(START_S)
        try:
            self._answer()
        except RfedgeError as error:
            self._close()
            with self._errors:
                message = _last_line(self._errors)
            raise RfedgeError(f"{error} at its start: {message}") from error

    @property
    def is_usable(self) -> bool:
        """Whether processes may be forked from it: it runs, and no decoder of it was lost."""
        return not self._retired and self._process.poll() is None

    def fork(self, descriptors: Sequence[int]) -> tuple[int, int]:
        """Fork a decoder process with ``descriptors``: its socket, memory and file for errors.

        Returns the number to reap it by and its pidfd, which is the caller's to close. Raises
        ``ForkServerRetired``, or ``RfedgeError``.
        """
        with self._lock:
            if self._retired:
                raise ForkServerRetired("fork server of decoders: one of them was lost")
            answer, received = self._ask(b" ", descriptors)
            self._in_use += 1
        (pidfd,) = received
        (number,) = NUMBER.unpack(answer.removeprefix(DONE))
        return number, pidfd

    def reap(self, number: int) -> int | None:
        """Return the exit status of a process that ended, negative for a signal.

        None if the fork server has ended itself. The last process of one that is retired closes it.
        """
        status: int | None = None
        with self._lock:
            with suppress(RfedgeError):
                answer, _ = self._ask(NUMBER.pack(number))
                (status,) = NUMBER.unpack(answer.removeprefix(DONE))
            self._in_use -= 1
            self._close_if_done()
        return status

    def retire(self) -> None:
        """Fork no more; it ends with the last process of it."""
        with self._lock:
            self._retired = True
            self._close_if_done()

    def _ask(self, request: bytes, descriptors: Sequence[int] = ()) -> tuple[bytes, Sequence[int]]:
        try:
            socket.send_fds(self._requests, [request], descriptors)
        except OSError as error:
            raise RfedgeError(f"fork server of decoders: {error}") from error
        return self._answer()

    def _answer(self) -> tuple[bytes, Sequence[int]]:
        flags = socket.MSG_CMSG_CLOEXEC
        try:
            answer, received, _, _ = socket.recv_fds(self._requests, MAX_ANSWER_BYTES, 1, flags)
        except OSError as error:
            self._process.kill()  # what it answers late would be taken for another answer
            raise RfedgeError(f"fork server of decoders: {error}") from error
        if not answer:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(ANSWER_S)
            status = self._process.returncode
            raise RfedgeError(f"fork server of decoders ended with status {status}")
        if answer.startswith(FAILED):
            text = answer[1:].decode(errors="replace")
            raise RfedgeError(f"fork server of decoders: {text}")
        return answer, received

    def _close_if_done(self) -> None:
        if self._retired and not self._in_use and not self._closed:
            self._close()
            self._errors.close()

    def _close(self) -> None:
        self._closed = True
        self._process.kill()
        self._process.wait()
        self._requests.close()


class DecoderProcess:
    """A decoder process, forked from ``forks``."""

    def __init__(self, forks: ForkServer) -> None:
        self.forks = forks
        self._status: int | None = None
        self._reaped = False
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
                descriptors = (theirs.fileno(), memory_fd, self._errors.fileno())
                self._number, self._pidfd = forks.fork(descriptors)
            until_started.pop_all()
            os.close(memory_fd)
        self.pid = _pid_of(self._pidfd)

    def wait_until_ready(self) -> None:
        """Return when it answers; raise ``RfedgeError`` with its last line of errors otherwise."""
        try:
            self._receive(START_S)
        except DecoderLost as lost:
            message = _last_line(self._errors)
            self.close()
            raise RfedgeError(f"{lost} at its start: {message}") from lost

    @property
    def is_alive(self) -> bool:
        """Whether it runs."""
        return not _is_readable(self._pidfd, 0.0)

    def ask(
        self, command: DecoderCommand, *numbers: int, waiting: WaitContext = nullcontext
    ) -> None:
        """Send a request and wait for its answer, for long in the context of ``waiting``.

        Raises ``DecoderLost``, or ``CodecError`` if FFmpeg refuses.
        """
        with suppress(OSError):  # a process that ended is noticed when its answer is received
            self._control.send(request_to_bytes(command, *numbers))
        with nullcontext() if _is_readable(self._control.fileno(), PATIENCE_S) else waiting():
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
        self._kill()
        self._reap()
        self._control.close()
        self._memory.close()
        self._errors.close()
        os.close(self._pidfd)

    def _kill(self) -> None:
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(self._pidfd, signal.SIGKILL)

    def _reap(self) -> int | None:
        """Return the exit status of a process that ended or was killed, once it is known."""
        if not self._reaped:
            self._reaped, self._status = True, self.forks.reap(self._number)
        return self._status

    def _receive(self, within_s: float) -> bytes:
        self._control.settimeout(within_s)
        try:
            answer = self._control.recv(MAX_ANSWER_BYTES)
        except TimeoutError:
            self._kill()
            problem = f"did not answer within {within_s:g} s and was killed"
            raise DecoderLost(LossCause.TIMEOUT, self.pid, problem) from None
        except OSError:
            answer = b""
        if not answer:
            raise self._ended()
        return answer

    def _ended(self) -> DecoderLost:
        if not _is_readable(self._pidfd, ANSWER_S):
            self._kill()
            return DecoderLost(LossCause.EXIT, self.pid, "hung up and was killed")
        status = self._reap()
        if status is None:
            return DecoderLost(LossCause.EXIT, self.pid, "ended, and its fork server too")
        if status < 0:
            return DecoderLost(LossCause.SIGNAL, self.pid, f"was killed by {_signal_name(-status)}")
        return DecoderLost(LossCause.EXIT, self.pid, f"ended with status {status}")


def _is_readable(descriptor: int, within_s: float) -> bool:
    """Return whether there is something to read in time; of a pidfd: whether its process ended."""
    poll = select.poll()
    poll.register(descriptor, select.POLLIN)
    return bool(poll.poll(within_s * 1e3))


def _pid_of(pidfd: int) -> int:
    """Return the number that a process has here, whatever it is called in a sandbox."""
    lines = Path(f"/proc/self/fdinfo/{pidfd}").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("Pid:")).removeprefix("Pid:"))


def _last_line(errors: IO[bytes]) -> str:
    errors.seek(0)
    lines = errors.read()[-4000:].decode(errors="replace").strip().splitlines()
    return lines[-1] if lines else "no message"


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:  # real-time signals have no names of their own
        return f"signal {number}"
