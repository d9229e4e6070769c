"""Opens H.264 decoders: in the server itself, in processes of their own, or in sandboxes.

FFmpeg has been broken by crafted streams before, and will be again. Packets from other machines
are therefore decoded where a crash costs one frame and a decoder taken over can reach nothing
(``rfcore.confinement``): AUTO takes bubblewrap where it works, else Landlock, and nothing less. It
decodes in the server only when no other machine can reach it.

Decoder processes are forked from one that has started Python and FFmpeg, which takes 0.3 s of a
processor. The next process is forked before it is needed, so that a decoder that loses its process
has another one at once. One thread, which lives as long as the pool, starts all of them.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import nullcontext, suppress
from typing import Protocol

import structlog

from mec_server.config import DecoderKind
from mec_server.decoding.child import INPUT_BYTES, DecoderCommand
from mec_server.decoding.process import (
    DecoderLost,
    DecoderProcess,
    ForkServer,
    ForkServerRetired,
    LossCause,
    WaitContext,
)
from mec_server.ledger.peer_log import LogLimiter, PeerLog
from rfcore.codec.h264.ffmpeg import H264Decoder
from rfcore.codec.h264.splice import PictureDecoder
from rfcore.confinement.confine import Confinement
from rfcore.confinement.start import ConfinedProgram, check_not_root
from rfcore.errors import BackendUnavailable, CodecError, RfedgeError
from rfcore.image import I420

log = structlog.get_logger()

CONFINEMENTS = {
    DecoderKind.CHILD: Confinement.LIMITS,
    DecoderKind.LANDLOCK: Confinement.LANDLOCK,
    DecoderKind.BUBBLEWRAP: Confinement.BUBBLEWRAP,
}
BEST_FIRST = (DecoderKind.BUBBLEWRAP, DecoderKind.LANDLOCK)
"""The kinds that AUTO tries, in this order."""
MAX_STAGED = 15
"""Access units that can be sent with the one to decode; a frame has at most three references."""


def decoder_program(kind: DecoderKind) -> ConfinedProgram:
    """Return the program of a decoder process of ``kind``."""
    return ConfinedProgram("mec_server.decoding.child", CONFINEMENTS[kind], _environment())


def _environment() -> Mapping[str, str]:
    """Return the environment variables of a decoder process."""
    inherited = ("PYTHONPATH", "LD_LIBRARY_PATH")
    own = {"OPENBLAS_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    return own | {name: os.environ[name] for name in inherited if name in os.environ}


class OpenDecoder(Protocol):
    """Opens decoders."""

    def __call__(self, size_px: tuple[int, int]) -> PictureDecoder:
        """Return a decoder for pictures of ``size_px``; raise ``CodecError`` if there is none."""


class Decoders:
    """Opens decoders of one kind; ``start``, then ``open``, then ``close``, or ``with``.

    ``kind`` is the kind in force, never AUTO once started. ``reachable``: whether packets may come
    from other machines, which decides what AUTO means; ``as_root``: whether root may decode in a
    sandbox. ``quiet``: do not log which kind was taken; ``problem`` says why a better one was not.
    ``count_loss`` is called for each decoder process that dies in use, on any thread;
    ``start_failed`` with the reason why a spare process could not be started; ``limiter`` bounds
    the log lines about lost decoders; for ``waiting`` see ``DecoderPool``.
    """

    def __init__(
        self,
        kind: DecoderKind,
        *,
        reachable: bool = True,
        as_root: bool = False,
        quiet: bool = False,
        count_loss: Callable[[LossCause], None] = lambda _: None,
        start_failed: Callable[[Exception], None] = lambda _: None,
        limiter: LogLimiter | None = None,
        waiting: WaitContext = nullcontext,
    ) -> None:
        self.kind = kind
        if kind is DecoderKind.AUTO and not reachable:
            self.kind = DecoderKind.IN_PROCESS
            log.warning(
                "decoding in the server's own process",
                reason="--decoder auto, and only this machine can reach the server",
                remedy="--decoder bubblewrap or landlock, if programs here are not to be trusted",
            )
        self.problem = ""
        self._as_root = as_root
        self._quiet = quiet
        self._count_loss = count_loss
        self._start_failed = start_failed
        self._waiting = waiting
        self._lines = PeerLog(log, limiter or LogLimiter(), "decoders", time.monotonic)
        self._pool: DecoderPool | None = None

    def __enter__(self) -> Decoders:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def start(self) -> None:
        """Start a first spare process; raise ``BackendUnavailable`` if that fails."""
        if self.kind in (DecoderKind.AUTO, *BEST_FIRST):
            check_not_root(self._as_root)
        if self.kind is DecoderKind.AUTO:
            self._start_best()
        elif self.kind is not DecoderKind.IN_PROCESS:
            self._pool = self._pool_of(self.kind)
        if not self._quiet:
            if self.problem:
                log.warning(
                    "decoding in a lesser sandbox", decoder=str(self.kind), problem=self.problem
                )
            log.info("decoding", decoder=str(self.kind))

    def open(self, size_px: tuple[int, int]) -> PictureDecoder:
        """Return a decoder for pictures of ``size_px``."""
        return H264Decoder(size_px) if self._pool is None else self._pool.open(size_px)

    def close(self) -> None:
        """Start no more processes."""
        if self._pool is not None:
            self._pool.close()

    def _start_best(self) -> None:
        problems = []
        for kind in BEST_FIRST:
            try:
                self._pool, self.kind = self._pool_of(kind), kind
            except RfedgeError as error:
                problems.append(str(error))
                continue
            self.problem = problems[0] if problems else ""
            return
        raise BackendUnavailable(
            f"no sandbox for decoders works here: {'; '.join(problems)}. To decode without one, "
            "and to trust every sender, ask for it: --decoder child"
        )

    def _pool_of(self, kind: DecoderKind) -> DecoderPool:
        pool = DecoderPool(decoder_program(kind), self._lost, self._start_failed, self._waiting)
        try:
            pool.wait_until_ready()
        except RfedgeError as error:
            pool.close()
            raise BackendUnavailable(f"decoder {kind}: {error}") from error
        return pool

    def _lost(self, lost: DecoderLost) -> None:
        self._count_loss(lost.cause)
        self._lines.error("decoder lost", reason=str(lost.cause), pid=lost.pid, problem=str(lost))


class DecoderPool:
    """Starts decoder processes of ``program``.

    ``lost`` is called for each that dies in use, ``start_failed`` with what a spare could not be
    started for, on the starter's thread; whoever takes that spare has another one started. In the
    context of ``waiting`` a thread waits for an answer that does not come at once.
    """

    def __init__(
        self,
        program: ConfinedProgram,
        lost: Callable[[DecoderLost], None],
        start_failed: Callable[[Exception], None],
        waiting: WaitContext = nullcontext,
    ) -> None:
        self.waiting = waiting
        self._lost = lost
        self._start_failed = start_failed
        self._program = program
        self._lock = threading.Lock()
        self._forks: ForkServer | None = None
        self._starter = ThreadPoolExecutor(1, "decoder-starter")
        self._spare = self._starter.submit(self._start)

    def wait_until_ready(self) -> None:
        """Return when the spare process is ready; raise ``RfedgeError`` if none can be started."""
        self._spare.result()

    def take(self) -> DecoderProcess:
        """Return the spare process, and have another one started.

        A spare that has died is replaced. Raises ``RfedgeError`` if none can be started.
        """
        with suppress(RfedgeError):
            spare = self._next()
            if spare.is_alive:
                return spare
            spare.close()
        return self._next()

    def _next(self) -> DecoderProcess:
        with self._lock:
            try:
                spare, self._spare = self._spare, self._starter.submit(self._start_spare)
            except RuntimeError as error:
                raise RfedgeError("no decoder process is started any more") from error
        return spare.result()

    def open(self, size_px: tuple[int, int]) -> ChildDecoder:
        """Return a decoder for pictures of ``size_px``, in a process of its own."""
        return ChildDecoder(self, size_px)

    def lose(self, process: DecoderProcess, lost: DecoderLost) -> None:
        """Close a process that died in use, report it, and fork no other from where it came."""
        process.close()
        process.forks.retire()
        self._lost(lost)

    def close(self) -> None:
        """End the spare process; those in use are closed by their decoders."""
        self._starter.shutdown(cancel_futures=True)
        self._spare.add_done_callback(_close_started)
        if self._forks is not None:
            self._forks.retire()

    def _start_spare(self) -> DecoderProcess:
        try:
            return self._start()
        except Exception as error:
            self._start_failed(error)
            raise

    def _start(self) -> DecoderProcess:
        """Runs on the starter's thread."""
        process: DecoderProcess | None = None
        while process is None:
            with suppress(ForkServerRetired):  # one of its decoders was lost since it was looked at
                process = DecoderProcess(self._usable_forks())
        process.wait_until_ready()
        return process

    def _usable_forks(self) -> ForkServer:
        if self._forks is None or not self._forks.is_usable:
            if self._forks is not None:
                self._forks.retire()
            self._forks = ForkServer(self._program)
        return self._forks


class ChildDecoder:
    """``H264Decoder`` in another process: the same pictures and the same errors.

    Access units that are fed are staged in the shared memory until the next request, so that a
    frame is one request. A process that dies costs the picture it was asked for; the next request
    goes to the next process. One caller at a time, but ``close`` may come from any thread.
    """

    def __init__(self, pool: DecoderPool, size_px: tuple[int, int]) -> None:
        self._pool = pool
        self._size_px = size_px
        self._lock = threading.Lock()
        self._closed = False
        self._staged_bytes: list[int] = []
        self._process: DecoderProcess | None = self._open()

    def decode(self, access_unit: bytes) -> I420:
        """Decode one access unit of one whole picture, or raise ``CodecError``."""
        with self._lock:
            process = self._stage_unit(access_unit)
            self._request(process, DecoderCommand.DECODE, *self._take_staged())
            width, height = self._size_px
            return I420.unpacked(self._size_px, process.take(width * height * 3 // 2))

    def feed(self, access_unit: bytes | memoryview) -> None:
        """Decode as a reference for the next picture, and with it: errors may come then."""
        with self._lock:
            self._stage_unit(access_unit)

    def reset(self) -> None:
        """Forget everything; a process that died has nothing to forget."""
        with self._lock:
            self._staged_bytes.clear()
            if self._process is not None:
                self._request(self._process, DecoderCommand.RESET)

    def close(self) -> None:
        """End the process; nothing can be decoded any more."""
        with self._lock:
            self._closed = True
            if self._process is not None:
                self._process.close()
                self._process = None

    def _stage_unit(self, access_unit: bytes | memoryview) -> DecoderProcess:
        """Put an access unit behind those staged; where there is no room, have them decoded."""
        if self._process is None:
            self._process = self._open()
        process, size = self._process, len(access_unit)
        if size > INPUT_BYTES:
            raise CodecError(f"access unit of {size} bytes exceeds {INPUT_BYTES}")
        if len(self._staged_bytes) == MAX_STAGED or sum(self._staged_bytes) + size > INPUT_BYTES:
            self._request(process, DecoderCommand.FEED, *self._take_staged())
        process.put(access_unit, sum(self._staged_bytes))
        self._staged_bytes.append(size)
        return process

    def _take_staged(self) -> list[int]:
        """Return the lengths of the staged access units, for the request that decodes them."""
        lengths, self._staged_bytes = self._staged_bytes, []
        return lengths

    def _open(self) -> DecoderProcess:
        if self._closed:
            raise CodecError("decoder is closed: its stream is over")
        self._staged_bytes.clear()
        try:
            process = self._pool.take()
        except RfedgeError as error:
            raise CodecError(str(error)) from error
        self._request(process, DecoderCommand.OPEN, *self._size_px)
        return process

    def _request(self, process: DecoderProcess, command: DecoderCommand, *numbers: int) -> None:
        try:
            process.ask(command, *numbers, waiting=self._pool.waiting)
        except DecoderLost as lost:
            self._process = None
            self._pool.lose(process, lost)
            raise


def _close_started(spare: Future[DecoderProcess]) -> None:
    if not spare.cancelled() and spare.exception() is None:
        spare.result().close()
