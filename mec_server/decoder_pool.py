"""Decoders in processes of their own, one a camera, and one that stands ready.

Starting Python and FFmpeg takes 0.3 s, so the next process is started before it is needed: whoever
loses one has another at once. All are started by one thread, which lives as long as the pool.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress

from mec_server.decoder_process import DecoderLost, DecoderProcess
from mec_server.decoder_wire import Command
from rfcore.errors import CodecError, RfedgeError
from rfcore.image import I420

__all__ = ["ChildDecoder", "DecoderPool"]


class DecoderPool:
    """Starts decoder processes behind ``wrapper``; ``lost`` is told of each that dies in use."""

    def __init__(self, wrapper: Sequence[str], lost: Callable[[DecoderLost], None]) -> None:
        self.lost = lost
        self._wrapper = tuple(wrapper)
        self._lock = threading.Lock()
        self._starter = ThreadPoolExecutor(1, "decoder-starter")
        self._spare = self._starter.submit(self._start)

    def wait_until_ready(self) -> None:
        """Return when a process stands ready; raise ``RfedgeError`` if none can be started."""
        self._spare.result()

    def take(self) -> DecoderProcess:
        """Return the process that stands ready, and have another started.

        One that died while it waited is passed over. Raises ``RfedgeError`` if none can be started.
        """
        with suppress(RfedgeError):
            ready = self._next()
            if ready.is_alive:
                return ready
            ready.close()
        return self._next()

    def _next(self) -> DecoderProcess:
        with self._lock:
            try:
                spare, self._spare = self._spare, self._starter.submit(self._start)
            except RuntimeError as error:
                raise RfedgeError("no decoder process is started any more") from error
        return spare.result()

    def open(self, size_px: tuple[int, int]) -> ChildDecoder:
        """Return a decoder for pictures of ``size_px``, in a process of its own."""
        return ChildDecoder(self, size_px)

    def close(self) -> None:
        """End the process that stands ready; those in use are their users' to close."""
        self._starter.shutdown(cancel_futures=True)
        self._spare.add_done_callback(_close_started)

    def _start(self) -> DecoderProcess:
        process = DecoderProcess(self._wrapper)
        process.wait_until_ready()
        return process


class ChildDecoder:
    """``rfcore.codec.h264.H264Decoder`` in another process: the same pictures and the same errors.

    A process that dies costs the picture it was asked for; the next request has the next process.
    One caller at a time, but ``close`` may come from any thread.
    """

    def __init__(self, pool: DecoderPool, size_px: tuple[int, int]) -> None:
        self._pool = pool
        self._size_px = size_px
        self._lock = threading.Lock()
        self._closed = False
        self._process: DecoderProcess | None = self._open()

    def decode(self, access_unit: bytes) -> I420:
        """Decode one access unit of one whole picture, or raise ``CodecError``."""
        with self._lock:
            process = self._ask(Command.DECODE, access_unit)
            width, height = self._size_px
            return I420.unpacked(self._size_px, process.take(width * height * 3 // 2))

    def feed(self, access_unit: bytes) -> None:
        """Decode like ``decode``, for the sake of what comes after."""
        with self._lock:
            self._ask(Command.FEED, access_unit)

    def reset(self) -> None:
        """Forget everything; a process that died has nothing to forget."""
        with self._lock:
            if self._process is not None:
                self._request(self._process, Command.RESET)

    def close(self) -> None:
        """End the process; nothing can be decoded any more."""
        with self._lock:
            self._closed = True
            if self._process is not None:
                self._process.close()
                self._process = None

    def _ask(self, command: Command, access_unit: bytes) -> DecoderProcess:
        if self._process is None:
            self._process = self._open()
        process = self._process
        process.put(access_unit)
        self._request(process, command, len(access_unit))
        return process

    def _open(self) -> DecoderProcess:
        if self._closed:
            raise CodecError("decoder is closed: its stream is over")
        try:
            process = self._pool.take()
        except RfedgeError as error:
            raise CodecError(str(error)) from error
        self._request(process, Command.OPEN, *self._size_px)
        return process

    def _request(self, process: DecoderProcess, command: Command, *numbers: int) -> None:
        try:
            process.ask(command, *numbers)
        except DecoderLost as lost:
            self._process = None
            process.close()
            self._pool.lost(lost)
            raise


def _close_started(spare: Future[DecoderProcess]) -> None:
    if not spare.cancelled() and spare.exception() is None:
        spare.result().close()
