"""Decoders in processes of their own, one per camera, and a spare one.

Processes are forked from one that has started Python and FFmpeg, which takes 0.3 s of a processor;
after a loss that one is replaced. The next process is forked before it is needed, so that a decoder
that loses its process has another one at once. All is started by one thread, which lives as long as
the pool.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import nullcontext, suppress

from mec_server.decoding.process import (
    DecoderLost,
    DecoderProcess,
    ForkServer,
    ForkServerRetired,
    WaitContext,
)
from mec_server.decoding.protocol import INPUT_BYTES, DecoderCommand
from rfcore.confinement.start import ConfinedProgram
from rfcore.errors import CodecError, RfedgeError
from rfcore.image import I420

__all__ = ["ChildDecoder", "DecoderPool"]

MAX_STAGED = 15
"""Access units that can be sent with the one to decode; a frame has at most three references."""


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
